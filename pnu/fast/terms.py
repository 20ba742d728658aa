"""The three neighborhood terms of the loss at once: value and gradient in one pass over pieces in the cache.

Saves about 5 % of a training step on the CPU; on a GPU `term_kernels` do the same.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pnu.fast.gpu import kernels
from pnu.losses import compound
from pnu.runtime.threads import map_on_threads

PIECE = 1024  # points whose neighbors are handled at once


class CompoundLoss(compound.CompoundLoss):
    """`losses.CompoundLoss`, its neighborhood terms in one pass."""

    def neighborhood_terms(self, prediction: Tensor, neighbors: Tensor) -> dict[str, Tensor]:
        """As the plain loss has them; prediction (B, m, 6), neighbors (B, m, k)."""
        on_gpu = kernels("term_kernels", prediction)
        if prediction.shape[-1] != 6 or (prediction.device.type != "cpu" and on_gpu is None):
            return super().neighborhood_terms(prediction, neighbors)
        count = neighbors.numel() if self.reduction == "mean" else len(neighbors)
        values = (on_gpu.neighborhood_sums if on_gpu else sums)(
            prediction, neighbors, self.absolute, compound.TINY
        ) / count
        return dict(zip(("point_knn", "normal_orth", "normal_knn"), values, strict=True))


def sums(prediction: Tensor, neighbors: Tensor, absolute: bool, tiny: float) -> Tensor:
    """Sums over points, neighbors and clouds of `compound.point_knn`, `normal_orth` and `normal_knn`: (3,).

    prediction (B, m, 6), neighbors (B, m, k) int64; `tiny`: squared length below which a direction counts as none.
    """
    apply: Callable[..., Tensor] = _Sums.apply
    return apply(prediction, neighbors, absolute, tiny)


class _Sums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, neighbors: Tensor, absolute: bool, tiny: float) -> Tensor:
        columns = prediction.mT.contiguous()  # (B, 6, m): long rows of one coordinate
        # gradients: of half the first sum and of the second by points, of half the third and of the second by normals
        gradients = (
            torch.zeros(len(columns), 12, columns.shape[2], dtype=columns.dtype) if ctx.needs_input_grad[0] else None
        )

        def work(cloud: int) -> Tensor:
            gradient = None if gradients is None else gradients[cloud]
            return _cloud(columns[cloud], neighbors[cloud], absolute, tiny, gradient)

        total = torch.stack(map_on_threads(work, range(len(columns)))).sum(0)
        ctx.save_for_backward(gradients)
        return total.to(prediction.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        (gradients,) = ctx.saved_tensors
        point, orth, normal = gradient.tolist()
        by_points = 2 * point * gradients[:, :3] + orth * gradients[:, 3:6]
        by_normals = 2 * normal * gradients[:, 6:9] + orth * gradients[:, 9:]
        return torch.cat([by_points, by_normals], 1).mT.contiguous(), None, None, None


def _cloud(columns: Tensor, neighbors: Tensor, absolute: bool, tiny: float, gradient: Tensor | None) -> Tensor:
    """Sums (3,) float64 of one cloud (6, m); fills its gradient (12, m)."""
    total = torch.zeros(3, dtype=torch.float64)
    others = torch.zeros_like(columns[:1].expand(9, -1))  # what reaches the neighbors
    for start in range(0, columns.shape[1], PIECE):
        idx = neighbors[start : start + PIECE]
        own = columns[:, start : start + PIECE, None]
        offsets = own - columns.index_select(1, idx.flatten()).view(6, *idx.shape)
        squares = offsets.square().view(2, 3, *idx.shape).sum(1)  # of points and of normals
        normals = own[3:]
        along = (offsets[:3] * normals).sum(0)
        length_sq, normal_sq = squares[0].clamp_min(tiny), normals.square().sum(0).clamp_min(tiny)
        inverse = (length_sq * normal_sq).rsqrt()
        cosine = along * inverse
        sign = cosine.sign() if absolute else torch.ones_like(cosine)
        signed = cosine * sign
        total += torch.stack([squares[0].sum(), signed.sum(), squares[1].sum()])
        if gradient is None:
            continue
        inverse *= sign
        turn = torch.where(squares[0] > tiny, signed / length_sq, 0)  # a clamped length does not change
        turned = torch.addcmul(normals * inverse, offsets[:3], turn, value=-1)
        for rows, pairs in ((slice(0, 3), offsets[:3]), (slice(3, 6), turned), (slice(6, 9), offsets[3:])):
            others[rows].scatter_add_(1, idx.flatten().expand(3, -1), pairs.flatten(1))
            gradient[rows, start : start + PIECE] = pairs.sum(-1)
        shrink = torch.where(normals.square().sum(0) > tiny, signed.sum(-1, keepdim=True) / normal_sq, 0)
        gradient[9:, start : start + PIECE] = (offsets[:3] * inverse).sum(-1) - (normals * shrink)[..., 0]
    if gradient is not None:
        gradient[:9] -= others
    return total
