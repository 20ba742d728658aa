"""Losses: `loss(prediction, target, extra)` gives every term by name and their weighted sum as "loss"."""

from pnu.losses.adversarial import AdversarialLoss
from pnu.losses.compound import CompoundLoss
from pnu.losses.normals import NormalLoss
from pnu.losses.projection import SurfaceLoss
from pnu.losses.rivals import EdgeAwareLoss, ParameterizationLoss, PyramidLoss, RepulsionLoss

__all__ = [
    "AdversarialLoss",
    "CompoundLoss",
    "EdgeAwareLoss",
    "NormalLoss",
    "ParameterizationLoss",
    "PyramidLoss",
    "RepulsionLoss",
    "SurfaceLoss",
]
