"""The three neighborhood terms of the loss as Triton kernels: no table of neighbors (B, m, k, 6) is ever stored.

Imported only where Triton is there, and used on a GPU; in the interpreter as `norm_kernels`. Gradients are added with
atomic operations, as those of gathered rows are: their order, and with it the last digits, may differ from run to run.
"""

from collections.abc import Callable
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

ROWS = 64  # points of a program


@triton.jit
def _row(cloud, row, kept):
    """Point and normal of some rows of a cloud (m, 6)."""
    place = cloud + row * 6
    x = tl.load(place, kept, 0.0)
    y = tl.load(place + 1, kept, 0.0)
    z = tl.load(place + 2, kept, 0.0)
    a = tl.load(place + 3, kept, 0.0)
    b = tl.load(place + 4, kept, 0.0)
    c = tl.load(place + 5, kept, 0.0)
    return x, y, z, a, b, c


@triton.jit
def _sums(prediction, neighbors, parts, m, k, tiny, ABSOLUTE: tl.constexpr, ROWS: tl.constexpr):
    """Sums of the terms over some points and their neighbors: parts (clouds, programs, 3)."""
    cloud = tl.program_id(1).to(tl.int64)
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    kept = row < m
    prediction += cloud * m * 6
    x, y, z, a, b, c = _row(prediction, row, kept)
    normal_sq = tl.maximum(a * a + b * b + c * c, tiny)
    near = tl.zeros((ROWS,), tl.float32)
    orth = tl.zeros((ROWS,), tl.float32)
    alike = tl.zeros((ROWS,), tl.float32)
    for j in range(k):
        other = tl.load(neighbors + (cloud * m + row) * k + j, kept, 0)
        x2, y2, z2, a2, b2, c2 = _row(prediction, other, kept)
        dx, dy, dz, da, db, dc = x - x2, y - y2, z - z2, a - a2, b - b2, c - c2
        square = dx * dx + dy * dy + dz * dz
        cosine = (dx * a + dy * b + dz * c) / tl.sqrt(tl.maximum(square, tiny) * normal_sq)
        near += square
        orth += tl.abs(cosine) if ABSOLUTE else cosine
        alike += da * da + db * db + dc * dc
    place = parts + (cloud * tl.num_programs(0) + tl.program_id(0)) * 3
    tl.store(place, tl.sum(tl.where(kept, near, 0.0), axis=0))
    tl.store(place + 1, tl.sum(tl.where(kept, orth, 0.0), axis=0))
    tl.store(place + 2, tl.sum(tl.where(kept, alike, 0.0), axis=0))


@triton.jit
def _gradients(prediction, neighbors, factors, out, m, k, tiny, ABSOLUTE: tl.constexpr, ROWS: tl.constexpr):
    """Adds the gradient of the sums, times factors (3,), to out (clouds, m, 6)."""
    cloud = tl.program_id(1).to(tl.int64)
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    kept = row < m
    prediction += cloud * m * 6
    out += cloud * m * 6
    of_near, of_orth, of_alike = tl.load(factors), tl.load(factors + 1), tl.load(factors + 2)
    x, y, z, a, b, c = _row(prediction, row, kept)
    squared = a * a + b * b + c * c
    normal_sq = tl.maximum(squared, tiny)
    px, py, pz = tl.zeros((ROWS,), tl.float32), tl.zeros((ROWS,), tl.float32), tl.zeros((ROWS,), tl.float32)
    na, nb, nc = px, py, pz
    for j in range(k):
        other = tl.load(neighbors + (cloud * m + row) * k + j, kept, 0)
        x2, y2, z2, a2, b2, c2 = _row(prediction, other, kept)
        dx, dy, dz, da, db, dc = x - x2, y - y2, z - z2, a - a2, b - b2, c - c2
        square = dx * dx + dy * dy + dz * dz
        inverse = 1 / tl.sqrt(tl.maximum(square, tiny) * normal_sq)
        cosine = (dx * a + dy * b + dz * c) * inverse
        sign = of_orth
        if ABSOLUTE:
            sign = of_orth * tl.where(cosine > 0, 1.0, tl.where(cosine < 0, -1.0, 0.0))
        # below `tiny` a length is a constant
        of_length = 2 * of_near - tl.where(square > tiny, sign * cosine / tl.maximum(square, tiny), 0.0)
        of_normal = tl.where(squared > tiny, sign * cosine / normal_sq, 0.0)
        along = sign * inverse
        gx, gy, gz = of_length * dx + along * a, of_length * dy + along * b, of_length * dz + along * c
        ga, gb, gc = 2 * of_alike * da, 2 * of_alike * db, 2 * of_alike * dc
        px, py, pz = px + gx, py + gy, pz + gz
        na, nb, nc = (
            na + ga + along * dx - of_normal * a,
            nb + gb + along * dy - of_normal * b,
            nc + gc + along * dz - of_normal * c,
        )
        _add(out + other * 6, -gx, -gy, -gz, -ga, -gb, -gc, kept)
    _add(out + row * 6, px, py, pz, na, nb, nc, kept)


@triton.jit
def _add(place, x, y, z, a, b, c, kept):
    tl.atomic_add(place, x, kept, sem="relaxed")
    tl.atomic_add(place + 1, y, kept, sem="relaxed")
    tl.atomic_add(place + 2, z, kept, sem="relaxed")
    tl.atomic_add(place + 3, a, kept, sem="relaxed")
    tl.atomic_add(place + 4, b, kept, sem="relaxed")
    tl.atomic_add(place + 5, c, kept, sem="relaxed")


def neighborhood_sums(prediction: Tensor, neighbors: Tensor, absolute: bool, tiny: float) -> Tensor:
    """As `terms.sums`: prediction (B, m, 6) float32, neighbors (B, m, k) int64 -> (3,)."""
    apply: Callable[..., Tensor] = _Sums.apply
    return apply(prediction.contiguous(), neighbors.contiguous(), absolute, tiny)


class _Sums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, neighbors: Tensor, absolute: bool, tiny: float) -> Tensor:
        clouds, m, k = neighbors.shape
        grid = triton.cdiv(m, ROWS), clouds
        parts = torch.empty(clouds, grid[0], 3, device=prediction.device)
        _sums[grid](prediction, neighbors, parts, m, k, tiny, absolute, ROWS, num_warps=2)
        ctx.save_for_backward(prediction, neighbors)
        ctx.options = absolute, tiny
        return parts.double().sum((0, 1)).float()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        prediction, neighbors = ctx.saved_tensors
        clouds, m, k = neighbors.shape
        out = torch.zeros_like(prediction)
        grid = triton.cdiv(m, ROWS), clouds
        absolute, tiny = ctx.options
        factors = gradient.contiguous()
        _gradients[grid](prediction, neighbors, factors, out, m, k, tiny, absolute, ROWS, num_warps=2)
        return out, None, None, None
