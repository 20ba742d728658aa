"""Layers shared by the networks. Features are channel last, (..., C); a row is a point or a neighbour of one."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnu.models import stack
from pnu.models.layer import Layer
from pnu.models.neighborhoods import Groups, distinct, pool, single
from pnu.ops.combine import combine
from pnu.ops.grouping import gather
from pnu.ops.nearest import ball_query, knn
from pnu.ops.sampling import farthest_points


class MLP(nn.Sequential):
    """Layers of the given widths, the input's first: (..., widths[0]) -> (..., widths[-1])."""

    def __init__(self, widths: Sequence[int], *, bias: bool = True) -> None:
        super().__init__(*(Layer(*pair, bias=bias) for pair in itertools.pairwise(widths)))

    def forward(
        self, x: Tensor, *, projected: bool = False, groups: Groups | None = None, centers: Tensor | None = None
    ) -> Tensor:
        """Rows (..., C) through all layers.

        Args:
            projected: x already holds the products of the first layer's weight, without bias.
            groups: x is (R, C) and the output the maximum over groups of rows, (G, C').
            centers: (G, C), with groups: x is a table (n, C), and row r is x[source[r]] - centers[owner[r]].
        """
        rows = x.reshape(-1, x.shape[-1])
        if streamed(x, self.training):
            run = stack.train if self.training else stack.infer
            rows = run(rows, self.layers, projected=projected, groups=groups, centers=centers)
        else:
            if groups is not None and centers is not None:
                rows = combine(rows, groups.source[:, None]) - centers[groups.owner]
            for i, layer in enumerate(self.layers):
                rows = layer(rows, projected=projected and i == 0)
            rows = rows if groups is None else pool(rows, groups)
        return rows if groups is not None else rows.view(*x.shape[:-1], rows.shape[-1])

    @property
    def layers(self) -> list[Layer]:
        return cast(list[Layer], list(self))

    def first_weight(self, split: int) -> tuple[Tensor, Tensor]:
        """Weight of the first layer for the first `split` columns of its input, and for the others."""
        weight = self.layers[0].linear.weight
        return weight[:, :split], weight[:, split:]


def streamed(x: Tensor, training: bool) -> bool:
    """Whether layers run chunk by chunk (`stack`): on the CPU, but for gradients in eval mode and mixed precision."""
    plainly = torch.is_autocast_enabled("cpu") or (torch.is_grad_enabled() and not training)
    return x.device.type == "cpu" and not plainly


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
    """Set abstraction of PointNet++: shared MLP over [offset, feature] of the neighbours, then their maximum.

    The first layer is linear in both, and an offset is point minus centre: both are multiplied once a point and once a
    centre, before they are gathered.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.mlp = MLP((3 + widths[0], *widths[1:]), bias=False)

    def forward(self, points: Tensor, features: Tensor, level: Level) -> Tensor:
        """Features (B, n, C) at points (B, n, 3), pooled over the neighbourhoods of a level: (B, m, C')."""
        clouds, m, _ = level.neighbors.shape
        n = points.shape[1]
        groups = (distinct if streamed(points, self.training) else single)(level.neighbors, n)
        of_offsets, _ = self.mlp.first_weight(3)
        table = F.linear(torch.cat([points, features], -1).flatten(0, 1), self.mlp.layers[0].linear.weight)
        centers = F.linear(level.points.reshape(-1, 3), of_offsets)
        return self.mlp(table, projected=True, groups=groups, centers=centers).view(clouds, m, -1)


class Propagation(nn.Module):
    """Feature propagation of PointNet++: interpolation from 3 coarse points, skip features, shared MLP.

    Interpolation and the first layer are linear: features are multiplied at the coarse points, then interpolated.
    """

    def __init__(self, coarse: int, skip: int, *widths: int) -> None:
        super().__init__()
        self.coarse = coarse
        self.mlp = MLP((coarse + skip, *widths), bias=False)

    def forward(self, fine_points: Tensor, coarse_points: Tensor, skip: Tensor, features: Tensor) -> Tensor:
        """Features (B, m, C) at coarse points (B, m, 3), carried to fine points (B, n, 3): (B, n, C')."""
        clouds, m, _ = coarse_points.shape
        dist_sq, idx = knn(fine_points, coarse_points, min(3, m))
        inverse = 1 / (dist_sq.sqrt() + 1e-8)
        inverse = inverse / inverse.sum(-1, keepdim=True)
        idx = idx + torch.arange(clouds, device=idx.device).view(-1, 1, 1) * m
        of_features, of_skip = self.mlp.first_weight(self.coarse)
        rows = combine(F.linear(features.flatten(0, 1), of_features), idx.flatten(0, 1), inverse.flatten(0, 1))
        rows = torch.addmm(rows, skip.flatten(0, 1), of_skip.t())
        return self.mlp(rows, projected=True).view(clouds, fine_points.shape[1], -1)


def expand(features: Tensor) -> Tensor:
    """Turn the two halves of the features of each point into two points: (B, n, C) -> (B, 2 n, C / 2), a view."""
    return features.reshape(features.shape[0], -1, features.shape[-1] // 2)
