"""Cut a cloud into overlapping patches and put patches together again."""

import torch
from torch import Tensor

from pnu.ops.nearest import knn, nearest
from pnu.ops.sampling import farthest_points_large


def extract(cloud: Tensor, count: int, size: int, *, cover: bool = False) -> Tensor:
    """Patches of a cloud: centres by farthest point sampling, the `size` nearest points of each, by distance.

    cloud (n, 3) or (n, 6) -> idx (count, size) int64. With `cover`, patches are added around points that lie in none
    until every point lies in one, so there may be more than `count`. ValueError if count or size is not in 1..n.
    """
    points = cloud[:, :3].detach()
    centers = torch.from_numpy(farthest_points_large(points, count)).to(points.device)
    idx = _around(points, centers, size)
    while cover:
        missed = torch.ones(len(points), dtype=torch.bool, device=points.device)
        missed[idx.flatten()] = False
        left = missed.nonzero().flatten()
        if not len(left):
            break
        away = nearest(points[None, left], points[None, centers]).dist_sq[0]
        center = left[away.argmax()][None]
        centers, idx = torch.cat([centers, center]), torch.cat([idx, _around(points, center, size)])
    return idx


def merge(patches: Tensor, n: int) -> Tensor:
    """Exactly n evenly spread points of overlapping patches: patches (count, size, C) -> (n, C), farthest points.

    The first 3 columns are coordinates. ValueError if the patches hold fewer than n points.
    """
    cloud = patches.reshape(-1, patches.shape[-1])
    return cloud[torch.from_numpy(farthest_points_large(cloud[:, :3], n)).to(cloud.device)]


def _around(points: Tensor, centers: Tensor, size: int) -> Tensor:
    idx = knn(points[None, centers], points[None], size).idx[0]
    absent = (idx != centers[:, None]).all(1)  # where more than `size` points coincide
    idx[absent, -1] = centers[absent]
    return idx
