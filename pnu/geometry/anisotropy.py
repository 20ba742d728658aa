"""Clouds that are dense along lines and sparse across them, as laser scanners give them: found, and evened out."""

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.point_tree import PointTree

AROUND = 8  # neighbors whose spread is looked at
PLACES = 2000
LINED = 0.3  # of `evenness`; random, even and uneven points of a surface stay above 0.5
EVEN = 0.5
SHARES = tuple(2 ** (-i / 4) for i in range(2, 21))  # of the points, that may be kept: 0.7 to 0.03


def evenness(points: NDArray[np.float64]) -> float:
    """Spread of the nearest neighbors across, over along their main direction, at the median of 2000 places.

    About 0.6 for the points (n, 3) of a surface, drawn at random or evenly; 0.1 and less on lines.
    """
    places = points[:: -(-len(points) // PLACES)]
    near = points[PointTree(points).nearest(places, min(AROUND + 1, len(points)))[1]]
    near = near - near.mean(1, keepdims=True)
    size = np.sqrt(np.maximum(np.linalg.eigvalsh(near.transpose(0, 2, 1) @ near), 0))
    return float(np.median(size[:, 1] / np.maximum(size[:, 2], 1e-300)))


def thinned_lines(points: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Rows of those of the points (n, 3) that lie evenly enough for neighborhoods to span lines; None: no lines.

    They are farthest points, as many as can be: thinner than that, the surface between is worse known.
    """
    if len(points) < 4 * AROUND or evenness(points) > LINED:
        return None
    order = farthest_points_large(points, round(SHARES[0] * len(points)))
    for share in SHARES:
        kept = order[: max(round(share * len(points)), AROUND + 1)]
        if evenness(points[kept]) > EVEN:
            return np.sort(kept)
    return None  # a single line, say: no subset of it lies on a surface


def averaged(points: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Points (m, 3) in place of those of the rows (m,): each the mean of all points (n, 3) that are nearest to it."""
    return means_around(points, rows, points)


def means_around(
    points: NDArray[np.float64], rows: NDArray[np.int64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The mean of the values (n, d) of all points (n, 3) that are nearest to each of the rows (m,): (m, d)."""
    owner = PointTree(points[rows]).nearest(points, 1)[1][:, 0]
    total = np.stack([np.bincount(owner, axis, len(rows)) for axis in values.T], 1)
    return total / np.bincount(owner, minlength=len(rows))[:, None]


def mean_normals(
    points: NDArray[np.float64], rows: NDArray[np.int64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit normals (m, 3) by those, (n, 3), of all points that are nearest to each of the rows (m,); NaN: none has."""
    mean = means_around(points, rows, np.nan_to_num(normals))
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(length > 0, mean / np.maximum(length, 1e-300), np.nan)
