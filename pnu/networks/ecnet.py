"""EC-Net: PU-Net's features, residual coordinates, and the regressed distance of each new point to the nearest edge."""

from torch import Tensor, nn

from pnu.networks.layers import MLP
from pnu.networks.punet import Branches, HierarchicalFeatures, check_ratio, coordinates


class ECNet(nn.Module):
    """Patches (B, n, 3 or 6) -> (B, ratio n, 3), n >= 64; normals of the input are not read, none are predicted.

    `outputs` adds "edge_distance" (B, ratio n), the distance of each new point to the nearest sharp edge, in the
    patch's units, for the edge-aware loss (`pnu.losses.EdgeAwareLoss`).

    Args:
        ratio: points out for each point in: 2 or more

    Source: Yu, Li, Fu, Cohen-Or, Heng, "EC-Net: an Edge-aware Point set Consolidation Network", ECCV 2018, section 3.2:
    expanded features give edge distances by two fully connected layers, and from the features with these distances
    two more give offsets that are added to the input coordinates.
    """

    predicts_normals = False
    patch_size = 1024

    def __init__(self, ratio: int = 4) -> None:
        super().__init__()
        check_ratio(ratio)
        self.ratio = ratio
        self.features = HierarchicalFeatures()
        self.expansion = Branches(ratio, (self.features.width, 256, 128))
        self.distance = nn.Sequential(MLP((128, 64)), nn.Linear(64, 1))
        self.offset = nn.Sequential(MLP((128, 64)), nn.Linear(64, 3))

    def forward(self, patch: Tensor) -> Tensor:
        return self.outputs(patch)["prediction"]

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """ "prediction" (B, ratio n, 3), and "edge_distance" (B, ratio n) of each of its points to the nearest edge."""
        points = coordinates(patch)
        features = self.expansion(self.features(points))
        return {
            "prediction": points.repeat(1, self.ratio, 1) + self.offset(features),
            "edge_distance": self.distance(features)[..., 0],
        }
