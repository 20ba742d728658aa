"""One side for all normals of a cloud.

By the winding number. For outward normals n and point areas a the double layer
w(x) = sum_j a_j n_j.(p_j - x) / (4 pi |p_j - x|^3) is 1 inside, 0 outside and 1/2 on the surface (Gauss). Asking for
1/2 at every point, with an unknown dipole moment a n at each, is linear and asks nothing of how the points lie beside
each other; a few steps of conjugate gradients give the smooth solution. Its moments are rough as directions, but look
outward also where walls are thinner than the spacing and planes through neighbors see both of their sides. Stray lines
are settled by the gradient of w, which at each point must look along minus its normal: the field of all other dipoles.
Related: parametric Gauss reconstruction (Lin et al. 2022), winding number normal consistency (Lin et al. 2024), dipole
propagation (Metzer et al. 2021).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu import kernels
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.noise_level import noise_level
from pnu.geometry.point_tree import PointTree
from pnu.runtime import threads

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix  # imported where it is wanted: that takes a quarter of a second

ANCHORS = 4096  # points whose dipoles all see each other: 64 MiB a matrix
ROWS = 2**16  # points treated at once in local steps,
CHUNK = 2**11  # or so many by a thread
BLOCK = 128  # rows of a matrix of all pairs, few enough for a processor's cache
OPEN = 0.6  # relative misfit of Gauss' law; closed shapes stay below 0.5, a hemisphere too,
TORN = 0.64  # those with many walls thinner than the spacing below this
STEPS = ((0.17, 4), (0.25, 3), (np.inf, 2))  # of conjugate gradients up to a noise in spacings, which more would fit
SOME_NOISE = 0.1  # in spacings, where it is not known
Array = NDArray[np.float32]
Index = NDArray[np.int64]
f32 = np.float32


class NeighborCloud(NamedTuple):
    """A cloud in its unit sphere, and what local steps need to know of it."""

    points: Array  # (n, 3)
    idx: Index  # (n, k) nearest points, itself first
    spacing: Array  # (n,) usual distance to a neighbor
    area: Array  # (n,) of the surface that the point stands for

    @staticmethod
    def of(points: NDArray[np.floating]) -> NeighborCloud:
        """Of points (n, 3) in any unit."""
        centered = points.astype(np.float64)
        centered -= centered.mean(0)
        single = (centered / max(np.linalg.norm(centered, axis=1).max(), 1e-30)).astype(f32)
        few, k = min(8, len(single)), min(48, len(single))
        distance, idx = PointTree(single).nearest(single, k, threads=threads.thread_count())
        distance = distance.astype(f32)
        spacing = distance[:, 1:6].mean(1)[idx[:, :few]].mean(1)
        own = distance[:, few - 1] ** 2 * f32(np.pi / (few - 0.5))
        area = np.partition(own[idx[:, :few]], (few - 1) // 2, axis=1)[:, (few - 1) // 2]
        floor = max(f32(0.1) * lower_median(spacing), f32(1e-6))  # duplicates
        return NeighborCloud(single, idx, np.maximum(spacing, floor), np.maximum(area, floor * floor))

    def noise(self, normals: Array) -> float:
        """Across the surface, in spacings, where normals (n, 3) tell the sides of thin walls apart."""
        return noise_level(self.points, normals) / float(lower_median(self.spacing))


def lower_median(values: Array) -> f32:
    """The middle one of values (n,), of two the lower."""
    found: f32 = np.partition(values, (len(values) - 1) // 2)[(len(values) - 1) // 2]
    return found


def agreeing_normals(cloud: NeighborCloud, lines: Array) -> Array:
    """Rough normals (n, 3) whose sides agree: lines (n, 3) with signs, on a closed shape drawn to the moments there."""
    if len(lines) <= ANCHORS:
        sign, moments = _global_signs(cloud, lines)
    else:
        anchors = farthest_points_large(cloud.points, ANCHORS)
        some, of_anchors = _global_signs(NeighborCloud.of(cloud.points[anchors]), lines[anchors])
        sign = _spread(cloud, lines, anchors, some)
        near = PointTree(cloud.points[anchors]).nearest(cloud.points, 1, threads=threads.thread_count())[1]
        moments = of_anchors[near[:, 0]]
    normals = lines * sign[:, None]
    normals = normals + np.where((normals * moments).sum(1, keepdims=True) > 0, moments, f32(0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), f32(1e-12))
    return normals


def signs(cloud: NeighborCloud, lines: Array) -> Array:
    """+1 or -1 for each line, (n,)."""
    sign = _sign((agreeing_normals(cloud, lines) * lines).sum(1))
    for _ in range(3):
        turned = field(cloud, lines * sign[:, None], SOME_NOISE)
        sign = _sign((turned * lines).sum(1))
    return sign


class GaussLaw(NamedTuple):
    """What the winding number at oriented points says of the shape."""

    misfit: float  # of 1/2 or -1/2 at each, relative: 0 on a closed shape
    outward: float  # its mean over 1/2: 1 where normals look outward, -1 inward, about 0 on sheets

    @property
    def closed(self) -> bool:
        """Whether the points bound something, as far as the law holds."""
        return self.misfit <= OPEN


def gauss_law(cloud: NeighborCloud, normals: Array) -> GaussLaw:
    """Of oriented normals (n, 3), at an even subset of the points where they are many."""
    if len(normals) > ANCHORS:
        chosen = farthest_points_large(cloud.points, ANCHORS)
        cloud, normals = NeighborCloud.of(cloud.points[chosen]), normals[chosen]
    weight = np.sqrt(cloud.area)
    winding, half = _Pairs(cloud, weight).winding(normals * weight[:, None]), f32(0.5) * weight
    misfit = np.linalg.norm(np.abs(winding) - half) / np.linalg.norm(half)
    return GaussLaw(float(misfit), float((winding * half).sum() / (half * half).sum()))


def _global_signs(cloud: NeighborCloud, lines: Array) -> tuple[Array, Array]:
    """A sign for each line, (n,), and the directions of the moments behind them, (n, 3), zero on open sheets."""
    weight = np.sqrt(cloud.area)
    half = f32(0.5) * weight
    pairs = _Pairs(cloud, weight)
    found = _least_squares(pairs, half, STEPS[0][1])
    # with sides, since walls that are thin beside the spacing look like noise without
    facing = lines * _sign((found[-1] * lines).sum(1))[:, None]
    noise = cloud.noise(facing)
    moments = found[next(steps for most, steps in STEPS if not noise > most) - 1]
    along = (moments * lines).sum(1)
    sign = _sign(along)

    def winding(sign: Array) -> Array:
        return pairs.winding(lines * (sign * weight)[:, None])

    if np.linalg.norm(winding(sign) - half) <= TORN * np.linalg.norm(half):
        return sign, moments / np.maximum(np.linalg.norm(moments, axis=1, keepdims=True), f32(1e-12))
    sign = _open_signs(cloud, lines, along)
    return sign * _sign((winding(sign) * weight).sum()), np.zeros_like(lines)


class _Pairs:
    """Gauss' law between all pairs of points, each row and column times the factor (n,) of its point."""

    def __init__(self, cloud: NeighborCloud, scale: Array) -> None:
        self.points = cloud.points
        if kernels.ready():
            from pnu.kernels.dipoles import inverse_cube_rows

            self.inverse_cubes = _all_pairs(inverse_cube_rows, cloud, cloud.points, cloud.spacing, scale)
            return
        self.inverse_cubes = np.concatenate([_inverse_distances(cloud, rows, 1.0) ** 3 for rows in _blocks(scale)])
        self.inverse_cubes *= scale / f32(4 * np.pi)
        self.inverse_cubes *= scale[:, None]

    def winding(self, moments: Array) -> Array:
        """Winding number at each point, (n,), of moments (n, 3)."""
        along = (self.points * moments).sum(1)
        sums = self._sums(np.column_stack([along, moments]))
        found: Array = sums[:, 0] - (self.points * sums[:, 1:]).sum(1)
        return found

    def transposed(self, values: Array) -> Array:
        """The adjoint of `winding`: values (n,) -> (n, 3)."""
        sums = self._sums(np.column_stack([values, self.points * values[:, None]]))
        found: Array = self.points * sums[:, :1] - sums[:, 1:]
        return found

    def _sums(self, columns: Array) -> Array:
        """The matrix times columns (n, c)."""
        return _times(self.inverse_cubes, columns)


def _times(matrix: Array, columns: Array) -> Array:
    """A matrix (n, n) times columns (n, c), block by block, the same for any number of threads: (n, c)."""
    if not kernels.ready():
        return np.concatenate(threads.map_on_threads(lambda rows: matrix[rows] @ columns, _blocks(columns)))
    from pnu.kernels.dipoles import rows_times

    out, across = np.empty(columns.shape, f32), np.ascontiguousarray(columns.T)
    threads.map_on_threads(lambda rows: rows_times(matrix[rows], across, out[rows]), _blocks(columns))
    return out


def _open_signs(cloud: NeighborCloud, lines: Array, along: Array) -> Array:
    """Of an open sheet, where Gauss' law says little: the signs of least energy from several guesses.

    Guesses: the signs of the moments along the lines, lines followed from point to point, and the sides seen from 13
    directions.
    """
    from scipy.sparse.csgraph import connected_components

    dipoles = _dipoles(cloud, lines, 1.4)
    axes = np.linalg.eigh(cloud.points.T @ cloud.points)[1]
    steps = np.array([*product((-1, 0, 1), repeat=3)][14:], f32)
    piece = connected_components(_graph(cloud, lines))[1]
    surest = np.array([(np.abs(along) * (piece == i)).argmax() for i in range(piece.max() + 1)])
    guesses = [_sign(along), _spread(cloud, lines, surest, _sign(along[surest]))]
    guesses += [_sign(lines @ axes @ step) for step in steps]
    return min((_settled(dipoles, guess) for guess in guesses), key=lambda found: found[1])[0]


def _settled(dipoles: Array, sign: Array) -> tuple[Array, float]:
    """Signs turned along the field of all dipoles until they agree with it, and their energy."""
    for _ in range(20):
        along = _times(dipoles, sign[:, None])[:, 0]
        if bool((along * sign >= 0).all()):
            break
        sign = _sign(along)
    return sign, -float((sign * _times(dipoles, sign[:, None])[:, 0]).sum())


def _sign(values: NDArray[np.floating]) -> Array:
    return np.where(values < 0, f32(-1), f32(1))


def _blocks(lines: Array) -> list[slice]:
    """Rows of a matrix of all pairs, block by block."""
    return [slice(start, start + BLOCK) for start in range(0, len(lines), BLOCK)]


def _all_pairs(
    rows_of: Callable[[Array, int, Array], None], cloud: NeighborCloud, lines: Array, widths: Array, scale: Array
) -> Array:
    """A matrix (n, n) whose rows a kernel computes, on all threads."""
    from pnu.kernels.dipoles import as_sources

    sources, matrix = as_sources(cloud.points, lines, widths, scale), np.empty((len(lines), len(lines)), f32)
    threads.map_on_threads(lambda i: rows_of(sources, i, matrix[i : i + BLOCK]), range(0, len(lines), BLOCK))
    return matrix


def _dipoles(cloud: NeighborCloud, lines: Array, width: float) -> Array:
    """Field at each point, along its line, of each point's dipole, times both areas: (n, n), symmetric."""
    if kernels.ready():
        from pnu.kernels.dipoles import dipole_rows

        return _all_pairs(dipole_rows, cloud, lines, f32(width) * cloud.spacing, cloud.area)
    points, height = cloud.points, (cloud.points * lines).sum(1)
    matrix = np.empty((len(lines), len(lines)), f32)
    for rows in _blocks(lines):
        inverse = _inverse_distances(cloud, rows, width)
        there, here = height - points[rows] @ lines.T, height[rows, None] - lines[rows] @ points.T
        block = f32(3) * there * here * inverse * inverse + lines[rows] @ lines.T
        matrix[rows] = block * inverse**3 * cloud.area * cloud.area[rows, None]
    np.fill_diagonal(matrix, 0)
    return matrix


def _inverse_distances(cloud: NeighborCloud, rows: slice, width: float) -> Array:
    """1 / max(distance, width x spacing) of points `rows` from all, (r, n)."""
    size, width_sq = (cloud.points**2).sum(1), (f32(width) * cloud.spacing) ** 2 / 2
    dist_sq = size + size[rows, None] - f32(2) * (cloud.points[rows] @ cloud.points.T)
    inverse: Array = 1 / np.sqrt(np.maximum(dist_sq, width_sq + width_sq[rows, None]))
    return inverse


def _least_squares(pairs: _Pairs, target: Array, steps: int) -> list[Array]:
    """Moments (n, 3) after each step of conjugate gradients on the normal equations; early ones are smoother."""
    x, residual = np.zeros((len(target), 3), f32), target
    gradient = pairs.transposed(residual)
    direction, size, found = gradient, (gradient * gradient).sum(), []
    for _ in range(steps):
        change = pairs.winding(direction)
        step = size / max((change * change).sum(), f32(1e-30))
        x, residual = x + step * direction, residual - step * change
        found.append(x)
        gradient = pairs.transposed(residual)
        size, before = (gradient * gradient).sum(), size
        direction = gradient + size / max(before, f32(1e-30)) * direction
    return found


def _graph(cloud: NeighborCloud, lines: Array) -> csr_matrix:
    """Neighbors, both ways, by how much their lines turn and how far they leave each other's tangent plane."""
    from scipy.sparse import csr_matrix

    n, near = len(lines), cloud.idx[:, 1:13]
    cosine = (lines[:, None] * lines[near]).sum(-1)
    offset = cloud.points[near] - cloud.points[:, None]
    rise = np.abs((offset * lines[:, None]).sum(-1)) / np.maximum(np.linalg.norm(offset, axis=-1), f32(1e-12))
    cost = (f32(1.01) - np.abs(cosine) + rise).astype(np.float64)
    graph = csr_matrix((cost.ravel(), near.ravel(), np.arange(n + 1) * near.shape[1]), (n, n))
    return graph.maximum(graph.T)


def _spread(cloud: NeighborCloud, lines: Array, anchors: Index, sign: Array) -> Array:
    """Signs of all points from those of the anchors, along paths on which the lines turn least."""
    from scipy.sparse.csgraph import dijkstra

    n = len(lines)
    before = dijkstra(_graph(cloud, lines), indices=anchors, min_only=True, return_predecessors=True)[1]
    alone = before < 0
    alone[anchors] = False
    parent = np.where(before < 0, np.arange(n), before).astype(np.int64)
    if alone.any():
        parent[alone] = anchors[PointTree(cloud.points[anchors]).nearest(cloud.points[alone], 1)[1][:, 0]]
    agree = _sign((lines * lines[parent]).sum(1))
    agree[anchors] = sign
    parent[anchors] = anchors
    rooted = np.zeros(n, bool)
    rooted[anchors] = True
    while not rooted.all():  # pointer doubling
        agree = np.where(rooted, agree, agree * agree[parent])
        rooted, parent = rooted | rooted[parent], parent[parent]
    return agree


def field(cloud: NeighborCloud, normals: Array, noise: float) -> Array:
    """Minus the gradient of the neighbors' winding number at each point, as unit vectors (n, 3)."""
    width, normals = f32(1 + 3 * noise), normals.astype(f32)
    if kernels.ready():
        return _compiled_field(cloud, normals, width)
    out = np.empty_like(normals)
    for start in range(0, len(normals), ROWS):
        rows = slice(start, start + ROWS)
        idx = cloud.idx[rows, 1:]
        offset = cloud.points[idx] - cloud.points[rows, None]
        width_sq = width * width * (cloud.spacing[rows, None] ** 2 + cloud.spacing[idx] ** 2) / 2
        dist_sq = np.maximum((offset**2).sum(-1), width_sq)[..., None]
        along = (normals[idx] * offset).sum(-1, keepdims=True)
        dipoles = (normals[idx] - 3 * along / dist_sq * offset) * cloud.area[idx][..., None] / dist_sq ** f32(1.5)
        total = dipoles.sum(1)
        out[rows] = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), f32(1e-12))
    return out


def _compiled_field(cloud: NeighborCloud, normals: Array, width: f32) -> Array:
    from pnu.kernels.dipoles import as_sources, neighbor_field

    sources = np.ascontiguousarray(as_sources(cloud.points, normals, width * cloud.spacing, cloud.area).T)
    idx, found = np.ascontiguousarray(cloud.idx), np.empty((len(normals), 3), f32)
    parts = range(0, len(found), CHUNK)
    threads.map_on_threads(lambda i: neighbor_field(sources, idx, i, found[i : i + CHUNK]), parts)
    return found
