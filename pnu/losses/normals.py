"""Loss of normals as a task of its own."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn


class NormalLoss(nn.Module):
    """PCPNet: squared difference of each predicted normal to that of its point; row i belongs to row i.

    Args:
        oriented: whether signs count; else the smaller one of both
    """

    def __init__(self, oriented: bool = False) -> None:
        super().__init__()
        self.oriented = oriented

    def forward(
        self, prediction: Tensor, target: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """(B, q, 6) both -> "normal", which is the "loss"."""
        found, true = prediction[..., 3:6], target[..., 3:6]
        same, opposite = ((found - sign * true).square().sum(-1) for sign in (1, -1))
        value = (same if self.oriented else torch.minimum(same, opposite)).mean()
        return {"normal": value, "loss": value}
