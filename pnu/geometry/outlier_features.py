"""What tells a stray point from a measured one: how a point lies among its 32 nearest neighbors, in numbers.

The ingredients are those of the usual removers of outliers, side by side: distances to neighbors against those around
(statistical outlier removal), how often others have the point for a neighbor, heights over fitted planes, and local
outlier factors (Breunig et al. 2000). All are free of place, rotation, size and density.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pnu import kernels
from pnu.geometry.fitted_planes import FittedPlanes
from pnu.geometry.point_tree import PointTree
from pnu.runtime import threads

NEIGHBORS = 32
RANKS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32])  # whose distances are told
AROUND = 24  # neighbors whose usual spacing is the unit of length
PLANES = (8, 16, 32)  # neighbors that planes are fitted to; the second gives the normals
FELLOWS = (8, 24)  # neighbors whose planes the point is held against
LISTS = (6, 12, 20, 32)  # lengths of the lists of nearest points in which a point is looked for
REACHES = (8, 20)  # neighbors of the local outlier factors
LIMIT = 6.0  # of all features
FEATURES = 52
ROWS = 2**16  # points at once: bounds the memory,
CHUNK = 2**11  # or so many by a thread
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def outlier_features(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Features (n, 52) of points (n, 3), n >= 3. Fewer than 33 points have their farthest neighbor several times."""
    k = min(NEIGHBORS, len(points) - 1)
    distance, near = PointTree(points).among_themselves(k + 1, threads=threads.thread_count())
    if k < NEIGHBORS:
        missing = ((0, 0), (0, NEIGHBORS - k))
        distance, near = np.pad(distance, missing, mode="edge"), np.pad(near, missing, mode="edge")
    np.maximum(distance, 1e-300, out=distance)
    near = np.ascontiguousarray(near)
    spacing = distance[:, 5]
    unit = _quantiles(spacing, near, AROUND, (0.5,))[:, 0]
    planes, normals = _planes_of_all(points, near, unit)
    around = _quantiles(spacing, near, NEIGHBORS, (0.1, 0.25, 0.75, 0.9))
    columns = [
        *((np.bincount(near[:, :m].ravel(), minlength=len(points)) / m)[:, None] for m in LISTS),
        planes,
        _fellows_of_all(points, normals, near, unit),
        *(_outlier_factors(distance, near, m) for m in REACHES),
    ]
    features = np.empty((len(points), FEATURES), np.float32)

    def put_together(part: slice) -> None:
        lengths = np.log(np.hstack([distance[part][:, RANKS - 1], around[part]]) / unit[part, None])
        found = np.hstack([lengths, *(column[part] for column in columns)])
        features[part] = np.clip(np.nan_to_num(found, copy=False), -LIMIT, LIMIT)

    _on_threads(put_together, len(points))
    return features


def _on_threads(work: Callable[[slice], object], n: int) -> None:
    parts = [slice(first, min(first + CHUNK, n)) for first in range(0, n, CHUNK)]
    threads.map_on_threads(work, parts)


def _quantiles(values: Floats, near: Indices, m: int, shares: tuple[float, ...]) -> Floats:
    """Quantiles (n, shares) of the values (n,) at the first m neighbors of each point."""
    if not kernels.ready():
        return np.asarray(np.quantile(values[near[:, :m]], shares, axis=1).T)
    from pnu.kernels.planes import neighbor_quantiles

    values, found = np.ascontiguousarray(values), np.empty((len(near), len(shares)))
    _on_threads(lambda p: neighbor_quantiles(values, near, m, np.array(shares), p.start, found[p]), len(near))
    return found


def _planes_of_all(points: Floats, near: Indices, unit: Floats) -> tuple[Floats, Floats]:
    """`_planes` of all points."""
    if not kernels.ready():
        parts = [slice(first, first + ROWS) for first in range(0, len(points), ROWS)]
        found = [_planes(points, near[p], unit[p], p) for p in parts]
        return np.concatenate([planes for planes, _ in found]), np.concatenate([normals for _, normals in found])
    from pnu.kernels.planes import PLANE, plane_features

    points, unit = np.ascontiguousarray(points), np.ascontiguousarray(unit)
    planes, normals = np.empty((len(points), PLANE * len(PLANES))), np.empty((len(points), 3))
    counts = np.array(PLANES)
    _on_threads(lambda p: plane_features(points, near, unit, counts, 1, p.start, planes[p], normals[p]), len(points))
    return planes, normals


def _fellows_of_all(points: Floats, normals: Floats, near: Indices, unit: Floats) -> Floats:
    """`_among_fellows` of all points."""
    if not kernels.ready():
        parts = [slice(first, first + ROWS) for first in range(0, len(points), ROWS)]
        return np.concatenate([_among_fellows(points, normals, near[p], unit[p], p) for p in parts])
    from pnu.kernels.planes import FELLOW, fellow_features

    points, normals, unit = (np.ascontiguousarray(values) for values in (points, normals, unit))
    found, counts = np.empty((len(points), FELLOW * len(FELLOWS))), np.array(FELLOWS)
    _on_threads(lambda p: fellow_features(points, normals, near, unit, counts, p.start, found[p]), len(points))
    return found


def _planes(points: Floats, near: Indices, unit: Floats, part: slice) -> tuple[Floats, Floats]:
    """Of planes fitted to neighbors: the point's height over each, its way to their middle, their sizes; a normal."""
    found, normals = [], np.empty(0)
    for m in PLANES:
        middle, size, axes = FittedPlanes.of(points[near[:, :m]])
        offset = points[part] - middle
        height = np.abs((offset * axes[:, :, 0]).sum(1))
        lengths = np.column_stack([height, np.linalg.norm(offset, axis=1)]) / unit[:, None]
        sizes = np.log(size / unit[:, None] + 1e-3)
        found.append(np.column_stack([lengths, sizes, height / (size[:, 0] + 0.05 * unit)]))
        if m == PLANES[1]:
            normals = axes[:, :, 0]
    return np.hstack(found), normals


def _among_fellows(points: Floats, normals: Floats, near: Indices, unit: Floats, part: slice) -> Floats:
    """The point's heights over its neighbors' planes, and how alike their normals are."""
    found = []
    for m in FELLOWS:
        fellows = near[:, :m]
        planes = normals[fellows]
        height = np.abs(((points[part, None] - points[fellows]) * planes).sum(2)) / unit[:, None]
        alike = np.abs((planes * normals[part, None]).sum(2)).mean(1)
        shares = np.linalg.eigvalsh(planes.transpose(0, 2, 1) @ planes / m)[:, :0:-1]
        found.append(np.column_stack([np.median(height, 1), np.quantile(height, 0.25, axis=1), alike, shares]))
    return np.hstack(found)


def _outlier_factors(distance: Floats, near: Indices, m: int) -> Floats:
    """Logarithm of the local outlier factor with m neighbors, and its usual and high values around."""
    farthest, reach, factor = np.ascontiguousarray(distance[:, m - 1]), np.empty(len(near)), np.empty(len(near))

    def reaches(part: slice) -> None:
        reach[part] = np.maximum(distance[part, :m], farthest.take(near[part, :m])).mean(1)

    def factors(part: slice) -> None:
        factor[part] = np.log(reach[part] * (1 / reach.take(near[part, :m])).mean(1))

    _on_threads(reaches, len(near))
    _on_threads(factors, len(near))
    return np.column_stack([factor, _quantiles(factor, near, m, (0.5, 0.9))])
