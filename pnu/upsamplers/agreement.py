"""Points moved to where the predictions around them agree that the surface is."""

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import thread_count

NEIGHBORS = 48  # predictions that a point asks: of 8 patches that overlap, some 3 spacings around
ROUNDS = 2
CHUNK = 2**14  # points at once: 50 MiB
Floats = NDArray[np.float64]


def agreed(chosen: Floats, predicted: Floats) -> Floats:
    """Points and unit normals (n, 6) moved along their normals to the predictions (m, 6) around them.

    Each takes the mean of its 48 nearest predictions, by a Gaussian of the distance and the fourth power of the cosine
    between normals: first the normal, then the offset along it. So errors across the surface, which differ from patch
    to patch, cancel, and points keep their places along it. Normals of both may have any length.
    """
    tree, sides = PointTree(predicted[:, :3]), _unit(predicted[:, 3:])
    k = min(NEIGHBORS, len(predicted))
    out = np.empty_like(chosen)
    for first in range(0, len(chosen), CHUNK):
        points, normals = chosen[first : first + CHUNK, :3], _unit(chosen[first : first + CHUNK, 3:])
        _, around = tree.nearest_sq(points, k, threads=thread_count())
        for _ in range(ROUNDS):
            offsets = predicted[around, :3] - points[:, None]
            dist_sq = (offsets**2).sum(-1)
            close = np.exp(-2 * dist_sq / np.maximum(dist_sq.max(1, keepdims=True), np.finfo(float).tiny))
            normals = _unit(((close * _alike(sides[around], normals))[..., None] * sides[around]).sum(1))
            weight = close * _alike(sides[around], normals)
            along = (offsets * normals[:, None]).sum(-1)
            total = weight.sum(1)
            move = np.divide((weight * along).sum(1), total, out=np.zeros_like(total), where=total > 0)
            points = points + move[:, None] * normals
        out[first : first + CHUNK] = np.hstack([points, normals])
    return out


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
