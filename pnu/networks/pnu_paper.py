"""The network as the paper draws it (Fig. 1): local features from balls of several radii around every point."""

import torch
from torch import Tensor, nn

from pnu.networks import pnu
from pnu.networks.layers import Abstraction

RADII = (0.1, 0.2, 0.3, 0.4)


class MultiscaleFeatures(nn.Module):
    """Balls of several radii around each point, one shared MLP (32, 64, 128), maximum: (B, n, C) -> (B, n, 128).

    What Fig. 1 leaves open is chosen so: radii and neighbors of the released code (four radii also explain the
    figure's label "n x 512"); offsets in units of the radius, so that a shared MLP sees every scale alike; the
    maximum over the scales, which leaves the 128 features of the concatenation.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.abstraction = Abstraction((channels - 3, 32, 64, 128), radius=1)

    def forward(self, x: Tensor) -> Tensor:
        points, features = x[..., :3], x[..., 3:]
        scales = []
        for radius in RADII:
            scaled = points / radius
            scales.append(self.abstraction(scaled, features, scaled))
        return torch.stack(scales).amax(0)


class PNUPaper(pnu.PNU):
    """Point and normal upsampling network as in the paper's Fig. 1; arguments and shapes are those of `PNU`."""

    local = MultiscaleFeatures
    local_width = 128
