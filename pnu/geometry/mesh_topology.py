"""What the faces around vertices and edges of a triangle mesh tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.ragged import chunks, expand_counts

if TYPE_CHECKING:
    from pnu.io import Mesh

CREASE_DEG = 40.0  # edges sharper than this stay sharp under smooth shading


def vertex_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Unit normals `(v, 3)`, the mean of the faces around each vertex weighted by area; zero where there is none."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    weighted = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = [np.bincount(mesh.faces.ravel(), column, len(mesh.vertices)) for column in weighted.T]
    total = np.stack(sums, axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(total, length, out=np.zeros_like(total), where=length > 0)
    return unit


def corner_normals(mesh: Mesh, smooth: bool = True) -> NDArray[np.float64]:
    """Unit normals `(f, 3, 3)` at the corners of each face; with `smooth` False, the face's own.

    Smooth: the mean, weighted by area, over the faces around the vertex that make no sharp edge with this one.
    """
    corners = mesh.vertices[mesh.faces]
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-300)
    if not smooth:
        return np.repeat(flat[:, None], 3, 1)
    vertex = mesh.faces.ravel()
    by_vertex = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=len(mesh.vertices))
    first = np.cumsum(count) - count
    total = np.zeros((len(vertex), 3))
    for part in chunks(count[vertex]):
        corner, step = expand_counts(count[vertex[part]])
        corner += part.start
        other = by_vertex[first[vertex[corner]] + step] // 3
        joined = (flat[corner // 3] * flat[other]).sum(1) > np.cos(np.radians(CREASE_DEG))
        for k in range(3):
            total[part, k] = np.bincount(
                corner[joined] - part.start, weighted[other[joined], k], part.stop - part.start
            )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-300), 0).reshape(-1, 3, 3)


def split_creases(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Vertices `(w, 3)`, their normals `(w, 3)` and faces `(f, 3)`: vertices on sharp edges once for each side."""
    normals = corner_normals(mesh).reshape(-1, 3)
    corner = np.column_stack([mesh.faces.ravel(), np.rint(100 * normals)])
    _, first, index = np.unique(corner, axis=0, return_index=True, return_inverse=True)
    vertex = mesh.faces.ravel()[first]
    return mesh.vertices[vertex], normals[first], index.reshape(-1, 3)


def open_edges(mesh: Mesh) -> int:
    """Edges that not as many faces run along in one direction as in the other; 0 for a watertight mesh.

    So holes count, and faces that turn the other way than their neighbors. Vertices at the same place are one.
    """
    _, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    edge = np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)
    _, edge = np.unique(edge, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge, np.where(start < end, 1, -1))))
