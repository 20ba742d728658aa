"""How noisy a cloud is."""

import math

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import spacing
from pnu.geometry.spatial_blocks import some_rows
from pnu.runtime.threads import thread_count

PLACES = 1000
QUIET = 0.1  # the quietest tenth of the places: elsewhere edges and second sheets look like noise
# neighbors, and the noise in spacings up to which they tell it apart from the spread of the points themselves
WINDOWS = ((16, 0.22), (24, 0.4), (48, math.inf))

CLOSEST = 9  # points of which the one most nearly above another is taken,
NEAR = 0.5  # spacings beside it at most,
ALIKE = 0.5  # and cosine of the angle between normals at least,
AROUND = 33  # by each and its neighbors
MEDIAN = 1.4826 / 2**0.5  # standard deviation over the median distance of two
ENOUGH = 4000  # points that tell noise in places from walls too thin for them
SOME = 300  # places that are looked at,
LOUDEST = 0.9  # quantile of them,
IN_PLACES = 0.22  # whose noise in spacings counts from there on: unresolved thin walls stay below,
LOUDER = 3.0  # and times the noise of the whole, as medians around points of even noise vary up to 2.5 times
ROWS = 2**13  # points at once: bounds the memory
Floats = NDArray[np.float64]


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


def local_noise(points: Floats, normals: Floats, rows: NDArray[np.int64] | None = None) -> Floats:
    """As `noise_level`, but at each of the points (n, 3) with unit normals (n, 3), or at those rows (m,): (n,) or (m,).

    By points that lie nearly above each other, on the same side: how far one is over the other does not depend on the
    shape there, as it would farther away (to the two normals' mean, points of a sphere are level). Their median around
    each point. A lower bound where normals follow the noise; 0 where no such points are, as in an evenly spread cloud.
    """
    tree, rows = PointTree(points), np.arange(len(points)) if rows is None else rows
    level, height, known = np.zeros(len(rows)), np.empty(len(points)), np.zeros(len(points), bool)
    for first in range(0, len(rows), ROWS):
        part = slice(first, first + ROWS)
        around = tree.nearest(points[rows[part]], min(AROUND, len(points)), threads=thread_count())[1]
        new = np.unique(around[~known[around]])
        height[new], known[new] = _over_others(points, normals, new, tree), True
        heights = height[around]
        told = np.isfinite(heights).any(1)
        level[part][told] = MEDIAN * np.nanmedian(heights[told], axis=1)
    return level


def is_louder_in_places(points: Floats, normals: Floats, level: float) -> bool:
    """Whether at one of ten points (n, 3) with unit normals (n, 3) there is much noise (`local_noise`) beside their
    spacing, and beside that of the whole, `level`. Never of fewer than 4000 points."""
    if len(points) < ENOUGH:
        return False
    there = local_noise(points, normals, some_rows(points, SOME))
    return bool(np.quantile(there, LOUDEST) > max(IN_PLACES * spacing(points), LOUDER * level))


def _over_others(points: Floats, normals: Floats, rows: NDArray[np.int64], tree: PointTree) -> Floats:
    """How far rows (m,) of points (n, 3) lie over that of their neighbors that is most nearly below or above, (m,); NaN
    where none is within a share of their distances."""
    found = np.empty(len(rows))
    for first in range(0, len(rows), ROWS):
        some = rows[first : first + ROWS]
        distance, near = tree.nearest(points[some], min(CLOSEST, len(points)), threads=thread_count())
        near, apart = near[:, 1:], distance[:, 1:6].mean(1)
        offset, axis = points[near] - points[some, None], normals[near] + normals[some, None]
        alike = (normals[near] * normals[some, None]).sum(2) > ALIKE
        axis /= np.maximum(np.linalg.norm(axis, axis=2, keepdims=True), 1e-9)
        height = (offset * axis).sum(2)
        beside = np.where(alike, np.linalg.norm(offset - height[:, :, None] * axis, axis=2), np.inf)
        nearest = beside.argmin(1)[:, None]
        height, beside = (np.take_along_axis(values, nearest, 1)[:, 0] for values in (height, beside))
        found[first : first + ROWS] = np.where(beside < NEAR * apart, np.abs(height), np.nan)
    return found


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
