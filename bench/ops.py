"""Searches and samplings at training size against plain torch versions with full distance matrices."""

import torch
from torch import Tensor

from bench.timing import Row, compare
from pnu.ops.nearest import ball_query, knn, nearest
from pnu.ops.sampling import farthest_points

CLOUDS, POINTS = 20, 4096


def full_matrix(query: Tensor, target: Tensor) -> Tensor:
    return torch.cdist(query, target, compute_mode="donot_use_mm_for_euclid_dist")


def plain_farthest_points(points: Tensor, m: int) -> Tensor:
    """All distances first, then one row a step."""
    cloud = torch.arange(len(points))
    matrix = full_matrix(points, points)
    reach = torch.full(points.shape[:2], torch.inf)
    chosen = torch.zeros(len(points), m, dtype=torch.int64)
    for i in range(1, m):
        reach = torch.minimum(reach, matrix[cloud, chosen[:, i - 1]])
        chosen[:, i] = reach.argmax(1)
    return chosen


def plain_ball_query(query: Tensor, target: Tensor, radius: float, k: int) -> Tensor:
    n = target.shape[1]
    found = torch.where(full_matrix(query, target) < radius, torch.arange(n), n).sort(-1).values[..., :k]
    return torch.where(found < n, found, found[..., :1] % n)


def main() -> list[Row]:
    """One row an operation; goal: ten times faster on two threads."""
    points = torch.rand(CLOUDS, POINTS, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    centers = points[:, :1024].contiguous()
    return [
        compare(
            f"16 nearest, {CLOUDS} x {POINTS}",
            {
                "tree": lambda: knn(points, points, 16),
                "full matrix, topk": lambda: full_matrix(points, points).topk(16, largest=False),
            },
        ),
        compare(
            f"nearest, {CLOUDS} x {POINTS}",
            {"tree": lambda: nearest(points, points), "full matrix, min": lambda: full_matrix(points, points).min(-1)},
        ),
        compare(
            f"farthest points, {CLOUDS} x {POINTS} -> 1024",
            {
                "buckets": lambda: farthest_points(points, 1024),
                "full matrix, loop": lambda: plain_farthest_points(points, 1024),
            },
            rounds=3,
        ),
        compare(
            f"ball query r = 0.1, {CLOUDS} x 1024 in 1024",
            {
                "tree": lambda: ball_query(centers, centers, 0.1, 32),
                "full matrix, sort": lambda: plain_ball_query(centers, centers, 0.1, 32),
            },
        ),
    ]


if __name__ == "__main__":
    torch.set_num_threads(2)
    for row in main():
        print(row)
