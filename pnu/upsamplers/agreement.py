"""Points moved to where the predictions around them agree that the surface is."""

import numpy as np
from numpy.typing import NDArray

from pnu import kernels
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.point_tree import PointTree
from pnu.runtime.progress import Step, silent
from pnu.runtime.threads import map_on_threads, thread_count

NEIGHBORS = 48  # predictions that a point asks: of 8 patches that overlap, some 3 spacings around
ROUNDS = 8
SURPLUS = 1.1  # points chosen of those wanted: the farthest ones lie off the surface, and close together once on it
KEPT = 2**17  # points whose neighbors are known at once: 50 MiB,
CHUNK = 2**11  # and so many by a thread
Floats = NDArray[np.float64]


def most_agreed(predicted: Floats, count: int, step: Step = silent) -> Floats:
    """Points and unit normals (count, 6) where predictions (m, 6) agree: farthest points, `agreed`, thinned out."""
    more = min(round(SURPLUS * count), len(predicted))
    found = agreed(predicted[farthest_points_large(predicted[:, :3], more, step=step)], predicted)
    return found[farthest_points_large(found[:, :3], count)]


def agreed(chosen: Floats, predicted: Floats) -> Floats:
    """Points and unit normals (n, 6) moved along their normals to the predictions (m, 6) around them.

    Each takes the mean of its 48 nearest predictions, by a Gaussian of the distance and the fourth power of the cosine
    between normals: first the normal, then the offset along it. So errors across the surface, which differ from patch
    to patch, cancel, and points keep their places along it. Normals of both may have any length.
    """
    places, sides = np.ascontiguousarray(predicted[:, :3], np.float64), _unit(predicted[:, 3:].astype(np.float64))
    tree, k = PointTree(places), min(NEIGHBORS, len(predicted))
    found = np.empty(chosen.shape)
    for first in range(0, len(chosen), KEPT):
        part = slice(first, first + KEPT)
        _move_on_threads(chosen[part].astype(np.float64), places, sides, tree, k, found[part])
    return found


def _move_on_threads(chosen: Floats, places: Floats, sides: Floats, tree: PointTree, k: int, found: Floats) -> None:
    """`agreed` of some points (n, 6), into `found`."""
    points, normals = np.ascontiguousarray(chosen[:, :3]), _unit(chosen[:, 3:])
    around = tree.nearest_sq(points, k, threads=thread_count())[1]
    work = _move_to_means
    if kernels.ready():
        from pnu.kernels.local_means import move_to_means as work
    parts = [slice(first, min(first + CHUNK, len(points))) for first in range(0, len(points), CHUNK)]
    map_on_threads(lambda part: work(points, normals, places, sides, around, ROUNDS, part.start, found[part]), parts)


def _move_to_means(
    points: Floats, normals: Floats, places: Floats, sides: Floats, around: NDArray[np.int64], rounds: int, first: int,
    out: Floats,
) -> None:  # fmt: skip
    """`pnu.kernels.local_means.move_to_means`."""
    part = slice(first, first + len(out))
    points, normals, around = points[part], normals[part], around[part]
    for _ in range(rounds):
        offsets = places[around] - points[:, None]
        dist_sq = (offsets**2).sum(-1)
        close = np.exp(-2 * dist_sq / np.maximum(dist_sq.max(1, keepdims=True), np.finfo(float).tiny))
        normals = _unit(((close * _alike(sides[around], normals))[..., None] * sides[around]).sum(1))
        weight = close * _alike(sides[around], normals)
        along = (offsets * normals[:, None]).sum(-1)
        total = weight.sum(1)
        move = np.divide((weight * along).sum(1), total, out=np.zeros_like(total), where=total > 0)
        points = points + move[:, None] * normals
    out[:, :3], out[:, 3:] = points, normals


def _alike(sides: Floats, normals: Floats) -> Floats:
    """(n, k): the fourth power of the cosine between (n, k, 3) and (n, 3), 0 where they look to other sides."""
    power: Floats = np.maximum((sides * normals[:, None]).sum(-1), 0) ** 4
    return power


def _unit(vectors: Floats) -> Floats:
    """Of length 1, or 0 where there is no direction: zero, NaN or infinite."""
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Floats = np.divide(vectors, length, out=np.zeros_like(vectors), where=(length > 0) & np.isfinite(length))
    return unit
