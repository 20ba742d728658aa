"""PUGeo-Net: samples in a learned 2D domain, mapped to the tangent plane by a learned linear map, then displaced."""

import torch
from torch import Tensor, nn

from pnu.geometry.neighbor_features import gather
from pnu.geometry.neighbor_search import knn
from pnu.networks.layers import MLP
from pnu.networks.norm import BatchNorm
from pnu.networks.punet import check_ratio, coordinates

NEIGHBORS = 20
WIDTHS = (64, 64, 128, 128)


class EdgeConvolution(nn.Module):
    """Maximum over neighbors j of ReLU(BN(A x_i + B (x_j - x_i))): (B, n, C) -> (B, n, C') (DGCNN).

    `center` is A - B and `neighbor` B: A x_i + B (x_j - x_i) = (A - B) x_i + B x_j.
    """

    def __init__(self, width_in: int, width_out: int) -> None:
        super().__init__()
        self.center = nn.Linear(width_in, width_out)
        self.neighbor = nn.Linear(width_in, width_out, bias=False)
        self.norm = BatchNorm(width_out)

    def forward(self, x: Tensor, neighbors: Tensor) -> Tensor:
        return self.pooled(self.center(x)[:, :, None] + self.neighbor(gather(x, neighbors)))

    def pooled(self, edges: Tensor) -> Tensor:
        """Edges (B, n, k, C'), of which the maximum is left."""
        rows: Tensor = self.norm(edges.flatten(0, -2))
        return rows.view(edges.shape).relu().amax(2)


class PUGeo(nn.Module):
    """Patches (B, n, 3 or 6) -> (B, ratio n, 6), n >= 64; normals of the input are not read, normals are predicted.

    For each input point p with features f (section 4 of the paper): r samples (u, v) in 2D; a linear map T (3 x 3)
    takes them to the tangent plane, p' = p + T (u, v, 0); the coarse normal is T (0, 0, 1); each sample is displaced
    by delta along it, and a correction is added to its direction. Row i * ratio + s is sample s of point i.
    `outputs` adds "coarse_normal" (B, n, 3), of the input points, for `pnu.losses.ParameterizationLoss`.

    Args:
        ratio: points out for each point in: 2 or more

    Source: Qian, Hou, Kwong, He, "PUGeo-Net: A Geometry-centric Network for 3D Point Cloud Upsampling", ECCV 2020.
    Neighbors are those in space, searched once (the paper's extractor searches again in feature space).
    """

    predicts_normals = True
    patch_size = 1024

    def __init__(self, ratio: int = 4) -> None:
        super().__init__()
        check_ratio(ratio)
        self.ratio = ratio
        pairs = zip((3, *WIDTHS), WIDTHS, strict=False)
        self.levels = nn.ModuleList([EdgeConvolution(*pair) for pair in pairs])
        width = sum(WIDTHS)
        self.gate = nn.Sequential(MLP((width, 64)), nn.Linear(64, len(WIDTHS)))
        self.samples = nn.Sequential(MLP((width, 256, 128)), nn.Linear(128, 2 * ratio))
        self.tangent = nn.Sequential(MLP((width, 128, 64)), nn.Linear(64, 9))
        self.refinement = nn.Sequential(MLP((width + 3, 256, 128)), nn.Linear(128, 4))

    def forward(self, patch: Tensor) -> Tensor:
        return self.outputs(patch)["prediction"]

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """ "prediction" (B, ratio n, 6), and "coarse_normal" (B, n, 3) of each input point, not of unit length."""
        points = coordinates(patch)
        features = self.recalibrated(points)
        batch, n, _ = points.shape
        linear = self.tangent(features).view(batch, n, 3, 3)
        plane = self.samples(features).view(batch, n, self.ratio, 2) @ linear[..., :2].transpose(-1, -2)
        normal = linear[..., 2]
        shared = features[:, :, None].expand(-1, -1, self.ratio, -1)
        refinement = self.refinement(torch.cat([plane, shared], -1))
        position = points[:, :, None] + plane + refinement[..., :1] * normal[:, :, None]
        direction = normal[:, :, None] + refinement[..., 1:]
        return {"prediction": torch.cat([position, direction], -1).flatten(1, 2), "coarse_normal": normal}

    def recalibrated(self, points: Tensor) -> Tensor:
        """Features of all levels, each weighted by a gate that looks at all of them (section 4.1)."""
        neighbors = knn(points, points, NEIGHBORS + 1).idx[..., 1:]
        levels, features = [], points
        for convolution in self.levels:
            features = convolution(features, neighbors)
            levels.append(features)
        gates = self.gate(torch.cat(levels, -1)).softmax(-1)
        return torch.cat([gates[..., i : i + 1] * level for i, level in enumerate(levels)], -1)
