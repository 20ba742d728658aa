"""Sharp edges of a triangle mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pnu.geometry.mesh_sampling import face_areas, face_normals

if TYPE_CHECKING:
    from pnu.io import Mesh


def sharp_edges(mesh: Mesh, angle: float = 40.0) -> np.ndarray:
    """Edges whose two faces meet at more than `angle` degrees: (e, 2, 3), their end points.

    The angle is that between the normals. Vertices at the same place count as one; faces without area, and edges with
    fewer or more than two faces, do not count.
    """
    vertices, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    solid = face_areas(mesh) > 0
    faces, normals = same.reshape(-1)[mesh.faces[solid]], face_normals(mesh)[solid]
    edge = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    face = np.repeat(np.arange(len(faces)), 3)
    unique, which, count = np.unique(edge, axis=0, return_inverse=True, return_counts=True)
    pairs = face[np.argsort(which.reshape(-1), kind="stable")]
    first = (np.cumsum(count) - count)[count == 2]
    cosine = np.einsum("ij,ij->i", normals[pairs[first]], normals[pairs[first + 1]])
    sharp: np.ndarray = vertices[unique[count == 2][cosine < np.cos(np.radians(angle))]]
    return sharp


def sharp_edge_points(mesh: Mesh, spacing: float, angle: float = 40.0) -> np.ndarray:
    """Points along the sharp edges, at most `spacing` apart, both ends of each edge among them: (p, 3)."""
    edges = sharp_edges(mesh, angle)
    if not len(edges):
        return np.empty((0, 3))
    steps = np.ceil(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) / spacing).astype(int).clip(min=1) + 1
    edge = np.repeat(np.arange(len(edges)), steps)
    place = np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)
    share = (place / (steps[edge] - 1))[:, None]
    points: np.ndarray = (1 - share) * edges[edge, 0] + share * edges[edge, 1]
    return points
