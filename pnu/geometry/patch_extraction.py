"""Cut a cloud into overlapping patches and put patches together again."""

import torch
from torch import Tensor

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.neighbor_search import Search, nearest
from pnu.runtime.progress import Step, silent


def extract(cloud: Tensor, count: int, size: int, *, cover: bool = False) -> Tensor:
    """Patches of a cloud: centers by farthest point sampling, the `size` nearest points of each, by distance.

    cloud (n, 3) or (n, 6) -> idx (count, size) int64. With `cover`, patches are added around points that lie in none
    until every point lies in one, so there may be more than `count`. ValueError if count or size is not in 1..n.
    """
    points = cloud[:, :3].detach()
    search = Search(points)
    centers = torch.from_numpy(farthest_points_large(points.cpu().numpy(), count)).to(points.device)
    found = [_around(search, centers, size)]
    if cover:
        missed = torch.ones(len(points), dtype=torch.bool, device=points.device)
        missed[found[0].flatten()] = False
        left = missed.nonzero().flatten()
        away = nearest(points[None, left], points[None, centers]).dist_sq[0]
        while len(left):
            center = left[away.argmax()]
            found.append(_around(search, center[None], size))
            missed[found[-1].flatten()] = False
            away = torch.minimum(away, (points[left] - points[center]).square().sum(1))[missed[left]]
            left = left[missed[left]]
    return torch.cat(found)


def merge(patches: Tensor, n: int, step: Step = silent) -> Tensor:
    """Exactly n evenly spread points of overlapping patches: patches (count, size, C) -> (n, C), farthest points.

    The first 3 columns are coordinates. ValueError if the patches hold fewer than n points.
    """
    cloud = patches.reshape(-1, patches.shape[-1])
    return cloud[
        torch.from_numpy(farthest_points_large(cloud[:, :3].detach().cpu().numpy(), n, step=step)).to(cloud.device)
    ]


def _around(search: Search, centers: Tensor, size: int) -> Tensor:
    idx = search.knn(search.target[centers], size).idx
    absent = (idx != centers[:, None]).all(1)  # where more than `size` points coincide
    idx[absent, -1] = centers[absent]
    return idx
