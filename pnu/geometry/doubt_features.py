"""What tells whether doubtful points lie on the surface that all others sample: how they lie to these, in numbers.

The others are looked at as they are and thinned out twice, evenly: where a cloud has few points, its nearest neighbors
are few and all on one side, and only the thinned ones show how the surface goes on. All numbers are free of place,
rotation, size and density.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.fitted_planes import FittedPlanes
from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import thread_count

SHARES = (1, 4, 16)  # one of so many others, farthest points of them, are looked at,
LEAST = 32  # but so many at least
NEIGHBORS = 24
RANKS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24])  # whose distances are told
SPACED = 6  # the neighbor whose distance is the spacing at a point
PLANES = (6, 12, 24)  # neighbors that planes are fitted to,
BENT = (12, 24)  # and surfaces of second order
STIFF = 1e-2  # of these: what keeps them plane where neighbors don't tell
OWN = 12  # neighbors of the plane of each of the others,
FELLOWS = (6, 24)  # which the point is held against
AROUND = 12  # neighbors between which it may be seen from a side that is empty
DOUBTFUL = 3  # other doubtful points, whose distances are told
LIMIT = 6.0  # of all features
TINY = 1e-100  # no length that something is divided by is less
ROWS = 2**13  # points at once: bounds the memory
OF_LEVEL = len(RANKS) + 6 * len(PLANES) + 3 * len(BENT) + 5 * len(FELLOWS) + 1
DOUBT_FEATURES = len(SHARES) * (OF_LEVEL + 1) + DOUBTFUL
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def doubt_features(points: Floats, others: Floats, odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """Features (m, 138) of doubtful points (m, 3) beside others (n, 3), n > 24, whose order does not matter.

    odds: (m,), logarithms of those that each is stray, after a first look.
    """
    others = others[np.lexsort(others.T)]
    center = others.mean(0)
    points, others = points - center, others - center
    extent = max(float(np.abs(others).max()), float(np.abs(points).max()), TINY)
    points, others = points / extent, others / extent
    middle = int((others**2).sum(1).argmin())  # to begin with, however the cloud is turned
    others = np.concatenate([others[middle : middle + 1], np.delete(others, middle, 0)])
    counts = [min(len(others), max(len(others) // share, LEAST)) for share in SHARES]
    order = farthest_points_large(others, counts[1])
    levels = [_Level.of(some) for some in (others, *(others[order[:count]] for count in counts[1:]))]
    parts = [points[first : first + ROWS] for first in range(0, len(points), ROWS)]
    found, unit = [], np.empty((len(points), len(levels)))
    for number, level in enumerate(levels):
        columns = [_beside(part, level) for part in parts]
        found.append(np.concatenate([features for features, _ in columns]))
        unit[:, number] = np.concatenate([units for _, units in columns])
    found.append(np.log(unit[:, 1:] / unit[:, :-1]))
    alike = min(DOUBTFUL, len(points) - 1)
    apart = PointTree(points).nearest(points, alike + 1, threads=thread_count())[0][:, 1:]
    found.append(np.full((len(points), DOUBTFUL), LIMIT))
    found[-1][:, :alike] = np.log(np.maximum(apart, TINY) / unit[:, -1:])
    found.append(odds[:, None])
    features: NDArray[np.float32] = np.clip(np.nan_to_num(np.hstack(found)), -LIMIT, LIMIT).astype(np.float32)
    return features


class _Level(NamedTuple):
    """Points (n, 3), and how to look among them."""

    points: Floats
    tree: PointTree

    @classmethod
    def of(cls, points: Floats) -> "_Level":
        return cls(points, PointTree(points))

    def nearest(self, queries: Floats, k: int) -> tuple[Floats, Indices]:
        """Distances and rows (m, k) of the nearest; of fewer points the farthest several times."""
        distance, near = self.tree.nearest(queries, min(k, len(self.points)), threads=thread_count())
        missing = ((0, 0), (0, k - near.shape[1]))
        return np.maximum(np.pad(distance, missing, mode="edge"), TINY), np.pad(near, missing, mode="edge")


def _beside(points: Floats, level: _Level) -> tuple[Floats, Floats]:
    """Features (m, 44) of points (m, 3) beside those of a level, and the spacing there, (m,)."""
    distance, near = level.nearest(points, NEIGHBORS)
    named, there = np.unique(near, return_inverse=True)
    there = there.reshape(near.shape)
    apart, own = level.nearest(level.points[named], OWN + 1)
    planes = FittedPlanes.of(level.points[own])
    normals = planes.axes[:, :, 0]
    rough = planes.size[:, 0] / np.maximum(np.linalg.norm(planes.size, axis=1), TINY)
    unit = np.median(apart[there, SPACED - 1], 1)  # above zero, as all distances are
    around = level.points[near]
    columns = [np.log(distance[:, RANKS - 1] / unit[:, None])]
    for k in PLANES:
        plane = FittedPlanes.of(around[:, :k])
        offset = points - plane.middle
        height = np.abs((offset * plane.axes[:, :, 0]).sum(1))
        lengths = np.column_stack([height, np.linalg.norm(offset, axis=1)]) / unit[:, None]
        columns += [lengths, np.log(plane.size / unit[:, None] + 1e-3)]
        columns += [(height / (plane.size[:, 0] + 0.05 * unit))[:, None]]
        if k in BENT:
            columns.append(_over_bent(points, around[:, :k], plane, unit))
    for k in FELLOWS:
        heights = np.abs(((points[:, None] - around[:, :k]) * normals[there[:, :k]]).sum(2)) / unit[:, None]
        heights.sort(axis=1)
        columns += [heights[:, [0, k // 4, k // 2, k - 1]], rough[there[:, :k]].mean(1)[:, None]]
    columns.append(_widest_side(points, around[:, :AROUND])[:, None])
    return np.hstack(columns), unit


def _over_bent(points: Floats, around: Floats, plane: FittedPlanes, unit: Floats) -> Floats:
    """Height of points (m, 3) over a surface of second order through neighbors (m, k, 3), in spacings and in those of
    the neighbors, and these: (m, 3)."""
    width = np.maximum(plane.size[:, 2], TINY)

    def terms(offsets: Floats) -> tuple[Floats, Floats]:
        rise, v, u = np.moveaxis(offsets @ plane.axes, 2, 0)
        u, v = u / width[:, None], v / width[:, None]
        return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 2), rise

    known, rise = terms(around - plane.middle[:, None])
    normal = known.transpose(0, 2, 1) @ known + STIFF * np.eye(6)
    weights = np.linalg.solve(normal, known.transpose(0, 2, 1) @ rise[:, :, None])
    left = np.sqrt(((rise - (known @ weights)[:, :, 0]) ** 2).mean(1))
    there, own = terms((points - plane.middle)[:, None])
    height = np.abs(own - (there @ weights)[:, :, 0])[:, 0]
    return np.column_stack([height / unit, height / (left + 0.05 * unit), left / unit])


def _widest_side(points: Floats, around: Floats) -> Floats:
    """The widest angle, in their plane, between the ways from points (m, 3) to their neighbors (m, k, 3): (m,)."""
    across = FittedPlanes.of(around).axes[:, :, 1:]
    way = (around - points[:, None]) @ across
    angle = np.sort(np.arctan2(way[:, :, 1], way[:, :, 0]), 1)
    between: Floats = np.diff(np.concatenate([angle, angle[:, :1] + 2 * np.pi], 1), axis=1).max(1)
    return between
