"""Closed meshes of implicit surfaces: fields, smooth blends, and their zero level by surface nets.

A field maps points (n, 3) to values (n,), negative inside; close to the surface it is about the signed distance.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from pnu.io import Mesh

Field = Callable[[np.ndarray], np.ndarray]

BLOCK = 4  # grid points along a side of the blocks that are skipped where the surface is far
STEEPEST = 2.5  # of a field, with a margin
FINE = 20_000  # faces; a mesh of fewer shows its facets


def sphere(center: ArrayLike, radius: float) -> Field:
    """Distance to a sphere, negative inside."""
    return lambda p: np.linalg.norm(p - np.asarray(center), axis=1) - radius


def ellipsoid(center: ArrayLike, radii: ArrayLike, rotation: np.ndarray | None = None) -> Field:
    """Ellipsoid whose axes are the columns of `rotation` (3, 3); the field is a distance to first order."""
    center, radii = np.asarray(center), np.asarray(radii)

    def field(p: np.ndarray) -> np.ndarray:
        q = (p - center) if rotation is None else (p - center) @ rotation
        k = np.linalg.norm(q / radii, axis=1)
        distance: np.ndarray = k * (k - 1) / np.maximum(np.linalg.norm(q / radii**2, axis=1), 1e-9)
        return distance

    return field


def capsule(start: ArrayLike, end: ArrayLike, radius: float, end_radius: float | None = None) -> Field:
    """Segment with round ends and a radius that goes linearly from `radius` to `end_radius`."""
    start, axis = np.asarray(start, float), np.asarray(end, float) - np.asarray(start, float)
    slope = 0.0 if end_radius is None else end_radius - radius

    def field(p: np.ndarray) -> np.ndarray:
        t = np.clip((p - start) @ axis / (axis @ axis), 0, 1)
        distance: np.ndarray = np.linalg.norm(p - start - t[:, None] * axis, axis=1) - (radius + slope * t)
        return distance

    return field


def polyline(points: np.ndarray, radii: ArrayLike, k: float = 0.0) -> Field:
    """Chain of capsules through points (m, 3) with radii (m,), blended over a distance of about k."""
    radius = np.asarray(radii, float)
    parts = [capsule(points[i], points[i + 1], radius[i], radius[i + 1]) for i in range(len(points) - 1)]
    return union(*parts, k=k)


def torus(center: ArrayLike, major: float, minor: float, axis: int = 2) -> Field:
    """Distance to a torus, negative inside."""
    center = np.asarray(center)

    def field(p: np.ndarray) -> np.ndarray:
        q = p - center
        ring = np.linalg.norm(np.delete(q, axis, axis=1), axis=1) - major
        distance: np.ndarray = np.hypot(ring, q[:, axis]) - minor
        return distance

    return field


def union(*fields: Field, k: float = 0.0) -> Field:
    """Union; with k > 0 a smooth one, -k log sum exp(-f / k), which fills creases over a distance of about k."""
    if k == 0:
        return lambda p: np.minimum.reduce([f(p) for f in fields])

    def field(p: np.ndarray) -> np.ndarray:
        values = np.stack([f(p) for f in fields])
        low = values.min(axis=0)
        blended: np.ndarray = low - k * np.log(np.exp((low - values) / k).sum(axis=0))
        return blended

    return field


def cut(field: Field, *tools: Field, k: float = 0.02) -> Field:
    """What is left of a body after tools were carved out of it, with creases rounded over about k."""
    carved = union(lambda p: -field(p), *tools, k=k)
    return lambda p: -carved(p)


def surface_nets(field: Field, bound: ArrayLike, cells: int = 72) -> Mesh:
    """Zero level of a field inside the box |x| <= bound, one vertex in each cell that the surface crosses.

    Gibson's surface nets: a cell's vertex is the mean of the crossings on its edges; here Newton steps along the
    field's gradient then put it on the surface itself. `cells` counts along the longest side. A mesh of few faces, as
    thin shapes have, is refined: its faces lie within about 3 degrees of the surface in the mean. The surface must not
    reach the box.
    """
    bound = np.broadcast_to(np.asarray(bound, float), 3)
    step = 2 * bound.max() / cells
    size = np.ceil(2 * bound / step).astype(int) + 1
    axes = [step * (np.arange(n) - (n - 1) / 2) for n in size]
    values = sampled(field, axes, step)

    crossings, cells_of, outward = [], [], []
    strides = np.array([size[1] * size[2], size[2], 1])
    for axis in range(3):
        lower = np.take(values, range(size[axis] - 1), axis)
        upper = np.take(values, range(1, size[axis]), axis)
        start = np.argwhere((lower < 0) != (upper < 0))
        a, b = lower[tuple(start.T)], upper[tuple(start.T)]
        position = start.astype(float)
        position[:, axis] += a / (a - b)
        crossings.append(position)
        u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        ring = start[:, None, :] - np.stack([u + v, v, 0 * u, u])  # the four cells around an edge, right-handed
        cells_of.append(ring @ strides)
        outward.append(a < 0)

    corner = np.concatenate(cells_of)  # (edges, 4) cell numbers
    used, quads = np.unique(corner, return_inverse=True)
    quads = quads.reshape(corner.shape)
    count = np.bincount(quads.ravel(), minlength=len(used))
    where = np.repeat(np.concatenate(crossings), 4, axis=0)
    mean = np.stack([np.bincount(quads.ravel(), w, len(used)) for w in where.T], axis=1) / count[:, None]
    vertices = project((mean - (size - 1) / 2) * step, field, step)
    quads = np.where(np.concatenate(outward)[:, None], quads, quads[:, ::-1])
    faces = split_quads(vertices, quads)
    if len(faces) < FINE:
        known = len(vertices)
        vertices, faces = subdivided(vertices, faces)
        vertices[known:] = project(vertices[known:], field, step / 2, rounds=1)
    return Mesh(vertices, faces)


def sampled(field: Field, axes: Sequence[np.ndarray], step: float) -> np.ndarray:
    """Values on a grid, none of them 0; in blocks that the surface does not reach, their middle's."""
    size = [len(axis) for axis in axes]
    blocks = [-(-n // BLOCK) for n in size]
    middles = [axis[0] + step * (BLOCK * np.arange(n) + (BLOCK - 1) / 2) for axis, n in zip(axes, blocks, strict=True)]
    coarse = field(np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 3)).reshape(blocks)
    values = coarse
    for axis in range(3):
        values = np.repeat(values, BLOCK, axis).take(range(size[axis]), axis)
    reach = STEEPEST * step * np.sqrt(3) * (BLOCK + 1) / 2
    index = np.argwhere(np.abs(values) < reach)
    for part in np.array_split(index, max(1, len(index) // 50_000)):
        points = np.stack([axis[i] for axis, i in zip(axes, part.T, strict=True)], axis=1)
        values[tuple(part.T)] = field(points)
    values[values == 0] = 1e-12
    return values


def subdivided(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each triangle as four, cut at the middles of its edges."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)  # edge i of a face: from its corner i to the next
    unique, middle = np.unique(np.sort(edges, axis=-1).reshape(-1, 2), axis=0, return_inverse=True)
    middle = len(vertices) + middle.reshape(-1, 3)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([vertices, vertices[unique].mean(1)]), np.concatenate([np.stack(p, axis=1) for p in parts])


def project(vertices: np.ndarray, field: Field, step: float, rounds: int = 3) -> np.ndarray:
    """Newton steps onto the zero level along the gradient, each at most half a cell of size `step`."""
    h = 1e-4 * step
    for _ in range(rounds):
        value = field(vertices)
        gradient = np.stack([field(vertices + h * e) - value for e in np.eye(3)], axis=1) / h
        length = np.maximum(np.linalg.norm(gradient, axis=1), 1e-9)
        move = np.clip(value / length, -step / 2, step / 2)
        vertices = vertices - (move / length)[:, None] * gradient
    return vertices


def split_quads(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Two triangles for each quad (q, 4), along its shorter diagonal: faces (2 q, 3)."""
    a, b, c, d = (vertices[quads[:, i]] for i in range(4))
    other = np.linalg.norm(b - d, axis=1) < np.linalg.norm(a - c, axis=1)
    quads = np.where(other[:, None], np.roll(quads, -1, axis=1), quads)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
