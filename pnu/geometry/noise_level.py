"""How noisy a cloud is."""

import math

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import thread_count

PLACES = 1000
QUIET = 0.1  # the quietest tenth of the places: elsewhere edges and second sheets look like noise
# neighbors, and the noise in spacings up to which they tell it apart from the spread of the points themselves
WINDOWS = ((16, 0.22), (24, 0.4), (48, math.inf))


def noise_level(points: NDArray[np.floating], normals: NDArray[np.floating] | None = None) -> float:
    """Standard deviation of the points (n, 3) across the surface, in their unit of length.

    Residual of quadratic fits to small neighborhoods, at the quietest tenth of a thousand places. Good to about a
    quarter from 0.1 to 0.8 spacings; below, it is an upper bound: curvature that the points do not resolve counts as
    noise, and so do walls that are thin beside the spacing, unless `normals` (n, 3) tell their sides apart (NaN: not
    known). 0 where there are too few points to tell: fewer than 16, or hardly ten of like side around most places.
    """
    xyz = np.asarray(points, np.float64)
    level = 0.0
    if len(xyz) < WINDOWS[0][0]:
        return level
    places, tree = farthest_points_large(xyz, min(PLACES, len(xyz))), PointTree(xyz)
    for k, enough in WINDOWS:
        if k > len(xyz):
            break
        distance, idx = tree.nearest(xyz[places], k, threads=thread_count())
        weight = np.ones_like(distance)
        if normals is not None:
            with np.errstate(invalid="ignore"):  # NaN: no side is known
                weight = (~((normals[idx] * normals[places, None]).sum(-1) <= 0.3)).astype(np.float64)
        with np.errstate(invalid="ignore"):  # between infinite ones
            quietest = float(np.quantile(_residuals(xyz[idx], weight), QUIET))
        if not math.isfinite(quietest):
            continue
        level = quietest
        if level < enough * float(np.quantile(distance[:, 1:6].mean(1), 0.5, method="lower")):
            break
    return level


def _residuals(near: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distance of points (m, k, 3) from their best quadratic height field, (m,), or infinity."""
    square, total = (weight * height_residuals(near, weight) ** 2).sum(1), weight.sum(1)
    return np.sqrt(np.where(total > 9, square / np.maximum(total - 6, 1), np.inf))


def height_residuals(near: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of points (m, k, 3) over their best quadratic height field, to which each adds by its weight: (m, k)."""
    total, weight = weight.sum(1), weight[..., None]
    near = near - (weight * near).sum(1, keepdims=True) / total[:, None, None]
    height, u, v = np.moveaxis(near @ np.linalg.eigh(near.swapaxes(1, 2) @ (weight * near))[1], -1, 0)
    size = np.maximum(np.sqrt((u * u + v * v).mean(1, keepdims=True)), np.finfo(near.dtype).tiny)
    u, v = u / size, v / size
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)
    normal = terms.swapaxes(1, 2) @ (weight * terms) + 1e-9 * np.eye(6)
    fit = terms @ np.linalg.solve(normal, (weight * terms).swapaxes(1, 2) @ height[..., None])
    residual: NDArray[np.float64] = height - fit[..., 0]
    return residual
