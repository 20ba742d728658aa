"""Rigid and affine maps of clouds that treat points as points and normals as normals."""

import torch
from torch import Tensor


def rotation_matrix(clouds: int, *, generator: torch.Generator, dtype: torch.dtype = torch.float32) -> Tensor:
    """Uniform random rotations, (clouds, 3, 3): unit quaternions from normalized Gaussians (Shoemake 1992)."""
    quaternion = torch.randn(clouds, 4, generator=generator, dtype=dtype, device=generator.device)
    w, x, y, z = (quaternion / quaternion.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
        ],
        1,
    ).view(-1, 3, 3)  # fmt: skip


def small_rotation(
    clouds: int, sigma: float, clip: float, *, generator: torch.Generator, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Rotations Rz Ry Rx by three angles N(0, sigma) clipped to +-clip, in radians: (clouds, 3, 3)."""
    angle = torch.randn(clouds, 3, generator=generator, dtype=dtype, device=generator.device) * sigma
    cos, sin = angle.clamp(-clip, clip).cos().unbind(1), angle.clamp(-clip, clip).sin().unbind(1)
    zero, one = torch.zeros_like(cos[0]), torch.ones_like(cos[0])
    about_x = torch.stack([one, zero, zero, zero, cos[0], -sin[0], zero, sin[0], cos[0]], 1).view(-1, 3, 3)
    about_y = torch.stack([cos[1], zero, sin[1], zero, one, zero, -sin[1], zero, cos[1]], 1).view(-1, 3, 3)
    about_z = torch.stack([cos[2], -sin[2], zero, sin[2], cos[2], zero, zero, zero, one], 1).view(-1, 3, 3)
    return about_z @ about_y @ about_x


def rotate(cloud: Tensor, rotation: Tensor) -> Tensor:
    """R p for the points and, in a cloud (B, n, 6), R n for the normals; rotation (B, 3, 3) or (3, 3)."""
    parts = torch.split(cloud, 3, dim=-1)
    return torch.cat([part @ rotation.transpose(-1, -2) for part in parts], -1)


def scale(cloud: Tensor, factor: Tensor | float) -> Tensor:
    """factor p for the points (factor one positive number, or (B,)); normals stay."""
    factor = torch.as_tensor(factor, dtype=cloud.dtype, device=cloud.device)
    if not bool((factor > 0).all()):
        raise ValueError(
            f"factor: expected positive numbers, found {factor.min().item():g}; a mirror image is an affine"
        )
    return torch.cat([cloud[..., :3] * factor.reshape(-1, 1, 1), cloud[..., 3:]], -1)


def translate(cloud: Tensor, offset: Tensor) -> Tensor:
    """p + offset for the points, offset (B, 3) or (3,); normals stay."""
    return torch.cat([cloud[..., :3] + offset.reshape(-1, 1, 3), cloud[..., 3:]], -1)


def affine(cloud: Tensor, matrix: Tensor) -> Tensor:
    """A p for the points and the unit vector along A^-T n for the normals, which stays perpendicular to the surface.

    cloud (B, n, 3) or (B, n, 6), matrix (B, 3, 3) or (3, 3). Outward stays outward, also under a reflection. A zero
    normal stays zero. ValueError where a matrix is singular.
    """
    points = cloud[..., :3] @ matrix.transpose(-1, -2)
    if cloud.shape[-1] == 3:
        return points
    inverse, failed = torch.linalg.inv_ex(matrix)
    if bool((failed != 0).any()):
        raise ValueError("matrix: expected invertible 3 x 3 matrices, found a singular one")
    normals = cloud[..., 3:] @ inverse  # rows: (A^-T n)^T = n^T A^-1
    return torch.cat([points, torch.nn.functional.normalize(normals, dim=-1)], -1)
