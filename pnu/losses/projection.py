"""Objective of the surface model."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from pnu.losses.compound import TINY


class SurfaceLoss(nn.Module):
    """Objective of the surface model: distance and normal to the closest point of the true surface, in every round.

    Terms, each a mean over queries and a sum over rounds, lengths in spacings of the neighbors:
    "distance" to the surface, found anew for each prediction; "drift" from the surface point closest to the query, with
    weight w_drift, which keeps a seed at its place; "normal", length of the difference of unit normals, w_normal;
    "calibration" of the predicted logarithm of the distance (Laplace), w_error. Queries whose closest surface looks
    away from their rough normal, as on the far side of a thin sheet, do not count.

    Args:
        w_drift: weight of the way from the surface point closest to the seed
        w_normal: weight of predicted against true normals
        w_error: weight of predicted against true distance
    """

    def __init__(self, w_drift: float = 0.5, w_normal: float = 0.1, w_error: float = 0.01) -> None:
        super().__init__()
        self.weights = {"distance": 1.0, "drift": w_drift, "normal": w_normal, "calibration": w_error}

    def forward(self, prediction: Tensor, target: Tensor, extra: Mapping[str, Any]) -> dict[str, Tensor]:
        """`extra`: outputs of `networks.surface.Surface`, and "surface", "index", "center", "side" of the batch."""
        totals: dict[str, Tensor] = dict.fromkeys(self.weights, prediction.new_zeros(()))
        for query, projected, log_error, spacing in zip(
            extra["query"], extra["projected"], extra["log_error"], extra["spacing"], strict=True
        ):
            place, _ = self.closest(query, extra)
            closest, normals = self.closest(projected, extra)
            counts = ((normals * query[..., 3:]).sum(-1) > -0.4).to(spacing)
            counts = counts / counts.sum().clamp_min(1)
            distance = (projected[..., :3] - closest).square().sum(-1).add(TINY).sqrt() / spacing
            drift = ((projected[..., :3] - place).square().sum(-1) / spacing.square() + 0.01).sqrt() - 0.1
            turned = (projected[..., 3:] - normals).square().sum(-1).add(1e-6).sqrt()
            missed = distance.detach().clamp(1e-4, 5)
            terms = {
                "distance": distance, "drift": drift, "normal": turned,
                "calibration": missed * (-log_error).exp() + log_error,
            }  # fmt: skip
            totals = {name: totals[name] + (counts * value).sum() for name, value in terms.items()}
        loss = torch.stack([self.weights[name] * value for name, value in totals.items()]).sum()
        return {**totals, "loss": loss}

    @staticmethod
    def closest(points: Tensor, extra: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Closest surface points and their normals, both (B, m, 3), in the frame of the crops."""
        center = extra["center"].to(points.device)[:, None]
        place, normals = extra["surface"].closest(points[..., :3].detach().double() + center, extra["index"])
        return (place - center).to(points), normals.to(points) * extra["side"].to(points)[:, None, None]
