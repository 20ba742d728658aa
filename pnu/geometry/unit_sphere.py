"""The unit sphere frame of a cloud: one rule for training and inference, for arrays and tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Points = TypeVar("Points", "NDArray[Any]", "Tensor")


class Frame(NamedTuple):
    """Maps clouds (..., n, 3) or (..., n, 6) to the unit sphere and back; normals keep their direction."""

    center: Any  # (..., 1, 3), an array or a tensor, as the clouds that it maps
    scale: Any  # (..., 1, 1), in the cloud's unit of length

    def to_unit(self, cloud: Points) -> Points:
        """Points p become (p - center) / scale."""
        return _with_points((cloud[..., :3] - self.center) / self.scale, cloud)

    def from_unit(self, cloud: Points) -> Points:
        """The inverse of `to_unit`."""
        return _with_points(cloud[..., :3] * self.scale + self.center, cloud)


def unit_sphere_frame(points: NDArray[Any] | Tensor) -> Frame:
    """Frame in which the centroid of points (..., n, 3 or more) is 0 and the greatest distance from it is 1.

    ValueError where all points of a cloud coincide, or one is not finite.
    """
    xyz: Any = points[..., :3]
    center = xyz.mean(-2, keepdims=True)
    scale = _greatest(((xyz - center) ** 2).sum(-1) ** 0.5, -1)[..., None, None]
    # a cloud that is one point repeated differs from its mean by rounding alone
    rounding = 8 * np.finfo(str(xyz.dtype).removeprefix("torch.")).eps
    floor = _greatest(abs(xyz), (-2, -1))[..., None, None] * rounding
    if not bool(((scale > floor) & (scale < float("inf"))).all()):
        raise ValueError("points: expected finite points that are not all equal, found a cloud without extent")
    return Frame(center, scale)


def _greatest(values: Any, axes: int | tuple[int, int]) -> Any:
    return values.max(axes) if isinstance(values, np.ndarray) else values.amax(axes)


def _with_points(points: Any, cloud: Points) -> Points:
    """A cloud with other points."""
    if isinstance(cloud, np.ndarray):
        return np.concatenate([points, cloud[..., 3:]], -1)
    import torch

    return torch.cat([points, cloud[..., 3:]], -1)
