"""Nesti-Net: normals of single points from Fisher vectors of their neighborhoods, by experts that a network chooses."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d, max_pool3d, normalize, pad

from pnu.networks.fisher_vectors import STATISTICS, fisher_vectors, normalized_vectors
from pnu.networks.layers import MLP, Layer
from pnu.networks.norm import BatchNorm
from pnu.networks.pcpnet import check_scales, check_size

Table = Sequence[tuple[int, int, int] | None]
"""Inception modules (channels, smaller kernel, larger kernel) in their order; None: the grid is halved by maxima."""

# of 8 x 8 x 8 Gaussians, as in the paper; of 3 x 3 x 3, as its code has them for experts and gate alike
GATE_TABLE: Table = (
    (128, 3, 5), (256, 3, 5), (256, 3, 5), None, (512, 2, 4), (512, 2, 4), None, (512, 1, 2), None,
)  # fmt: skip
EXPERT_TABLE: Table = ((128, 3, 5), (256, 3, 5), None, (256, 2, 4), None, (512, 2, 4), None)
SMALL_TABLE: Table = ((128, 2, 3), (256, 2, 3), (256, 1, 2), (512, 1, 2), None)
SMALL_GRID = 4  # largest grid of the small table


class GridLayer(nn.Module):
    """Convolution of cubes, padded to keep their size, batch norm, ReLU: (N, g, g, g, C) -> (N, g, g, g, C')."""

    def __init__(self, width_in: int, width_out: int, kernel: int) -> None:
        super().__init__()
        self.kernel = kernel
        self.convolution, self.norm = nn.Conv3d(width_in, width_out, kernel), BatchNorm(width_out)

    def forward(self, x: Tensor) -> Tensor:
        found = self.convolution(zero_padded(x.movedim(-1, 1), self.kernel)).movedim(1, -1)
        rows: Tensor = self.norm(found.flatten(0, -2))
        return rows.relu().view(found.shape)


class Inception(nn.Module):
    """(N, g, g, g, C) -> (N, g, g, g, 3 c): a 1 x 1 layer of c channels, two wider ones of c / 2 on it, and a 1 x 1
    layer of c channels on local means of the input, side by side."""

    def __init__(self, width_in: int, channels: int, smaller: int, larger: int) -> None:
        super().__init__()
        half = channels // 2
        self.smaller = smaller
        self.entry, self.pooled = Layer(width_in, channels), Layer(width_in, channels)
        self.near, self.far = GridLayer(channels, half, smaller), GridLayer(channels, half, larger)

    def forward(self, x: Tensor) -> Tensor:
        entry = self.entry(x)
        return torch.cat([entry, self.near(entry), self.far(entry), self.pooled(local_means(x, self.smaller))], -1)


class Halving(nn.Module):
    """Maxima over kernel^3 cells at every second one of cubes (N, g, g, g, C): (N, h, h, h, C), h = g / 2, rounded up.
    A kernel of 3 is centered at its cell, one of 2 begins there."""

    def __init__(self, kernel: int) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, x: Tensor) -> Tensor:
        padding, odd = (self.kernel - 1) // 2, bool(self.kernel % 2)
        maxima: Tensor = max_pool3d(x.movedim(-1, 1), self.kernel, 2, padding=padding, ceil_mode=not odd)
        return maxima.movedim(1, -1)


class GridFeatures(nn.Module):
    """Inception modules and maxima of a table, on cubes (N, g, g, g, C): (N, self.width).

    The first module has a `sharing`-th of its channels, so that an expert of more scales is no larger.
    """

    def __init__(self, width_in: int, grid: int, table: Table, width: float, sharing: int = 1) -> None:
        super().__init__()
        steps: list[nn.Module] = []
        kernel = 3 if grid <= SMALL_GRID else 2
        for row in table:
            if row is None:
                steps.append(Halving(kernel))
                grid = -(-grid // 2)
                continue
            share = width if steps else width / sharing
            channels = 2 * max(2, round(share * row[0] / 2))
            steps.append(Inception(width_in, channels, *row[1:]))
            width_in = 3 * channels
        self.modules_and_maxima, self.width = nn.Sequential(*steps), width_in * grid**3

    def forward(self, x: Tensor) -> Tensor:
        features: Tensor = self.modules_and_maxima(x)
        return features.flatten(1)


class NestiNet(nn.Module):
    """Neighborhoods (B, q, k, 3), nearest first and the point itself the very first -> (B, q, 6), points and normals.

    Each scale is centered at its point, scaled to its own unit sphere and turned into a grid of 3D modified Fisher
    vectors. The gate (the paper's scale manager) sees those of all scales and gives each expert its share; an expert
    sees one scale, or all. The normal is that of the expert of the largest share: without gradient for the gate, which
    learns from `outputs`. Signs mean nothing.

    Args:
        neighbors: points of each scale, nearest ones, the largest last
        grid: Gaussians along an axis: 8 in the paper; up to 4, the layers are fewer, those of its code for 3
        experts: networks that give a normal: as many for each scale as go into it, the rest see all scales; 7 in the
            paper, two for each of three scales and one for all
        width: channels as a share of the paper's

    Source: Ben-Shabat, Lindenbaum, Fischer, "Nesti-Net: Normal Estimation for Unstructured 3D Point Clouds using
    Convolutional Neural Networks", CVPR 2019, arXiv 1812.00709. Its balls of 1, 3 and 5 % of the shape are nearest
    points here, as in `PCPNet`.
    """

    task = "normals"
    ratio = 1
    predicts_normals = True
    oriented = False

    def __init__(
        self, neighbors: Sequence[int] = (16, 48, 128), grid: int = 3, experts: int = 4, width: float = 0.125
    ) -> None:
        super().__init__()
        check_scales(neighbors)
        if not 2 <= grid <= 8:
            raise ValueError(f"model.grid={grid}: expected 2 to 8 Gaussians along an axis")
        if experts < 1:
            raise ValueError(f"model.experts={experts}: expected 1 or more")
        if not 0 < width <= 1:
            raise ValueError(f"model.width={width}: expected a share above 0, at most 1")
        self.neighbors, self.grid = tuple(neighbors), grid
        scales = len(neighbors)
        each = experts // scales
        self.scales_of = [(i // each,) if i < each * scales else tuple(range(scales)) for i in range(experts)]
        gate, expert = (SMALL_TABLE, SMALL_TABLE) if grid <= SMALL_GRID else (GATE_TABLE, EXPERT_TABLE)

        def joined(features: GridFeatures, widths: Sequence[int], out: int) -> nn.Sequential:
            shares = [max(4, round(width * c)) for c in widths]
            return nn.Sequential(features, MLP((features.width, *shares)), nn.Linear(shares[-1], out))

        self.gate = joined(GridFeatures(STATISTICS * scales, grid, gate, width), (1024, 256, 128), experts)
        self.experts = nn.ModuleList(
            joined(GridFeatures(STATISTICS * len(seen), grid, expert, width, len(seen)), (512, 128, 64), 3)
            for seen in self.scales_of
        )

    def check_input(self, key: str, points: int) -> None:
        """ValueError where neighborhoods have too few points for the largest scale."""
        check_size(key, points, self.neighbors)

    def forward(self, neighborhoods: Tensor) -> Tensor:
        statistics = self.statistics(neighborhoods)
        chosen = self.gate(statistics).argmax(-1)
        normals = statistics.new_zeros(len(chosen), 3)
        for i, expert in enumerate(self.experts):
            rows = chosen == i
            if bool(rows.any()):
                normals[rows] = expert(self.seen(statistics[rows], i))
        return beside(neighborhoods, normals)

    def outputs(self, neighborhoods: Tensor) -> dict[str, Tensor]:
        """ "prediction" (B, q, 6), "expert_normals" (B, q, experts, 3) and "shares" (B, q, experts), of which the loss
        is an expectation."""
        statistics = self.statistics(neighborhoods)
        shares = self.gate(statistics).softmax(-1)
        normals = torch.stack([expert(self.seen(statistics, i)) for i, expert in enumerate(self.experts)], 1)
        chosen = normals[torch.arange(len(normals)), shares.argmax(-1)]
        each = neighborhoods.shape[:2]
        return {
            "prediction": beside(neighborhoods, chosen),
            "expert_normals": normals.unflatten(0, each),
            "shares": shares.unflatten(0, each),
        }

    def statistics(self, neighborhoods: Tensor) -> Tensor:
        """Normalized Fisher vectors of all scales: (B q, g, g, g, 20 scales)."""
        self.check_input("neighbors", neighborhoods.shape[2])
        near = neighborhoods.flatten(0, 1)
        scales = []
        for k in self.neighbors:
            offset = near[:, :k] - near[:, :1]
            points = offset / offset.norm(dim=-1).amax(1)[:, None, None].clamp_min(1e-12)
            scales.append(normalized_vectors(fisher_vectors(points, self.grid)))
        cubes: Tensor = torch.cat(scales, -1).unflatten(1, (self.grid, self.grid, self.grid))
        return cubes

    def seen(self, statistics: Tensor, expert: int) -> Tensor:
        """The part of `statistics` that an expert sees."""
        scales = self.scales_of[expert]
        return statistics[..., STATISTICS * scales[0] : STATISTICS * (scales[-1] + 1)]


def beside(neighborhoods: Tensor, normals: Tensor) -> Tensor:
    """The points of neighborhoods (B, q, k, 3) with their normals (B q, 3): (B, q, 6)."""
    points = neighborhoods[:, :, 0]
    return torch.cat([points, normalize(normals, dim=-1).view(points.shape)], -1)


def zero_padded(x: Tensor, kernel: int) -> Tensor:
    """Cubes (N, C, g, g, g) with zeros around, as many as keep their size under a kernel; one more after than before
    where that number is odd."""
    return pad(x, 3 * [(kernel - 1) // 2, kernel // 2])


def local_means(x: Tensor, kernel: int) -> Tensor:
    """Means over kernel^3 cells around each of cubes (N, g, g, g, C), of those that are there."""
    count = avg_pool3d(zero_padded(torch.ones_like(x[:1, ..., 0]), kernel), kernel, 1)
    means: Tensor = avg_pool3d(zero_padded(x.movedim(-1, 1), kernel), kernel, 1) / count
    return means.movedim(1, -1)
