"""Layers shared by the networks. Features are channel last, (..., C); a row is a point or a neighbor of one."""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pnu.geometry.neighbor_features import gather, interpolate
from pnu.geometry.neighbor_search import ball_query
from pnu.networks.norm import BatchNorm


class Layer(nn.Module):
    """Linear, batch norm over all rows, ReLU: (..., C) -> (..., C').

    Without bias it is initialized as in PointNet++ (Kaiming, normal), else as a convolution of torch, both as released.
    """

    def __init__(self, width_in: int, width_out: int, *, bias: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(width_in, width_out, bias=bias)
        self.norm = BatchNorm(width_out)
        if not bias:
            nn.init.kaiming_normal_(self.linear.weight)

    def forward(self, x: Tensor) -> Tensor:
        rows: Tensor = self.norm(self.linear(x).flatten(0, -2))
        return rows.relu().view(*x.shape[:-1], -1)


class MLP(nn.Sequential):
    """Layers of the given widths, the input's first, shared by all rows: (..., widths[0]) -> (..., widths[-1])."""

    def __init__(self, widths: Sequence[int], *, bias: bool = True) -> None:
        super().__init__(*(Layer(*pair, bias=bias) for pair in itertools.pairwise(widths)))

    def forward(self, x: Tensor) -> Tensor:
        for layer in self:
            x = layer(x)
        return x


class PooledMLP(MLP):
    """PointNet: shared MLP and maximum over the points of each cloud, (B, n, C) -> (B, C')."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x).amax(1)


class JoinedMLP(MLP):
    """Concatenation of features of each point (B, n, C) and of the cloud (B, C'), shared MLP: (B, n, C'')."""

    def forward(self, each: Tensor, cloud: Tensor | None = None) -> Tensor:
        if cloud is not None:
            each = torch.cat([each, cloud[:, None].expand(-1, each.shape[1], -1)], -1)
        return super().forward(each)


class Abstraction(nn.Module):
    """Set abstraction of PointNet++: shared MLP over [offset, feature] of the neighbors, then their maximum.

    Args:
        widths: of the features and of the layers.
        radius: of the ball around a center.
        k: neighbors that are taken from it (`ball_query`).
    """

    def __init__(self, widths: Sequence[int], radius: float, k: int = 32) -> None:
        super().__init__()
        self.radius, self.k = radius, k
        self.mlp = MLP((3 + widths[0], *widths[1:]), bias=False)

    def forward(self, points: Tensor, features: Tensor, centers: Tensor) -> Tensor:
        """Features (B, n, C) at points (B, n, 3), pooled around centers (B, m, 3): (B, m, C')."""
        rows: Tensor = self.mlp(self.grouped(points, features, centers))  # (B, m, k, C')
        return rows.amax(2)

    def grouped(self, points: Tensor, features: Tensor, centers: Tensor) -> Tensor:
        """[offset, feature] of the neighbors of each center: (B, m, k, 3 + C)."""
        neighbors = ball_query(centers, points, self.radius, self.k)
        offsets = gather(points, neighbors) - centers[:, :, None]
        return torch.cat([offsets, gather(features, neighbors)], -1)


class Propagation(nn.Module):
    """Feature propagation of PointNet++: interpolation from the 3 nearest coarse points, skip features, shared MLP."""

    def __init__(self, coarse: int, skip: int, *widths: int) -> None:
        super().__init__()
        self.mlp = MLP((coarse + skip, *widths), bias=False)

    def forward(self, fine_points: Tensor, coarse_points: Tensor, skip: Tensor, features: Tensor) -> Tensor:
        """Features (B, m, C) at coarse points (B, m, 3), carried to fine points (B, n, 3): (B, n, C')."""
        carried = interpolate(features, coarse_points, fine_points)
        joined: Tensor = self.mlp(torch.cat([carried, skip], -1))
        return joined


def expand(features: Tensor) -> Tensor:
    """Turn the two halves of the features of each point into two points: (B, n, C) -> (B, 2 n, C / 2), a view."""
    return features.reshape(features.shape[0], -1, features.shape[-1] // 2)
