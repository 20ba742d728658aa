"""Weighted sums of rows with a fast, repeatable gradient."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import csr_matrix
from torch import Tensor
from torch.autograd.function import once_differentiable


def combine(features: Tensor, idx: Tensor, weight: Tensor | None = None) -> Tensor:
    """Sums of rows: features (n, C), idx (q, k) int64, weight (q, k) -> (q, C).

    out[i] = sum over j of weight[i, j] features[idx[i, j]]; weights are 1 where there are none. Differentiable with
    respect to the features; on the CPU the gradient is the same operation with the transposed indices, so it adds in
    one fixed order and needs no atomic additions.
    """
    if features.device.type == "cpu" and features.dtype == torch.float32:
        apply: Callable[..., Tensor] = _Combine.apply
        return apply(features, idx, weight)
    rows = features[idx.flatten()].view(*idx.shape, -1)
    return rows.sum(1) if weight is None else (rows * weight[..., None]).sum(1)


class _Combine(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, idx: Tensor, weight: Tensor | None) -> Tensor:
        ctx.sources = len(features)
        ctx.save_for_backward(idx, *(() if weight is None else (weight,)))
        if weight is None and idx.shape[1] == 1:
            return features.index_select(0, idx[:, 0])
        return F.embedding_bag(idx, features, mode="sum", per_sample_weights=weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        idx, *weights = ctx.saved_tensors
        return scatter(gradient, idx, weights[0] if weights else None, ctx.sources), None, None


def scatter(gradient: Tensor, idx: Tensor, weight: Tensor | None, sources: int) -> Tensor:
    """The gradient (n, C) of `combine` with respect to its n = `sources` features, from that of its output (q, C).

    CPU, float32 or float64.
    """
    queries, k = idx.shape
    values = torch.ones(queries * k, dtype=gradient.dtype) if weight is None else weight.flatten()
    matrix = csr_matrix(
        (values.numpy(), idx.flatten().numpy(), np.arange(0, queries * k + 1, k)), shape=(queries, sources)
    ).tocsc()
    return F.embedding_bag(
        torch.from_numpy(matrix.indices),
        gradient.contiguous(),
        torch.from_numpy(matrix.indptr[:-1]),
        mode="sum",
        per_sample_weights=torch.from_numpy(matrix.data),
    )
