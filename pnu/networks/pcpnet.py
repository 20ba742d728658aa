"""PCPNet: normals of single points from the points around them, turned by a quaternion it learns."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from pnu.networks.layers import MLP

SMALLEST = 8  # points of a neighborhood


class QuaternionTransformer(nn.Module):
    """A rotation for each neighborhood (N, k, 3): (N, 3, 3). MLP 64, 128, 1024, maximum, MLP 512, 256, quaternion."""

    def __init__(self, widths: Sequence[int], joined: Sequence[int]) -> None:
        super().__init__()
        self.each = MLP((3, *widths))
        self.joined, self.quaternion = MLP((widths[-1], *joined)), nn.Linear(joined[-1], 4)

    def forward(self, points: Tensor) -> Tensor:
        found = self.quaternion(self.joined(self.each(points).amax(1)))
        return rotation(found + found.new_tensor([1.0, 0, 0, 0]))


class FeatureTransformer(nn.Module):
    """A matrix for the features of each neighborhood (N, k, C): (N, C, C), near the identity at first."""

    def __init__(self, channels: int, widths: Sequence[int], joined: Sequence[int]) -> None:
        super().__init__()
        self.channels = channels
        self.each = MLP((channels, *widths))
        self.joined, self.matrix = MLP((widths[-1], *joined)), nn.Linear(joined[-1], channels * channels)

    def forward(self, features: Tensor) -> Tensor:
        found = self.matrix(self.joined(self.each(features).amax(1))).unflatten(1, (self.channels, self.channels))
        matrix: Tensor = found + torch.eye(self.channels).to(found)
        return matrix


class PCPNet(nn.Module):
    """Neighborhoods (B, q, k, 3), nearest first and the point itself the very first -> (B, q, 6), points and normals.

    Each is centered at its point and scaled to the unit sphere here, in training and later alike. The transformers see
    the largest scale; the features of every scale are their maximum, side by side.

    Args:
        neighbors: points of each scale, nearest ones, the largest last; one for the single-scale network
        width: channels as a share of the paper's: 64, 64, then 64, 128, 1024, then 512, 256
        oriented: whether the normals' signs are learned too; else they mean nothing

    Source: Guerrero, Kleiman, Ovsjanikov, Mitra, "PCPNet: Learning Local Shape Properties from Raw Point Clouds",
    Eurographics 2018. Its balls of 1, 3 and 5 % of the shape are nearest points here, so that any density is served.
    """

    task = "normals"
    ratio = 1
    predicts_normals = True

    def __init__(self, neighbors: Sequence[int] = (16, 48, 128), width: float = 0.25, oriented: bool = False) -> None:
        super().__init__()
        check_scales(neighbors)
        if not 0 < width <= 1:
            raise ValueError(f"model.width={width}: expected a share above 0, at most 1")
        self.neighbors, self.oriented = tuple(neighbors), oriented
        first, wide, joined = (
            [max(4, round(width * c)) for c in part] for part in ((64, 64), (64, 128, 1024), (512, 256))
        )
        self.turn = QuaternionTransformer(wide, joined)
        self.entry = MLP((3, *first))
        self.transform = FeatureTransformer(first[-1], wide, joined)
        self.each = MLP((first[-1], *wide))
        self.joined, self.normal = MLP((len(neighbors) * wide[-1], *joined)), nn.Linear(joined[-1], 3)

    def check_input(self, key: str, points: int) -> None:
        """ValueError where neighborhoods have too few points for the largest scale."""
        check_size(key, points, self.neighbors)

    def forward(self, neighborhoods: Tensor) -> Tensor:
        self.check_input("neighbors", neighborhoods.shape[2])
        near = neighborhoods[:, :, : self.neighbors[-1]].flatten(0, 1)
        offset = near - near[:, :1]
        points = offset / offset.norm(dim=-1).amax(1)[:, None, None].clamp_min(1e-12)
        turn = self.turn(points)
        features = self.entry(points @ turn.mT)
        features = self.each(features @ self.transform(features))
        scales = torch.cat([features[:, :k].amax(1) for k in self.neighbors], 1)
        normals = self.normal(self.joined(scales))[:, None] @ turn  # back from the learned frame
        each: Tensor = normals[:, 0].unflatten(0, neighborhoods.shape[:2])
        return torch.cat([neighborhoods[:, :, 0], each], -1)

    def outputs(self, neighborhoods: Tensor) -> dict[str, Tensor]:
        """What the loss may read: here the prediction alone."""
        return {"prediction": self(neighborhoods)}


def check_scales(neighbors: Sequence[int]) -> None:
    """ValueError for numbers of neighbors that are no scales of neighborhoods."""
    if not neighbors or list(neighbors) != sorted(set(neighbors)) or neighbors[0] < SMALLEST:
        raise ValueError(f"model.neighbors={list(neighbors)}: expected ascending numbers from {SMALLEST} on")


def check_size(key: str, points: int, neighbors: Sequence[int]) -> None:
    """ValueError for neighborhoods of fewer points than their largest scale."""
    if points < neighbors[-1]:
        raise ValueError(f"{key}={points}: expected at least {neighbors[-1]}, the largest of model.neighbors")


def rotation(quaternions: Tensor) -> Tensor:
    """The matrices (N, 3, 3) of quaternions (N, 4), w first, of any length."""
    w, x, y, z = normalize(quaternions, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    matrices: Tensor = torch.stack(rows, 1).unflatten(1, (3, 3))
    return matrices
