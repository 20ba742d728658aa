"""Midpoints between neighboring points."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.neighbor_search import knn
from pnu.runtime.progress import Progress
from pnu.upsamplers.context import Context


class Midpoint:
    """Midpoints between each point and its nearest ones with the mean of their normals, then farthest points.

    Repeated where the points and midpoints of one pass are not enough.

    Args:
        neighbors: of each point; with 10, a pass has about seven points for each one.
    """

    def __init__(self, neighbors: int = 10) -> None:
        if neighbors < 1:  # without pairs it would go on for ever
            raise ValueError(f"neighbors={neighbors}: expected at least 1")
        self.neighbors = neighbors

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6); nothing is random."""
        cloud = cloud.cpu()
        while True:
            near = knn(cloud[None, :, :3], cloud[None, :, :3], min(self.neighbors + 1, len(cloud))).idx[0]
            here = torch.arange(len(cloud))[:, None].expand_as(near)
            pairs = torch.stack([torch.minimum(here, near), torch.maximum(here, near)], -1).flatten(0, 1)
            pairs = torch.unique(pairs[pairs[:, 0] != pairs[:, 1]], dim=0)
            middle = cloud[pairs].mean(1)
            opposite = middle[:, 3:].norm(dim=1, keepdim=True) < 1e-6
            normals = torch.where(opposite, cloud[pairs[:, 0], 3:], normalize(middle[:, 3:], dim=1))
            everything = torch.cat([cloud, torch.cat([middle[:, :3], normals], 1)])
            if len(everything) >= 1.5 * count:
                return evenly_spread(everything, count, context.progress)
            cloud = evenly_spread(everything, min(len(everything), 4 * len(cloud)), context.progress)


def evenly_spread(cloud: Tensor, count: int, progress: Progress) -> Tensor:
    """Farthest points, exactly `count`."""
    stage = f"farthest points, {count} of {len(cloud)}"
    progress(stage, 0, 1)
    kept = cloud[farthest_points_large(cloud[:, :3].numpy(), count)]
    progress(stage, 1, 1)
    return kept
