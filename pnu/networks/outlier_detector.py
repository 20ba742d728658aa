"""The network that finds stray points, from how each lies among its neighbors, in space or in a camera's picture.

Their features are those of `outlier_features`, `doubt_features` and `pixel_features` in `pnu.geometry`.
"""

import torch
from torch import Tensor, nn

from pnu.geometry.outlier_features import FEATURES


class OutlierDetector(nn.Module):
    """Features of points (n, features) -> logarithm of the odds that each is stray, (n,)."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, features: int = FEATURES, width: int = 64) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("deviation", torch.ones(features))
        self.layers = nn.Sequential(
            nn.Linear(features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 1)
        )

    def forward(self, features: Tensor) -> Tensor:
        odds: Tensor = self.layers((features - self.mean) / self.deviation)
        return odds[:, 0]
