"""DensePCR's point stages: each makes four points of one from global, local and grid features."""

import torch
from torch import Tensor, nn

from pnu.networks.layers import MLP, Abstraction, PooledMLP
from pnu.networks.pugan import plane_grid
from pnu.networks.punet import coordinates

GROWTH = 4  # points that a stage makes of one
SPREAD = 0.1  # half the side of the 2D grid of a stage


class Stage(nn.Module):
    """Points (B, n, 3) -> (B, 4 n, 3); rows 4 i to 4 i + 3 are those of point i.

    Each point is beside the cloud's feature (shared MLP 32, 64, 64, maximum), its neighborhood's (set abstraction 32,
    32, 64 of 8 neighbors within the radius) and one of four places of a grid: 3 + 64 + 64 + 2 channels, from which an
    MLP (64, 128, 128, 3) makes a point.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.cloud = PooledMLP((3, 32, 64, 64))
        self.local = Abstraction((0, 32, 32, 64), radius, k=8)
        self.dense = nn.Sequential(MLP((133, 64, 128, 128)), nn.Linear(128, 3))

    def forward(self, points: Tensor) -> Tensor:
        clouds, n, _ = points.shape
        local = self.local(points, points.new_zeros(clouds, n, 0), points)
        cloud = self.cloud(points)[:, None].expand(-1, n, -1)
        copies = torch.cat([points, cloud, local], -1).repeat_interleave(GROWTH, 1)
        grid = (plane_grid(GROWTH) * (SPREAD / 0.2)).to(points).repeat(n, 1).expand(clouds, -1, -1)
        made: Tensor = self.dense(torch.cat([copies, grid], -1))
        return made


class DensePCR(nn.Module):
    """Patches (B, n, 3 or 6) -> (B, ratio n, 3), n >= 64, in stages of four times as many: 1024, 4096, 16384.

    Normals are neither read nor predicted. `outputs` has each stage's points for the loss.

    Args:
        ratio: points out for each point in: 4, one stage; 16, two

    Source: Mandikal and Babu, "Dense 3D Point Cloud Reconstruction Using a Deep Pyramid Network", WACV 2019, without
    its image encoder. Batch norm is ours in every layer, as in the other networks here; so are the radii, about two
    spacings of 1024 and of 4096 points in the unit sphere.
    """

    predicts_normals = False
    patch_size = 1024

    def __init__(self, ratio: int = 16) -> None:
        super().__init__()
        if ratio not in (4, 16):
            raise ValueError(f"model.ratio: expected 4 or 16, one or two stages, got {ratio!r}")
        self.ratio = ratio
        self.stages = nn.ModuleList([Stage(0.1), Stage(0.05)][: 1 if ratio == 4 else 2])

    def forward(self, patch: Tensor) -> Tensor:
        points = coordinates(patch)
        for stage in self.stages:
            points = stage(points)
        return points

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """What the loss may read: prediction, and coarse, the points of the first stage, if there are two."""
        coarse = self.stages[0](coordinates(patch))
        if len(self.stages) == 1:
            return {"prediction": coarse}
        return {"prediction": self.stages[1](coarse), "coarse": coarse}
