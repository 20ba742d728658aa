"""Layers shared by the networks. Features are channel last, (..., C); a row is a point or a neighbour of one."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pnu.ops.grouping import gather, interpolate
from pnu.ops.nearest import ball_query
from pnu.ops.sampling import farthest_points


class Layer(nn.Module):
    """Linear, batch norm over all rows, ReLU: (..., width_in) -> (..., width_out).

    Without bias it is initialised as in PointNet++ (Kaiming, normal), else as a convolution of torch, both as released.
    """

    def __init__(self, width_in: int, width_out: int, *, bias: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(width_in, width_out, bias=bias)
        self.norm = nn.BatchNorm1d(width_out)
        if not bias:
            nn.init.kaiming_normal_(self.linear.weight)

    def forward(self, x: Tensor) -> Tensor:
        return self.activate(self.linear(x))

    def activate(self, x: Tensor) -> Tensor:
        """Batch norm and ReLU alone, for inputs that were multiplied elsewhere."""
        return self.norm(x.flatten(0, -2)).relu().view(x.shape)


class MLP(nn.Sequential):
    """Layers of the given widths, the input's first."""

    def __init__(self, widths: Sequence[int], *, bias: bool = True) -> None:
        super().__init__(*(Layer(*pair, bias=bias) for pair in itertools.pairwise(widths)))


class Level(NamedTuple):
    """One resolution of a hierarchy and its neighbourhoods in the finer one."""

    points: Tensor  # (B, m, 3)
    neighbors: Tensor  # (B, m, k): neighbors[b, i, j] = t: point t of the finer level is the j-th in the ball of i


def hierarchy(points: Tensor, radii: Sequence[float], k: int) -> list[Level]:
    """Levels of n, n/4, n/16 ... farthest points of `points` (B, n, 3), each grouped in balls of its radius.

    The order of farthest points does not depend on how many are wanted, so one run of n of n gives all levels:
    each is the front of the one before.
    """
    n = points.shape[1]
    ordered = gather(points, farthest_points(points, n, skip_near_origin=True))
    levels, finer = [], points
    for level, radius in enumerate(radii):
        centers = ordered[:, : max(n >> 2 * level, 1)]
        levels.append(Level(centers, ball_query(centers, finer, radius, k)))
        finer = centers
    return levels


class Abstraction(nn.Module):
    """Set abstraction of PointNet++: shared MLP over [offset, feature] of the neighbours, then their maximum."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.mlp = MLP((3 + widths[0], *widths[1:]), bias=False)

    def forward(self, points: Tensor, features: Tensor, level: Level) -> Tensor:
        """Features (B, n, C) at points (B, n, 3), pooled over the neighbourhoods of a level: (B, m, C')."""
        offsets = gather(points, level.neighbors) - level.points[:, :, None]
        return self.mlp(torch.cat([offsets, gather(features, level.neighbors)], -1)).amax(2)


class Propagation(nn.Module):
    """Feature propagation of PointNet++: interpolation from 3 coarse points, skip features, shared MLP."""

    def __init__(self, coarse: int, skip: int, *widths: int) -> None:
        super().__init__()
        self.mlp = MLP((coarse + skip, *widths), bias=False)

    def forward(self, fine_points: Tensor, coarse_points: Tensor, skip: Tensor, features: Tensor) -> Tensor:
        """Features (B, m, C) at coarse points (B, m, 3), carried to fine points (B, n, 3): (B, n, C')."""
        k = min(3, coarse_points.shape[1])
        return self.mlp(torch.cat([interpolate(features, coarse_points, fine_points, k), skip], -1))


def expand(features: Tensor) -> Tensor:
    """Turn the two halves of the features of each point into two points: (B, n, C) -> (B, 2 n, C / 2), a view."""
    return features.reshape(features.shape[0], -1, features.shape[-1] // 2)
