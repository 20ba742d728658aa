"""Triangle meshes as surfaces: areas, samples with normals, closest points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from pnu.ops.sampling import farthest_points_large

if TYPE_CHECKING:
    from pnu.io import Mesh


def face_areas(mesh: Mesh) -> np.ndarray:
    """Area of each face, (f,), in the mesh's unit squared."""
    return 0.5 * np.linalg.norm(_cross(mesh), axis=1)


def face_normals(mesh: Mesh) -> np.ndarray:
    """Unit normal of each face, (f, 3), counter-clockwise side; zero for a face without area."""
    cross = _cross(mesh)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)


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
    return dense[farthest_points_large(dense[:, :3], n)]


def closest_points(mesh: Mesh, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The point of the surface closest to each query (m, 3), exactly: (points (m, 3), distance (m,), face (m,))."""
    corners, owner, radius = _pieces(mesh)
    tree = cKDTree(corners.mean(1))
    m = len(queries)
    point, distance, face = np.empty((m, 3)), np.full(m, np.inf), np.zeros(m, np.int64)
    triangles = np.stack(_corners(mesh), 1)
    todo, k = np.arange(m), min(16, len(owner))
    while len(todo):
        rows = max(1, 2**20 // k)
        left = []
        for i in range(0, len(todo), rows):
            part = todo[i : i + rows]
            far, found = tree.query(queries[part], k=np.arange(1, k + 1))
            candidate = owner[found]
            where = _closest_on_triangle(queries[part][:, None], triangles[candidate])
            length = np.linalg.norm(where - queries[part][:, None], axis=-1)
            best = length.argmin(1)
            row = np.arange(len(part))
            point[part], distance[part], face[part] = where[row, best], length[row, best], candidate[row, best]
            # an unseen piece is at least far[-1] - radius away
            left.append(part[(far[:, -1] - radius < distance[part]) & (k < len(owner))])
        todo, k = np.concatenate(left), min(4 * k, len(owner))
    return point, distance, face


def _corners(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return mesh.vertices[mesh.faces[:, 0]], mesh.vertices[mesh.faces[:, 1]], mesh.vertices[mesh.faces[:, 2]]


def _cross(mesh: Mesh) -> np.ndarray:
    a, b, c = _corners(mesh)
    return np.cross(b - a, c - a)


def _pieces(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, float]:
    """Triangles cut at their longest edge until all are small: corners (p, 3, 3), face of each, largest radius."""
    corners, owner = np.stack(_corners(mesh), 1), np.arange(len(mesh.faces))
    small = 1.5 * np.sqrt(face_areas(mesh).sum() / max(2 * len(owner), 20_000))
    done, done_owner, largest = [], [], 0.0
    while len(owner):
        radius = np.linalg.norm(corners - corners.mean(1, keepdims=True), axis=2).max(1)
        fits = radius <= small
        largest = max(largest, float(radius[fits].max(initial=0)))
        done.append(corners[fits])
        done_owner.append(owner[fits])
        corners, owner = corners[~fits], owner[~fits]
        edge = np.linalg.norm(corners - np.roll(corners, -1, 1), axis=2).argmax(1)
        turned = np.take_along_axis(corners, (edge[:, None] + np.arange(3))[:, :, None] % 3, 1)
        middle = turned[:, :2].mean(1)
        corners = np.concatenate([np.stack([turned[:, 0], middle, turned[:, 2]], 1),
                                  np.stack([middle, turned[:, 1], turned[:, 2]], 1)])  # fmt: skip
        owner = np.concatenate([owner, owner])
    return np.concatenate(done), np.concatenate(done_owner), largest


def _closest_on_triangle(query: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Closest point of triangles (..., 3, 3) to query (..., 3): the plane's if inside, else the best of the edges'."""
    best, best_sq = triangle[..., 0, :], np.full(triangle.shape[:-2], np.inf)
    for i in range(3):
        start = triangle[..., i, :]
        edge = triangle[..., (i + 1) % 3, :] - start
        length_sq = (edge**2).sum(-1)
        along = ((query - start) * edge).sum(-1) / np.where(length_sq > 0, length_sq, 1)
        point = start + along.clip(0, 1)[..., None] * edge
        dist_sq = ((query - point) ** 2).sum(-1)
        closer = dist_sq < best_sq
        best, best_sq = np.where(closer[..., None], point, best), np.where(closer, dist_sq, best_sq)
    a, ab, ac = (
        triangle[..., 0, :],
        triangle[..., 1, :] - triangle[..., 0, :],
        triangle[..., 2, :] - triangle[..., 0, :],
    )
    normal = np.cross(ab, ac)
    norm_sq = (normal**2).sum(-1)
    safe = np.where(norm_sq > 0, norm_sq, 1)
    v = (np.cross(query - a, ac) * normal).sum(-1) / safe
    w = (np.cross(ab, query - a) * normal).sum(-1) / safe
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (norm_sq > 0)
    return np.where(inside[..., None], a + v[..., None] * ab + w[..., None] * ac, best)
