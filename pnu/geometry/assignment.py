"""Matching of two clouds of equal size, one to one."""

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from pnu.geometry.neighbor_search import per_cloud


def assign(source: Tensor, target: Tensor, *, tolerance: float = 0.2, rounds: int = 100) -> Tensor:
    """Nearly the shortest one-to-one matching, by auction (Bertsekas 1988); a search, so without gradient.

    source (B, n, 3), target (B, n, 3) -> idx (B, n) int64, a permutation in each cloud: source i goes to target
    idx[b, i]. Bids rise by `tolerance` times the targets' spacing, taken as their extent / sqrt(n); points that still
    bid after `rounds` rounds share what is free among them in the best way. Mean distances of 4096
    points come out 2 % too long where the clouds are near and 9 % for unrelated ones.

    Cost: O(n^2) memory a cloud (64 MiB at 4096 points) and up to `rounds` passes over the rows of the points that bid.
    Raises ValueError if the clouds differ in size.
    """
    if source.shape != target.shape or source.ndim != 3:
        found = f"{tuple(source.shape)} and {tuple(target.shape)}"
        raise ValueError(f"emd: expected two batches of clouds of equal size, (B, n, 3), found {found}")
    source, target = source.detach(), target.detach()
    idx = torch.empty(source.shape[:2], dtype=torch.int64, device=source.device)

    def match(b: int) -> None:
        idx[b] = _auction(source[b], target[b], tolerance, rounds)

    per_cloud(match, len(source))
    return idx


def _auction(source: Tensor, target: Tensor, tolerance: float, rounds: int) -> Tensor:
    n = len(source)
    step = tolerance * (target.amax(0) - target.amin(0)).norm() / n**0.5
    distance = torch.cdist(source, target, compute_mode="donot_use_mm_for_euclid_dist")
    price = distance.new_zeros(n)
    owner = torch.full((n,), -1, device=source.device)  # source that holds each target
    bidders = torch.arange(n, device=source.device)
    for _ in range(rounds if n > 1 else 0):
        if not len(bidders):
            break
        cost, wanted = (distance[bidders] + price).topk(2, largest=False)
        wanted, bid = wanted[:, 0], price[wanted[:, 0]] + cost[:, 1] - cost[:, 0] + step
        # the highest bid for a target wins, among equal ones the first bidder
        price = price.scatter_reduce(0, wanted, bid, "amax")
        wins = bid == price[wanted]
        first = torch.full_like(owner, n).scatter_reduce(0, wanted[wins], bidders[wins], "amin")
        owner = torch.where(first < n, first, owner)
        waiting = torch.ones(n, dtype=torch.bool, device=source.device)
        waiting[owner[owner >= 0]] = False
        bidders = waiting.nonzero()[:, 0]
    free = (owner < 0).nonzero()[:, 0]
    _, order = linear_sum_assignment(distance[bidders][:, free].cpu().numpy())
    owner[free[torch.from_numpy(order).to(free.device)]] = bidders
    return torch.empty_like(owner).scatter_(0, owner, torch.arange(n, device=source.device))
