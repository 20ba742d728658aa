"""Normals of a bare cloud: plane fits, one consistent side for all, and fits again within each sheet of the surface."""

from __future__ import annotations

import torch
from torch import Tensor

from pnu.geometry.neighbor_search import knn, nearest
from pnu.geometry.noise_level import noise_level
from pnu.geometry.orientation import ROWS, SOME_NOISE, NeighborCloud, field, signs


def estimate_normals(points: Tensor, k: int = 16, *, orient: bool = True) -> Tensor:
    """Unit normals of clouds (B, n, 3) -> (B, n, 3).

    Without `orient`: least squares plane of the k nearest points (PCA), sign arbitrary. With it: outward on closed
    shapes, one side on open ones (`orient_normals`), then fitted again to the neighbors on the same sheet only, which
    halves the error at edges and thin walls. ValueError if k is not in 3..n.
    """
    if not 3 <= k <= points.shape[1]:
        raise ValueError(f"k: expected 3 to {points.shape[1]} neighbors (the number of points), found {k}")
    points = points.detach()
    planes = [_plane_normals(xyz, near) for xyz, near in zip(points, knn(points, points, k).idx, strict=True)]
    if orient:
        planes = [_refined(NeighborCloud.of(xyz), lines) for xyz, lines in zip(points, planes, strict=True)]
    return torch.stack(planes).to(points)


def complete_normals(points: Tensor, normals: Tensor | None, k: int = 16) -> Tensor:
    """Normals (n, 3) of points (n, 3): those given; where None or NaN, estimated."""
    missing = torch.ones(len(points), dtype=torch.bool) if normals is None else normals.isnan().any(1)
    if normals is not None and not missing.any():
        return normals
    estimated = estimate_normals(points[None], k)[0]
    if normals is None:
        return estimated
    near = (estimated[None, missing], points[None, missing], points[None, ~missing], normals[None, ~missing])
    completed = normals.clone()
    completed[missing] = flip_to_reference(*near)[0]
    return completed


def orient_normals(points: Tensor, normals: Tensor) -> Tensor:
    """The same normals (n, 3) of points (n, 3), each with the sign that makes them agree.

    Outward on closed shapes, whatever their number; the same side all over on an open sheet. Deterministic; beyond 4096
    points the global step sees an even subset, so that time stays linear.
    """
    cloud = NeighborCloud.of(points)
    lines = torch.nn.functional.normalize(normals.to(cloud.points), dim=1)
    return normals * signs(cloud, lines)[:, None].to(normals)


def refit_normals(points: Tensor, normals: Tensor) -> Tensor:
    """What `estimate_normals` makes of points (n, 3) once it knows their sides, those of normals (n, 3)."""
    return _refined(NeighborCloud.of(points), normals, oriented=True).to(points)


def flip_to_reference(normals: Tensor, points: Tensor, ref_points: Tensor, ref_normals: Tensor) -> Tensor:
    """Normals (B, n, 3) at points (B, n, 3), each turned to the side of the nearest reference point's normal."""
    near = nearest(points, ref_points).idx[..., None].expand(-1, -1, 3)
    side = (normals * ref_normals.gather(1, near)).sum(-1, keepdim=True)
    return torch.where(side < 0, -normals, normals)


def _plane_normals(points: Tensor, idx: Tensor, weight: Tensor | None = None) -> Tensor:
    """Direction of least variance of points[idx], (n, 3); idx (n, k), weights (n, k)."""
    normals = []
    for rows in torch.split(torch.arange(len(idx), device=idx.device), ROWS):
        near = points[idx[rows]].double()
        share = torch.ones_like(near[..., :1]) if weight is None else weight[rows, :, None].double()
        near = near - (share * near).sum(1, keepdim=True) / share.sum(1, keepdim=True)
        normals.append(torch.linalg.eigh(near.mT @ (share * near))[1][:, :, 0])
    return torch.cat(normals)


def _refined(cloud: NeighborCloud, lines: Tensor, *, oriented: bool = False) -> Tensor:
    """Oriented normals from lines (n, 3). Each turn of field and fit leaves cleaner lines for the next."""
    normals, noise = lines.to(cloud.points), SOME_NOISE
    for _ in range(2):
        if not oriented:
            normals = normals * signs(cloud, normals)[:, None]
        for _ in range(5):
            normals = field(cloud, normals, noise)
        normals = _sheet_normals(cloud, normals, noise)
        noise = noise_level(cloud.points, normals) / cloud.spacing.median().item()
    return normals


def _sheet_normals(cloud: NeighborCloud, normals: Tensor, noise: float) -> Tensor:
    """Plane fits to the neighbors that face the same way and lie near the tangent plane, signs kept."""
    k = round(32 * min(1 + 3 * noise, 1.5))
    fitted = []
    for rows in torch.split(torch.arange(len(normals), device=normals.device), ROWS):
        idx, normal = cloud.idx[rows, :k], normals[rows, None]
        offset = cloud.points[idx] - cloud.points[rows, None]
        distance = offset.norm(dim=-1)
        reach = distance[:, -1:].clamp_min(1e-9) / 1.5
        rise = (offset * normal).sum(-1).abs() + (offset * normals[idx]).sum(-1).abs()
        facing = (normal * normals[idx]).sum(-1).clamp_min(0) ** (4 / (1 + 6 * noise))
        weight = facing * torch.exp(-((distance / reach) ** 2) - (rise / ((0.5 + 3 * noise) * reach)) ** 2)
        weight[:, 0] = 1
        fitted.append(_plane_normals(cloud.points, idx, weight).to(normals))
    lines = torch.cat(fitted)
    cosine = (lines * normals).sum(1, keepdim=True)
    # a fit across the given normal has found something else than its sheet
    return torch.where(cosine.abs() < 0.3, normals, lines * cosine.sign())
