"""Slow, obviously right twins of the fast operations."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def knn(query: Array, target: Array, k: int) -> tuple[Array, Index]:
    """Squared distances and indices (m, k) of the k nearest targets, the lower index first among equals."""
    dist_sq = np.array([[((q - t) ** 2).sum() for t in target] for q in query])
    idx = np.argsort(dist_sq, axis=1, kind="stable")[:, :k]
    return np.take_along_axis(dist_sq, idx, 1), idx


def ball_query(query: Array, target: Array, radius: float, k: int) -> Index:
    """First k targets in storage order with distance < radius; the first repeated, or 0."""
    rows = []
    for q in query:
        found = [j for j, t in enumerate(target) if np.linalg.norm(q - t) < radius][:k]
        rows.append((found + [found[0] if found else 0] * k)[:k])
    return np.array(rows, np.int64).reshape(-1, k)


def farthest_points(points: Array, m: int, start: int = 0, skip_near_origin: bool = False) -> Index:
    """Greedy farthest points; the lower index first among equals."""
    chosen = [start]
    while len(chosen) < m:
        best, best_sq = 0, -1.0
        for i, p in enumerate(points):
            if skip_near_origin and (p**2).sum() <= 1e-3:
                continue
            if not skip_near_origin and i in chosen:
                continue
            dist_sq = min(((p - points[c]) ** 2).sum() for c in chosen)
            if dist_sq > best_sq:
                best, best_sq = i, dist_sq
        chosen.append(best)
    return np.array(chosen, np.int64)


def interpolate(features: Array, points: Array, query: Array, k: int = 3) -> Array:
    """Inverse distance weighted mean over the k nearest points."""
    dist_sq, idx = knn(query, points, k)
    out = np.zeros((len(query), features.shape[1]))
    for i in range(len(query)):
        weight = [1 / (np.sqrt(d) + 1e-8) for d in dist_sq[i]]
        for w, j in zip(weight, idx[i], strict=True):
            out[i] += w / sum(weight) * features[j]
    return out


def plane_normals(points: Array, k: int) -> Array:
    """Last right singular vector of the k nearest points about their mean; sign arbitrary."""
    _, idx = knn(points, points, k)
    return np.array([np.linalg.svd(points[i] - points[i].mean(0))[2][2] for i in idx])


def closest_on_triangle(query: Array, triangle: Array) -> Array:
    """Closest point of one triangle (3, 3): the foot on its plane if inside, else the best of the feet on its edges."""
    a, b, c = triangle
    v, w = np.linalg.lstsq(np.stack([b - a, c - a], 1), query - a, rcond=None)[0]
    if v >= 0 and w >= 0 and v + w <= 1:
        return a + v * (b - a) + w * (c - a)
    feet = []
    for start, end in ((a, b), (b, c), (c, a)):
        length_sq = ((end - start) ** 2).sum()
        along = np.clip(np.dot(query - start, end - start) / length_sq, 0, 1) if length_sq else 0.0
        feet.append(start + along * (end - start))
    return min(feet, key=lambda foot: np.linalg.norm(query - foot))


def closest_points(vertices: Array, faces: Index, queries: Array) -> Array:
    """Distance (m,) of each query to the surface, by trying every face."""
    return np.array([min(np.linalg.norm(q - closest_on_triangle(q, vertices[f])) for f in faces) for q in queries])
