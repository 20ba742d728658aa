"""The network of the authors' released code: PointNet++ local features, PointNet global features, x2 reshapes."""

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnu.geometry.neighbor_features import gather
from pnu.geometry.sampling import farthest_points
from pnu.networks.layers import MLP, Abstraction, JoinedMLP, PooledMLP, Propagation, expand

RADII = (0.1, 0.2, 0.3, 0.4)
MINIMUM = 64  # points of a patch: the coarsest level keeps one in 64


class LocalFeatures(nn.Module):
    """Four set abstractions (n, n/4, n/16, n/64 points) and four feature propagations: (B, n, C) -> (B, n, 256)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        widths = ((channels - 3, 32, 32, 64), (64, 64, 64, 128), (128, 128, 128, 256), (256, 256, 256, 512))
        self.abstractions = nn.ModuleList(map(Abstraction, widths, RADII))
        self.propagations = nn.ModuleList(
            [
                Propagation(128, channels, 128, 256),
                Propagation(128, 64, 128, 128),
                Propagation(256, 128, 128, 128),
                Propagation(512, 256, 128, 256),
            ]
        )

    def forward(self, x: Tensor) -> Tensor:
        points, features, skips = levels(x[..., :3], len(RADII)), x[..., 3:], [x]
        for i, abstraction in enumerate(self.abstractions):
            features = abstraction(points[i], features, points[i + 1])
            skips.append(features)
        for i in reversed(range(len(RADII))):
            features = self.propagations[i](points[i], points[i + 1], skips[i], features)
        return features


def levels(points: Tensor, number: int) -> list[Tensor]:
    """Points (B, n, 3), and n, n/4, n/16 ... farthest points of them.

    The order of farthest points does not depend on how many are wanted, so one run of n of n gives all levels:
    each is the front of the one before.
    """
    n = points.shape[1]
    ordered = gather(points, farthest_points(points, n, skip_near_origin=True))
    return [points, *(ordered[:, : max(n >> 2 * level, 1)] for level in range(number))]


class PNU(nn.Module):
    """Point and normal upsampling network, as released: patches (B, n, 6) -> (B, ratio n, 6), n >= 64.

    Patches hold points in the unit sphere and their unit normals; predicted normals are not normalized.

    Args:
        ratio: points out for each point in: 2, 4, 8 or 16
        input_normals: read the normals of the patch; without, they are ignored and may be missing
        predict_normals: predict normals beside points; without, the output has 3 columns
        local_features: PointNet++ features of each point's neighborhood (256)
        global_features: PointNet features of the whole patch (512)
        residual: predict what is added to the input point and normal; ours, neither the paper's nor its code's

    Source: Sharma et al., "Point Cloud Upsampling and Normal Estimation using Deep Learning for Robust Surface
    Reconstruction", and its released code, which takes PointNet++ for the local features of Fig. 1.
    """

    local: ClassVar[type[nn.Module]] = LocalFeatures
    local_width: ClassVar[int] = 256

    def __init__(
        self,
        ratio: int = 4,
        input_normals: bool = True,
        predict_normals: bool = True,
        local_features: bool = True,
        global_features: bool = True,
        residual: bool = False,
    ) -> None:
        super().__init__()
        if ratio not in (2, 4, 8, 16):
            raise ValueError(f"model.ratio: expected 2, 4, 8 or 16, got {ratio!r}")
        self.ratio, self.patch_size = ratio, 1024
        self.predicts_normals, self.residual = predict_normals, residual
        self.channels = 6 if input_normals else 3
        self.local_features = self.local(self.channels) if local_features else None
        self.global_features = PooledMLP((self.channels, 32, 64, 64, 128, 256, 512)) if global_features else None
        width = self.channels + (self.local_width if local_features else 0) + (512 if global_features else 0)
        self.head = JoinedMLP((width, 512, 256, 128))
        # Released, ratio 4: 128 | 64-64-32 | 16-16. Other ratios keep these widths at both ends.
        steps = ratio.bit_length() - 1
        outputs = [64] * max(steps - 2, 0) + [32] * min(steps - 1, 1)
        inputs = [width // 2 for width in (128, *outputs)]
        self.expansions = nn.ModuleList(
            [MLP((width, width, out)) for width, out in zip(inputs[:-1], outputs, strict=True)]
            + [MLP((inputs[-1], inputs[-1]))]
        )
        self.regression = nn.Linear(inputs[-1], 6 if predict_normals else 3)

    def forward(self, patch: Tensor) -> Tensor:
        """Patches (B, n, 6) -> (B, ratio n, 6), or (B, ratio n, 3) without normals."""
        _, n, columns = patch.shape
        if columns < self.channels or n < MINIMUM:
            raise ValueError(f"patch: expected (B, n >= {MINIMUM}, {self.channels}), got {tuple(patch.shape)}")
        x = patch[..., : self.channels].contiguous()
        each = x if self.local_features is None else torch.cat([x, self.local_features(x)], -1)  # (B, n, 6 + 256)
        whole = None if self.global_features is None else self.global_features(x)  # (B, 512)
        features = self.head(each, whole)  # (B, n, 128)
        for mlp in self.expansions:
            features = mlp(expand(features))  # (B, 2 n, 32), (B, 4 n, 16)
        points = self.regression(features)
        # the released order: all first halves, then all second ones, the last expansion outermost
        steps = len(self.expansions)
        predicted: Tensor = (
            points.unflatten(1, (n, *[2] * steps))
            .permute(0, *range(steps + 1, 0, -1), -1)
            .reshape(patch.shape[0], -1, points.shape[-1])
        )
        if not self.residual:
            return predicted
        given = x[..., : predicted.shape[-1]].repeat(1, self.ratio, 1)  # row i + b n is copy b of point i
        return predicted + F.pad(given, (0, predicted.shape[-1] - given.shape[-1]))

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """What the loss may read: here the prediction alone."""
        return {"prediction": self(patch)}
