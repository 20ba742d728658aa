"""Batch norm with ReLU, and with the maximum over neighborhoods, as Triton kernels: rows are read and written as rarely
as their arithmetic allows.

Imported only where Triton is there, and used on a GPU. With TRITON_INTERPRET=1 they run on the CPU, slowly, which is
how the tests check them without a GPU. Sums are taken in a fixed order: the same values give the same bits.
"""

from collections.abc import Callable
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

TILE = 2048  # elements that a program holds at once
PROGRAMS = 1024  # that share the rows of a reduction: some for each multiprocessor of a GPU
WIDTHS = 64  # columns of a tile at most


@triton.jit
def _statistics(x, parts, rows, width, per, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Mean and sum of squared deviations of each column over `per` rows: parts (programs, 2, width). They are taken
    about the first row, so that a mean far from zero costs no digits."""
    columns = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    wide = columns < width
    first = tl.program_id(0).to(tl.int64) * per
    last = tl.minimum(first + per, rows)
    shift = tl.load(x + first * width + columns, wide, 0.0).to(tl.float32)
    total = tl.zeros((ROWS, COLUMNS), tl.float32)
    squares = tl.zeros((ROWS, COLUMNS), tl.float32)
    for start in range(0, per, ROWS):
        row = first + start + tl.arange(0, ROWS)
        kept = (row < last)[:, None] & wide[None, :]
        value = tl.load(x + row[:, None] * width + columns[None, :], kept, 0.0).to(tl.float32)
        deviation = tl.where(kept, value - shift[None, :], 0.0)
        total += deviation
        squares += deviation * deviation
    count = (last - first).to(tl.float32)
    total_sum = tl.sum(total, axis=0)
    place = parts + tl.program_id(0) * 2 * width + columns
    tl.store(place, shift + total_sum / count, wide)
    tl.store(place + width, tl.sum(squares, axis=0) - total_sum * total_sum / count, wide)


@triton.jit
def _finish(
    parts, weight, bias, ahead, running_mean, running_var, tracked, saved, rows, width, per, number, momentum, eps,
    PARTS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """Statistics of all parts together (Chan et al. 1979), those that run, and saved (4, width): mean, inverse of the
    deviation, and factor and summand that the norm is. `ahead`: a bias before the norm, which only moves its mean."""
    columns = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    wide = columns < width
    total = tl.zeros((PARTS, COLUMNS), tl.float32)
    for start in range(0, number, PARTS):
        part = start + tl.arange(0, PARTS)
        kept = (part < number)[:, None] & wide[None, :]
        count = tl.maximum(tl.minimum(rows - part * per, per), 0).to(tl.float32)
        total += tl.load(parts + part[:, None] * 2 * width + columns[None, :], kept, 0.0) * count[:, None]
    mean = tl.sum(total, axis=0) / rows
    total = tl.zeros((PARTS, COLUMNS), tl.float32)
    for start in range(0, number, PARTS):
        part = start + tl.arange(0, PARTS)
        kept = (part < number)[:, None] & wide[None, :]
        count = tl.maximum(tl.minimum(rows - part * per, per), 0).to(tl.float32)
        place = parts + part[:, None] * 2 * width + columns[None, :]
        away = tl.load(place, kept, 0.0) - mean[None, :]
        total += tl.where(kept, tl.load(place + width, kept, 0.0) + count[:, None] * away * away, 0.0)
    squares = tl.sum(total, axis=0)
    variance = squares / rows
    inverse = 1 / tl.sqrt(variance + eps)
    scale = tl.load(weight + columns, wide, 0.0) * inverse
    tl.store(saved + columns, mean, wide)
    tl.store(saved + width + columns, inverse, wide)
    tl.store(saved + 2 * width + columns, scale, wide)
    tl.store(saved + 3 * width + columns, tl.load(bias + columns, wide, 0.0) - mean * scale, wide)
    before = tl.load(running_mean + columns, wide, 0.0)
    now = mean + tl.load(ahead + columns, wide, 0.0)
    tl.store(running_mean + columns, before + momentum * (now - before), wide)
    before = tl.load(running_var + columns, wide, 0.0)
    tl.store(running_var + columns, before + momentum * (squares / (rows - 1) - before), wide)
    if tl.program_id(0) == 0:
        tl.store(tracked, tl.load(tracked) + 1)


@triton.jit
def _statistics_of(saved, columns, wide, width):
    """What `_finish` has saved: mean, inverse of the deviation, factor and summand."""
    mean = tl.load(saved + columns, wide, 0.0)
    inverse = tl.load(saved + width + columns, wide, 0.0)
    scale = tl.load(saved + 2 * width + columns, wide, 0.0)
    summand = tl.load(saved + 3 * width + columns, wide, 0.0)
    return mean, inverse, scale, summand


@triton.jit
def _normed(x, saved, row, columns, kept, wide, width):
    """Rows after the norm."""
    scale = tl.load(saved + 2 * width + columns, wide, 0.0)
    summand = tl.load(saved + 3 * width + columns, wide, 0.0)
    value = tl.load(x + row[:, None] * width + columns[None, :], kept, 0.0).to(tl.float32)
    return value * scale[None, :] + summand[None, :]


@triton.jit
def _forward(x, saved, out, rows, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    columns = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    wide = columns < width
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    kept = (row < rows)[:, None] & wide[None, :]
    value = _normed(x, saved, row, columns, kept, wide, width)
    tl.store(out + row[:, None] * width + columns[None, :], tl.where(value < 0, 0.0, value), kept)  # NaN stays NaN


@triton.jit
def _forward_pooled(x, saved, out, member, size, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """The maximum over each group of `size` rows, and which of them it is, the first of equal ones."""
    columns = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    wide = columns < width
    group = tl.program_id(0).to(tl.int64)
    best = tl.full((COLUMNS,), -1.0, tl.float32)
    place = tl.zeros((COLUMNS,), tl.int32)
    for start in range(0, size, ROWS):
        within = start + tl.arange(0, ROWS)
        kept = (within < size)[:, None] & wide[None, :]
        value = _normed(x, saved, group * size + within, columns, kept, wide, width)
        value = tl.where((within < size)[:, None], tl.where(value > 0, value, 0.0), -1.0)
        top, at = tl.max(value, axis=0, return_indices=True)
        better = top > best
        best = tl.where(better, top, best)
        place = tl.where(better, start + at, place)
    best += 0 * tl.load(saved + 3 * width + columns, wide, 0.0)  # NaN where the column has one
    tl.store(out + group * width + columns, best, wide)
    tl.store(member + group * width + columns, place, wide)


@triton.jit
def _sums(
    x, gradient, member, saved, parts, rows, size, width, per,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr, POOLED: tl.constexpr
):  # fmt: skip
    """Of `per` rows or groups: sums of the gradient behind the ReLU, and of it times the normed value."""
    columns = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    wide = columns < width
    first = tl.program_id(0).to(tl.int64) * per
    last = tl.minimum(first + per, rows)
    mean, inverse, scale, summand = _statistics_of(saved, columns, wide, width)
    total = tl.zeros((ROWS, COLUMNS), tl.float32)
    product = tl.zeros((ROWS, COLUMNS), tl.float32)
    for start in range(0, per, ROWS):
        row = first + start + tl.arange(0, ROWS)
        kept = (row < last)[:, None] & wide[None, :]
        place = row[:, None] * width + columns[None, :]
        behind = tl.load(gradient + place, kept, 0.0).to(tl.float32)
        if POOLED:
            place = (row[:, None] * size + tl.load(member + place, kept, 0)) * width + columns[None, :]
        value = tl.load(x + place, kept, 0.0).to(tl.float32)
        behind = tl.where(value * scale[None, :] + summand[None, :] > 0, behind, 0.0)
        total += behind
        product += behind * (value - mean[None, :]) * inverse[None, :]
    place = parts + tl.program_id(0) * 2 * width + columns
    tl.store(place, tl.sum(total, axis=0), wide)
    tl.store(place + width, tl.sum(product, axis=0), wide)


@triton.jit
def _backward(
    x, gradient, member, saved, sums, out, rows, size, width,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr, POOLED: tl.constexpr
):  # fmt: skip
    """The gradient of the rows, from `sums` (2, width) over all of them."""
    columns = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    wide = columns < width
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    kept = (row < rows)[:, None] & wide[None, :]
    mean, inverse, scale, summand = _statistics_of(saved, columns, wide, width)
    of_mean = tl.load(sums + columns, wide, 0.0) / rows
    of_product = tl.load(sums + width + columns, wide, 0.0) / rows
    place = row[:, None] * width + columns[None, :]
    value = tl.load(x + place, kept, 0.0).to(tl.float32)
    if POOLED:
        group = (row // size)[:, None] * width + columns[None, :]
        chosen = tl.load(member + group, kept, 0) == (row % size)[:, None]
        behind = tl.where(chosen, tl.load(gradient + group, kept, 0.0).to(tl.float32), 0.0)
    else:
        behind = tl.load(gradient + place, kept, 0.0).to(tl.float32)
    behind = tl.where(value * scale[None, :] + summand[None, :] > 0, behind, 0.0)
    normed = (value - mean[None, :]) * inverse[None, :]
    tl.store(out + place, scale[None, :] * (behind - of_mean[None, :] - normed * of_product[None, :]), kept)


def norm_tile(width: int) -> tuple[int, int]:
    """Rows and columns of a tile."""
    columns = min(WIDTHS, triton.next_power_of_2(width))
    return TILE // columns, columns


def shares(rows: int, width: int) -> tuple[int, int]:
    """Rows of a program of a reduction, whole tiles, and how many programs that makes."""
    height, columns = norm_tile(width)
    programs = max(1, PROGRAMS // triton.cdiv(width, columns))
    per = triton.cdiv(triton.cdiv(rows, programs), height) * height
    return per, triton.cdiv(rows, per)


def normed_relu(x: Tensor, norm: torch.nn.BatchNorm1d, ahead: Tensor | None = None, size: int | None = None) -> Tensor:
    """ReLU of a batch norm in training mode: rows (R, C) -> (R, C), and the running statistics go on.

    Args:
        x: float32, or float16 or bfloat16, which the output then is.
        norm: whose momentum is a number.
        ahead: (C,) a bias that x lacks. It moves the running mean, nothing else, and its gradient is zero.
        size: with it the maximum over each group of so many rows that follow each other: (R / size, C).
    """
    assert norm.running_mean is not None
    nothing = torch.zeros_like(norm.running_mean) if ahead is None else ahead
    apply: Callable[..., Tensor] = _NormedReLU.apply
    return apply(x.contiguous(), norm.weight, norm.bias, nothing, norm, size)


class _NormedReLU(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, ahead: Tensor, norm: torch.nn.BatchNorm1d, size: int | None
    ) -> Tensor:
        rows, width = x.shape
        height, columns = norm_tile(width)
        blocks = triton.cdiv(width, columns)
        per, number = shares(rows, width)
        parts = torch.empty(number, 2, width, device=x.device)
        saved = torch.empty(4, width, device=x.device)
        _statistics[(number, blocks)](x, parts, rows, width, per, height, columns)
        _finish[(triton.cdiv(width, 16),)](
            parts, weight, bias, ahead, norm.running_mean, norm.running_var, norm.num_batches_tracked, saved,
            rows, width, per, number, norm.momentum, norm.eps, 64, 16,
        )  # fmt: skip
        if size is None:
            out, member = torch.empty_like(x), None
            _forward[(triton.cdiv(rows, height), blocks)](x, saved, out, rows, width, height, columns)
        else:
            out = x.new_empty(rows // size, width)
            member = torch.empty(rows // size, width, dtype=torch.int32, device=x.device)
            height = min(height, triton.next_power_of_2(size))
            _forward_pooled[(rows // size, blocks)](x, saved, out, member, size, width, height, columns)
        ctx.size = size
        ctx.save_for_backward(x, saved, *(() if member is None else (member,)))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, saved, *pooled = ctx.saved_tensors
        gradient = gradient.contiguous()
        (rows, width), size = x.shape, ctx.size or 1
        member = pooled[0] if pooled else gradient  # which is then not read
        height, columns = norm_tile(width)
        blocks = triton.cdiv(width, columns)
        per, number = shares(len(gradient), width)
        parts = torch.empty(number, 2, width, device=x.device)
        _sums[(number, blocks)](
            x, gradient, member, saved, parts, len(gradient), size, width, per, height, columns, bool(pooled)
        )
        sums = parts.sum(0)
        out = torch.empty_like(x)
        _backward[(triton.cdiv(rows, height), blocks)](
            x, gradient, member, saved, sums, out, rows, size, width, height, columns, bool(pooled)
        )
        return out, sums[1], sums[0], torch.zeros_like(sums[0]), None, None
