"""What the faces around vertices and edges of a triangle mesh tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pnu.io import Mesh


def vertex_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Unit normals `(v, 3)`, the mean of the faces around each vertex weighted by area; zero where there is none."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    weighted = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = [np.bincount(mesh.faces.ravel(), column, len(mesh.vertices)) for column in weighted.T]
    total = np.stack(sums, axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.divide(total, length, out=np.zeros_like(total), where=length > 0)


def open_edges(mesh: Mesh) -> int:
    """Edges that not as many faces run along in one direction as in the other; 0 for a watertight mesh.

    So holes count, and faces that turn the other way than their neighbours. Vertices at the same place are one.
    """
    _, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    edge = np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)
    _, edge = np.unique(edge, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge, np.where(start < end, 1, -1))))
