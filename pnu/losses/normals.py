"""Loss of normals as a task of its own."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize


class NormalLoss(nn.Module):
    """PCPNet: squared difference of each predicted normal to that of its point; row i belongs to row i.

    Nesti-Net, which gives "expert_normals" and "shares" in `extra`: the sum over the experts of share times twice the
    sine of the angle to the true normal; with `oriented`, times the squared difference to it.

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
        true = target[..., 3:6]
        if extra is not None and "expert_normals" in extra:
            value = (extra["shares"] * self.of_experts(extra["expert_normals"], true[..., None, :])).sum(-1).mean()
        else:
            value = self.difference_sq(prediction[..., 3:6], true).mean()
        return {"normal": value, "loss": value}

    def difference_sq(self, found: Tensor, true: Tensor) -> Tensor:
        """Of normals (..., 3): (...)."""
        same, opposite = ((found - sign * true).square().sum(-1) for sign in (1, -1))
        return same if self.oriented else torch.minimum(same, opposite)

    def of_experts(self, found: Tensor, true: Tensor) -> Tensor:
        """The error of each expert's normal (B, q, experts, 3), of any length: (B, q, experts)."""
        unit = normalize(found, dim=-1)
        if self.oriented:
            return self.difference_sq(unit, true)
        sine: Tensor = torch.linalg.cross(unit, true.expand_as(unit)).norm(dim=-1)
        return 2 * sine
