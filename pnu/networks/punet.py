"""PU-Net: hierarchical features at four radii, feature expansion in parallel branches, coordinate regression."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pnu.geometry.neighbor_features import gather, interpolate
from pnu.geometry.sampling import farthest_points
from pnu.networks.layers import MLP, Abstraction

RADII = (0.05, 0.1, 0.2, 0.3)
MINIMUM = 64


class HierarchicalFeatures(nn.Module):
    """Point features from growing neighborhoods: points (B, n, 3) -> (B, n, 259).

    Four set abstractions keep n, n/2, n/4 and n/8 farthest points; each level is interpolated back to all points by
    inverse distance, reduced to 64 channels and concatenated, beside the coordinates (PU-Net, section 3.2).
    """

    width = 4 * 64 + 3

    def __init__(self) -> None:
        super().__init__()
        widths = ((0, 32, 32, 64), (64, 64, 64, 128), (128, 128, 128, 256), (256, 256, 256, 512))
        self.abstractions = nn.ModuleList(map(Abstraction, widths, RADII))
        self.reductions = nn.ModuleList([MLP((level[-1], 64)) for level in widths])

    def forward(self, points: Tensor) -> Tensor:
        n = points.shape[1]
        ordered = gather(points, farthest_points(points, n))
        finer, features = points, points.new_zeros(*points.shape[:2], 0)
        restored = []
        for level, (abstraction, reduction) in enumerate(zip(self.abstractions, self.reductions, strict=True)):
            centers = ordered[:, : n >> level]
            features = abstraction(finer, features, centers)
            restored.append(reduction(interpolate(features, centers, points)))
            finer = centers
        return torch.cat([*restored, points], -1)


class Branches(nn.Module):
    """Feature expansion (PU-Net, section 3.3): r separate MLPs, each makes one of r copies: (B, n, C) -> (B, r n, C').

    Copies are stored branch after branch: row i + b n is copy b of point i.
    """

    def __init__(self, branches: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.branches = nn.ModuleList([MLP(widths) for _ in range(branches)])

    def forward(self, features: Tensor) -> Tensor:
        return torch.cat([branch(features) for branch in self.branches], 1)


class PUNet(nn.Module):
    """Patches (B, n, 3 or 6) -> (B, ratio n, 3), n >= 64; normals of the input are not read, none are predicted.

    Args:
        ratio: points out for each point in: 2 or more

    Source: Yu, Li, Fu, Cohen-Or, Heng, "PU-Net: Point Cloud Upsampling Network", CVPR 2018. Batch norm is ours in
    every layer, as in the other networks here, so that all train with the same schedule.
    """

    predicts_normals = False
    patch_size = 1024

    def __init__(self, ratio: int = 4) -> None:
        super().__init__()
        check_ratio(ratio)
        self.ratio = ratio
        self.features = HierarchicalFeatures()
        self.expansion = Branches(ratio, (self.features.width, 256, 128))
        self.regression = nn.Sequential(MLP((128, 64)), nn.Linear(64, 3))

    def forward(self, patch: Tensor) -> Tensor:
        points = coordinates(patch)
        dense: Tensor = self.regression(self.expansion(self.features(points)))
        return dense

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """What the loss may read: here the prediction alone."""
        return {"prediction": self(patch)}


def coordinates(patch: Tensor) -> Tensor:
    """The points (B, n, 3) of a patch (B, n, 3 or more); ValueError where there are too few for the coarsest level."""
    if patch.ndim != 3 or patch.shape[1] < MINIMUM or patch.shape[2] < 3:
        raise ValueError(f"patch: expected (B, n >= {MINIMUM}, 3 or 6), got {tuple(patch.shape)}")
    return patch[..., :3].contiguous()


def check_ratio(ratio: int) -> None:
    """`ValueError` for a ratio that is no whole number from 2 on."""
    if not (isinstance(ratio, int) and ratio >= 2):
        raise ValueError(f"model.ratio: expected a whole number from 2 on, got {ratio!r}")
