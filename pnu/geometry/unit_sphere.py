"""The unit sphere frame of a cloud: one rule for training and inference."""

from typing import NamedTuple

import torch
from torch import Tensor


class Frame(NamedTuple):
    """Maps clouds (B, n, 3) or (B, n, 6) to the unit sphere and back; normals keep their direction."""

    center: Tensor  # (B, 1, 3)
    scale: Tensor  # (B, 1, 1), in the cloud's unit of length

    def to_unit(self, cloud: Tensor) -> Tensor:
        """Points p become (p - center) / scale."""
        return torch.cat([(cloud[..., :3] - self.center) / self.scale, cloud[..., 3:]], -1)

    def from_unit(self, cloud: Tensor) -> Tensor:
        """The inverse of `to_unit`."""
        return torch.cat([cloud[..., :3] * self.scale + self.center, cloud[..., 3:]], -1)


def unit_sphere_frame(points: Tensor) -> Frame:
    """Frame in which the centroid of points (B, n, 3 or more) is 0 and the greatest distance from it is 1.

    ValueError where all points of a cloud coincide, or one is not finite.
    """
    xyz = points[..., :3]
    center = xyz.mean(1, keepdim=True)
    scale = (xyz - center).norm(dim=-1).amax(1)[:, None, None]
    # a cloud that is one point repeated differs from its mean by rounding alone
    floor = xyz.abs().amax((1, 2))[:, None, None] * (8 * torch.finfo(xyz.dtype).eps)
    if not bool((torch.isfinite(scale) & (scale > floor)).all()):
        raise ValueError("points: expected finite points that are not all equal, found a cloud without extent")
    return Frame(center, scale)
