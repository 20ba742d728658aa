"""Seeds between the points, projected onto their algebraic point set surface."""

import torch
from torch import Tensor

from pnu.geometry.algebraic_sphere import apss_project
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.neighbor_search import knn, nearest
from pnu.upsamplers.context import Context
from pnu.upsamplers.midpoints import evenly_spread


class APSS:
    """Random seeds around the points, projected onto their algebraic point set surface, then farthest points.

    A seed is a random convex combination of a point and two of its `reach` nearest, so that holes of the sampling get
    seeds too. Guennebaud and Gross 2007; `pnu.geometry.algebraic_sphere` has the equations.

    Args:
        neighbors: of a sphere fit; few keep detail, many average noise.
        seeds: for each point wanted; half of them, evenly spread, are projected.
        reach: neighbors of a point that its seeds may lie between.
    """

    def __init__(self, neighbors: int = 10, seeds: int = 8, reach: int = 30) -> None:
        for name, value, least in (("neighbors", neighbors, 4), ("seeds", seeds, 2), ("reach", reach, 2)):
            if value < least:
                raise ValueError(f"{name}={value}: expected at least {least}")
        self.neighbors, self.seeds, self.reach = neighbors, seeds, reach

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6)."""
        cloud = cloud.cpu()
        context.progress("seeds", 0, 1)
        seeds = _between(cloud[:, :3], -(-self.seeds * count // len(cloud)), self.reach, context.generator)
        seeds = seeds[farthest_points_large(seeds.numpy(), min(len(seeds), self.seeds * count // 2))]
        context.progress("seeds", 1, 1)
        context.progress("projection", 0, 1)
        projected = apss_project(seeds, cloud, min(self.neighbors, len(cloud)))
        context.progress("projection", 1, 1)
        return evenly_spread(projected[_least_moved(seeds, projected, cloud, count)], count, context.progress)


def _between(points: Tensor, each: int, reach: int, generator: torch.Generator) -> Tensor:
    """Random convex combinations of each point and two of its `reach` nearest others: (n, 3) -> (n each, 3)."""
    n = len(points)
    near = knn(points[None], points[None], min(reach, n)).idx[0]
    which = torch.randint(1, near.shape[1], (n, each, 2), generator=generator)
    corners = [torch.arange(n)[:, None].expand(n, each), *(near.gather(1, which[..., i]) for i in range(2))]
    weights = torch.rand(n, each, 3, generator=generator, dtype=points.dtype).clamp(min=1e-12).log()
    weights = weights / weights.sum(-1, keepdim=True)  # exponential variables over their sum: uniform in the triangle
    return sum(points[corner] * weights[..., i, None] for i, corner in enumerate(corners)).reshape(-1, 3)  # type: ignore[union-attr]


def _least_moved(seeds: Tensor, projected: Tensor, cloud: Tensor, count: int) -> Tensor:
    """Indices of the seeds that moved less than the local spacing of the cloud, and at least `count` of them."""
    points = cloud[None, :, :3]
    spacing = knn(points, points, min(9, len(cloud))).dist_sq[0, :, -1].sqrt()
    local = spacing[nearest(projected[None, :, :3], points).idx[0]]
    moved: Tensor = (projected[:, :3] - seeds).norm(dim=1) / local.clamp(min=torch.finfo(local.dtype).tiny)
    kept = max(count, int((moved < 1).sum()))
    return moved.argsort()[:kept]
