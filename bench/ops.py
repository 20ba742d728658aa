"""Searches and samplings at training size against plain torch with full distance matrices, SciPy and Open3D."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from bench.timing import Row, compare
from pnu.geometry.neighbor_search import ball_query, knn, nearest
from pnu.geometry.sampling import farthest_points

CLOUDS, POINTS = 20, 4096


def full_matrix(query: Tensor, target: Tensor) -> Tensor:
    return torch.cdist(query, target, compute_mode="donot_use_mm_for_euclid_dist")


def plain_farthest_points(points: Tensor, m: int) -> Tensor:
    """All distances first, then one row a step."""
    cloud = torch.arange(len(points), device=points.device)
    matrix = full_matrix(points, points)
    reach = torch.full(points.shape[:2], torch.inf, device=points.device)
    chosen = torch.zeros(len(points), m, dtype=torch.int64, device=points.device)
    for i in range(1, m):
        reach = torch.minimum(reach, matrix[cloud, chosen[:, i - 1]])
        chosen[:, i] = reach.argmax(1)
    return chosen


def plain_ball_query(query: Tensor, target: Tensor, radius: float, k: int) -> Tensor:
    n = target.shape[1]
    found = (
        torch.where(full_matrix(query, target) < radius, torch.arange(n, device=query.device), n)
        .sort(-1)
        .values[..., :k]
    )
    return torch.where(found < n, found, found[..., :1] % n)


def plain_closest_points(points: Tensor, corners: Tensor) -> Tensor:
    """Of points (m, 3) on triangles (t, 3, 3), all pairs at once: the nearest of the sides, or the foot within them."""
    side = corners.roll(-1, 1) - corners
    normal = torch.linalg.cross(side[:, 0], side[:, 1])
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-30)
    away = points[:, None, None] - corners
    along = ((away * side).sum(-1) / side.square().sum(-1).clamp(min=1e-30)).clamp(0, 1)
    of_sides = away - along[..., None] * side
    inside = ((away * torch.linalg.cross(normal[:, None].expand_as(side), side)).sum(-1) >= 0).all(-1)
    height = (away[:, :, 0] * normal).sum(-1, keepdim=True) * normal
    nearest = of_sides.norm(dim=-1).argmin(-1)
    to_side = of_sides.gather(2, nearest[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
    step = torch.where(inside[..., None], height, to_side)
    face = step.norm(dim=-1).argmin(1)
    return points - step[torch.arange(len(points), device=points.device), face]


def open3d_knn(points: np.ndarray, k: int) -> None:
    """Open3D's tensor search, one cloud after the other."""
    import open3d.core as o3c

    for cloud in points:
        tensor = o3c.Tensor(cloud)
        search = o3c.nns.NearestNeighborSearch(tensor)
        search.knn_index()
        search.knn_search(tensor, k)


def scipy_knn(points: np.ndarray, k: int) -> None:
    for cloud in points:
        cKDTree(cloud).query(cloud, k=k, workers=torch.get_num_threads())


def open3d_farthest_points(points: np.ndarray, m: int) -> None:
    import open3d

    for cloud in points:
        open3d.t.geometry.PointCloud(open3d.core.Tensor(cloud)).farthest_point_down_sample(m)


def rows() -> list[Row]:
    """One row an operation; goal on two threads: ten times faster than plain torch."""
    points = torch.rand(CLOUDS, POINTS, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    centers = points[:, :1024].contiguous()
    arrays = points.numpy()
    return [
        compare(
            f"16 nearest, {CLOUDS} x {POINTS}",
            {
                "pnu": lambda: knn(points, points, 16),
                "plain torch: full matrix, topk": lambda: full_matrix(points, points).topk(16, largest=False),
                "SciPy cKDTree, cloud by cloud": lambda: scipy_knn(arrays, 16),
                "Open3D, cloud by cloud": lambda: open3d_knn(arrays, 16),
            },
        ),
        compare(
            f"nearest, {CLOUDS} x {POINTS}",
            {
                "pnu": lambda: nearest(points, points),
                "plain torch: full matrix, min": lambda: full_matrix(points, points).min(-1),
                "SciPy cKDTree, cloud by cloud": lambda: scipy_knn(arrays, 1),
                "Open3D, cloud by cloud": lambda: open3d_knn(arrays, 1),
            },
        ),
        compare(
            f"farthest points, {CLOUDS} x {POINTS} -> 1024",
            {
                "pnu": lambda: farthest_points(points, 1024),
                "plain torch: full matrix, loop": lambda: plain_farthest_points(points, 1024),
                "Open3D, cloud by cloud": lambda: open3d_farthest_points(arrays, 1024),
            },
            rounds=3,
        ),
        compare(
            f"ball query r = 0.1, {CLOUDS} x 1024 in 1024",
            {
                "pnu": lambda: ball_query(centers, centers, 0.1, 32),
                "plain torch: full matrix, sort": lambda: plain_ball_query(centers, centers, 0.1, 32),
            },
        ),
    ]
