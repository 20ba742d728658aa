"""Triangle meshes as surfaces: areas, samples with normals, closest points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.triangle_tree import closest_on_triangles

if TYPE_CHECKING:
    from pnu.io import Mesh


def face_areas(mesh: Mesh) -> np.ndarray:
    """Area of each face, (f,), in the mesh's unit squared."""
    areas: np.ndarray = 0.5 * np.linalg.norm(_cross(mesh), axis=1)
    return areas


def face_normals(mesh: Mesh) -> np.ndarray:
    """Unit normal of each face, (f, 3), counter-clockwise side; zero for a face without area."""
    cross = _cross(mesh)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    unit: np.ndarray = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)
    return unit


def signed_volume(mesh: Mesh) -> float:
    """Enclosed volume of a closed mesh; negative where its faces look inward."""
    a, b, c = _corners(mesh)
    return float(np.einsum("ij,ij->", a - mesh.vertices.mean(0), np.cross(b - a, c - a)) / 6)


def sample_area(mesh: Mesh, n: int, rng: np.random.Generator) -> np.ndarray:
    """n independent points, uniform by area, with their face's normal: (n, 6). ValueError for a mesh without area."""
    cumulative = np.cumsum(face_areas(mesh))
    if not len(cumulative) or not cumulative[-1] > 0:
        raise ValueError(f"mesh: expected faces with an area, found {len(mesh.faces)} faces without")
    face = np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right").clip(max=len(cumulative) - 1)
    root, v = np.sqrt(rng.random((n, 1))), rng.random((n, 1))
    a, b, c = (corner[face] for corner in _corners(mesh))
    return np.hstack([(1 - root) * a + root * (1 - v) * b + root * v * c, face_normals(mesh)[face]])


def sample_poisson_disk(mesh: Mesh, n: int, rng: np.random.Generator) -> np.ndarray:
    """Exactly n evenly spread points (blue noise) with normals, (n, 6): farthest points of a dense area sample."""
    dense = sample_area(mesh, 8 * n, rng)
    even: np.ndarray = dense[farthest_points_large(dense[:, :3], n)]
    return even


def closest_points(mesh: Mesh, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The point of the surface closest to each query (m, 3), exactly: (points (m, 3), distance (m,), face (m,)).

    ValueError for a mesh without faces.
    """
    if not len(mesh.faces):
        raise ValueError("mesh: expected at least one face, found none")
    return closest_on_triangles(np.asarray(queries, float), np.stack(_corners(mesh), 1))


def _corners(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return mesh.vertices[mesh.faces[:, 0]], mesh.vertices[mesh.faces[:, 1]], mesh.vertices[mesh.faces[:, 2]]


def _cross(mesh: Mesh) -> np.ndarray:
    a, b, c = _corners(mesh)
    return np.cross(b - a, c - a)
