"""PU-GAN: dense edge features, up-down-up expansion with self-attention, and the discriminator that judges them."""

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pnu.geometry.neighbor_features import gather
from pnu.geometry.sampling import farthest_points
from pnu.networks.punet import check_ratio, coordinates

GROWTH = 24  # channels that a layer of a dense block adds
NEIGHBORS = 16  # of an edge feature, in the space of the features
SPREAD = 0.2  # half the side of the 2D grid that tells copies of a feature apart
EXTRA = 2  # points more for each input point than asked for, thinned out at the end


class SharedMLP(nn.Sequential):
    """Linear layers of the given widths, ReLU after each, without batch norm: (..., widths[0]) -> (..., widths[-1])."""

    def __init__(self, *widths: int) -> None:
        layers = ((nn.Linear(*pair), nn.ReLU()) for pair in itertools.pairwise(widths))
        super().__init__(*itertools.chain.from_iterable(layers))


class DenseBlock(nn.Module):
    """Dense edge convolution of 3PU: (B, n, C) -> (B, n, C + 72), the maximum over 16 neighbors in feature space.

    Each of three layers sees the edge feature [x_i, x_j - x_i] through those before it, and adds 24 channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = SharedMLP(2 * channels, GROWTH)
        self.second = SharedMLP(channels + GROWTH, GROWTH)
        self.third = nn.Linear(channels + 2 * GROWTH, GROWTH)

    def forward(self, x: Tensor) -> Tensor:
        k = min(NEIGHBORS, x.shape[1] - 1)
        center = x[:, :, None].expand(-1, -1, k, -1)
        offset = gather(x, feature_neighbors(x, k)) - center
        rows = torch.cat([self.first(torch.cat([center, offset], -1)), center], -1)
        rows = torch.cat([self.second(rows), rows], -1)
        return torch.cat([self.third(rows), rows], -1).amax(2)


class DenseFeatures(nn.Module):
    """Four dense blocks, each on 48 channels of all before it: points (B, n, 3) -> (B, n, 480)."""

    width = 480

    def __init__(self) -> None:
        super().__init__()
        self.entry = nn.Linear(3, GROWTH)
        reduced = 2 * GROWTH
        self.reductions = nn.ModuleList([SharedMLP(120 * level, reduced) for level in (1, 2, 3)])
        self.blocks = nn.ModuleList([DenseBlock(GROWTH), *(DenseBlock(reduced) for _ in range(3))])

    def forward(self, points: Tensor) -> Tensor:
        entry = self.entry(points)
        features = torch.cat([self.blocks[0](entry), entry], -1)
        for reduction, block in zip(self.reductions, list(self.blocks)[1:], strict=True):
            features = torch.cat([block(reduction(features)), features], -1)
        return features


class SelfAttention(nn.Module):
    """x + gamma softmax(f(x) g(x)') h(x), gamma 0 at first: (B, n, C) -> (B, n, C); f and g have C / 4 channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.f, self.g = SharedMLP(channels, channels // 4), SharedMLP(channels, channels // 4)
        self.h = SharedMLP(channels, channels)
        self.gamma = nn.Parameter(torch.zeros(()))

    def forward(self, x: Tensor) -> Tensor:
        weights = torch.softmax(self.f(x) @ self.g(x).mT, -1)
        attended: Tensor = x + self.gamma * (weights @ self.h(x))
        return attended


class Up(nn.Module):
    """Up-feature operator: copies beside a 2D grid, self-attention, MLP: (B, n, 128) -> (B, r n, 128).

    Row i + b n is copy b of point i.
    """

    def __init__(self, ratio: int, channels: int = 128) -> None:
        super().__init__()
        self.ratio = ratio
        self.attention, self.mlp = SelfAttention(channels + 2), SharedMLP(channels + 2, 256, channels)

    def forward(self, x: Tensor) -> Tensor:
        clouds, n, _ = x.shape
        grid = plane_grid(self.ratio).to(x).repeat_interleave(n, 0).expand(clouds, -1, -1)
        raised: Tensor = self.mlp(self.attention(torch.cat([x.repeat(1, self.ratio, 1), grid], -1)))
        return raised


class Down(nn.Module):
    """Down-feature operator: the r copies of each point side by side, MLP: (B, r n, 128) -> (B, n, 128)."""

    def __init__(self, ratio: int, channels: int = 128) -> None:
        super().__init__()
        self.ratio = ratio
        self.mlp = SharedMLP(ratio * channels, 256, channels)

    def forward(self, x: Tensor) -> Tensor:
        copies = x.unflatten(1, (self.ratio, -1)).transpose(1, 2).flatten(2)
        lowered: Tensor = self.mlp(copies)
        return lowered


class UpDownUp(nn.Module):
    """Expansion that corrects itself: up, down again, and what that lost, raised too: (B, n, C) -> (B, r n, 128)."""

    def __init__(self, ratio: int, channels: int) -> None:
        super().__init__()
        self.entry = SharedMLP(channels, 128)
        self.up, self.down, self.up_error = Up(ratio), Down(ratio), Up(ratio)

    def forward(self, x: Tensor) -> Tensor:
        x = self.entry(x)
        raised = self.up(x)
        corrected: Tensor = raised + self.up_error(self.down(raised) - x)
        return corrected


class PUGAN(nn.Module):
    """PU-GAN's generator: patches (B, n, 3 or 6) -> (B, ratio n, 3), n >= 64; reads and predicts no normals.

    It makes (ratio + 2) n points and keeps the farthest ratio n of them.

    Args:
        ratio: points out for each point in: 2 or more

    Source: Li, Li, Fu, Cohen-Or, Heng, "PU-GAN: a Point Cloud Upsampling Adversarial Network", ICCV 2019.
    """

    predicts_normals = False
    patch_size = 256

    def __init__(self, ratio: int = 4) -> None:
        super().__init__()
        check_ratio(ratio)
        self.ratio = ratio
        self.features = DenseFeatures()
        self.expansion = UpDownUp(ratio + EXTRA, self.features.width)
        self.regression = nn.Sequential(SharedMLP(128, 64), nn.Linear(64, 3))

    def forward(self, patch: Tensor) -> Tensor:
        points = coordinates(patch)
        dense: Tensor = self.regression(self.expansion(self.features(points)))
        return gather(dense, farthest_points(dense.detach(), self.ratio * points.shape[1]))

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """What the loss may read: here the prediction alone."""
        return {"prediction": self(patch)}


class Discriminator(nn.Module):
    """PU-GAN's discriminator: points (B, m, 3) -> (B,), near 1 for points of a true cloud.

    MLP (32, 64), beside their maximum over the points, self-attention, MLP (128, 256), maximum, MLP (256, 64), 1.
    """

    def __init__(self) -> None:
        super().__init__()
        self.entry, self.attention = SharedMLP(3, 32, 64), SelfAttention(128)
        self.mlp, self.judge = SharedMLP(128, 128, 256), nn.Sequential(SharedMLP(256, 256, 64), nn.Linear(64, 1))

    def forward(self, points: Tensor) -> Tensor:
        each = self.entry(points)
        joined = torch.cat([each, each.amax(1, keepdim=True).expand_as(each)], -1)
        verdict: Tensor = self.judge(self.mlp(self.attention(joined)).amax(1))
        return verdict[:, 0]


def feature_neighbors(x: Tensor, k: int) -> Tensor:
    """The k nearest others of each feature: (B, n, C) -> idx (B, n, k); without gradient."""
    with torch.no_grad():
        distance = torch.cdist(x, x)
        distance.diagonal(dim1=1, dim2=2).fill_(math.inf)
        return distance.topk(k, dim=-1, largest=False).indices


def plane_grid(ratio: int) -> Tensor:
    """As many points of the square of side 0.4 around 0 as there are copies, (r, 2): rows as near to a square as
    `ratio` can be divided."""
    rows = next(n for n in range(math.isqrt(ratio), 0, -1) if ratio % n == 0)
    axes: Sequence[Tensor] = [torch.linspace(-SPREAD, SPREAD, n) for n in (rows, ratio // rows)]
    return torch.cartesian_prod(*axes)
