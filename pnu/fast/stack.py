"""Layers over very many rows, made for the CPU: all that is not a matrix product happens in the cache.

A stack of layers (linear, batch norm, ReLU) on rows (R, C) as torch runs it moves every activation about ten times
through memory. Here each layer runs chunk by chunk: rectify the chunk below, multiply, sum up statistics, store the
products, nothing else. Backward computes the activations of a chunk anew. Identities save more, most of them because
batch norm cancels whatever constant is added to its input:

- the bias of its linear layer enters the running mean only (its gradient is zero);
- ReLU(scale p + shift) is scale max(p, threshold) and a constant: one operation; the next weight takes in the scale;
- the gradient of the products sums to zero over rows, so that constant does not enter the gradient of a weight either;
- the sum of gradient times activation, which batch norm needs, follows from the weight and its gradient;
- the maximum over a group commutes with the monotone batch norm and ReLU after it, so the products are pooled;
- rows that count several times (`Groups.multiplicity`) are computed once and weighted in the statistics;
- rows gathered from a table, plus products of their offsets, are made where they are used and never stored.

Results are those of the plain layers to rounding, and the same bit for bit in every run with as many threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.distributed
from torch import Tensor
from torch.autograd.function import once_differentiable

from pnu.fast.cache import Chunk, Scratch, group_chunks, map_chunks, row_chunks
from pnu.fast.combine import scatter
from pnu.fast.neighborhoods import Neighborhoods, ungroup
from pnu.networks.layers import Layer
from pnu.networks.norm import BatchNorm, check_rows, everywhere

FAR = 8  # deviations between threshold and mean, beyond which their difference costs too many digits


def train_stack(
    x: Tensor,
    layers: Sequence[Layer],
    *,
    projected: bool = False,
    groups: Neighborhoods | None = None,
    offsets: Tensor | None = None,
) -> Tensor:
    """Layers in training mode on CPU rows x (R, C): (R, C'), or their maximum over groups, (G, C').

    With `projected`, x already holds the products of the first layer. With `offsets` (R, D) too, x is a table
    (points, C) of the products of all columns but the first D, and row r is x[groups.source[r]] plus the products of
    offsets[r], the first D.
    """
    falling = layers[0].norm.weight.detach() < 0
    of_offsets = None if offsets is None else layers[0].linear.weight[:, : offsets.shape[1]]
    if projected and bool(falling.any()):
        sign = _sign(layers[0].norm)
        x, of_offsets = x * sign, None if of_offsets is None else of_offsets * sign[:, None]
    weights = [None if projected and i == 0 else layer.linear.weight for i, layer in enumerate(layers)]
    biases = [layer.linear.bias for layer in layers]
    scales, shifts = [layer.norm.weight for layer in layers], [layer.norm.bias for layer in layers]
    apply: Callable[..., Tensor] = _Stack.apply
    return apply(x, offsets, of_offsets, layers, groups, *weights, *biases, *scales, *shifts)


def _sign(norm: BatchNorm) -> Tensor:
    """-1 where batch norm falls, else 1 (C,): products are multiplied with it, so that all batch norms rise."""
    return torch.where(norm.weight.detach() < 0, -1.0, 1.0).to(norm.weight.dtype)


class Norm(NamedTuple):
    """Batch norm of one layer in one step: statistics of its products, and the affine map that it makes of them."""

    mean: Tensor
    inverse_deviation: Tensor
    scale: Tensor  # > 0
    shift: Tensor
    threshold: Tensor  # ReLU(scale p + shift) = scale (max(p, threshold) - threshold)
    total: float  # rows, in all processes

    def activate(self, products: Tensor, out: Tensor) -> Tensor:
        """Batch norm and ReLU."""
        return torch.addcmul(self.shift, products, self.scale, out=out).relu_()


class Moments(NamedTuple):
    """Of the products of a layer, in float64."""

    rows: Tensor  # their number, each as often as it counts
    alone: Tensor  # sum of products - constant, (C,)
    squares: Tensor  # sum of their squares
    constant: Tensor
    taken_off: bool  # the products are stored without the constant

    @property
    def mean(self) -> Tensor:
        """Of the products as they are stored."""
        mean = self.alone / self.rows
        return mean if self.taken_off else self.constant + mean

    @property
    def square(self) -> Tensor:
        """Sum of squared deviations from the mean."""
        return self.squares - self.alone.square() / self.rows


class Rows(NamedTuple):
    """Rows as they are stored."""

    table: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        """(R, C)."""
        return self.table.shape[0], self.table.shape[1]

    def chunk(self, chunk: Chunk, space: Tensor) -> Tensor:
        """Rows of a chunk, a view; `space` stays unused."""
        return self.table[chunk.rows]


class Gathered(NamedTuple):
    """Rows table[groups.source] plus products of offsets, made when they are asked for.

    An offset is multiplied after its subtraction: products of a point and of a center near it differ by less than they
    are rounded by.
    """

    table: Tensor  # (points, C)
    offsets: Tensor  # (R, D)
    weight: Tensor  # (C, D), of offsets
    groups: Neighborhoods

    @property
    def shape(self) -> tuple[int, int]:
        """(R, C)."""
        return len(self.groups.source), self.table.shape[1]

    def chunk(self, chunk: Chunk, space: Tensor) -> Tensor:
        """Rows of a chunk, in `space`."""
        out = space[: chunk.stop - chunk.start]
        torch.index_select(self.table, 0, self.groups.source[chunk.rows], out=out)
        return out.addmm_(self.offsets[chunk.rows], self.weight.t())


def _rows(
    x: Tensor, offsets: Tensor | None, of_offsets: Tensor | None, groups: Neighborhoods | None
) -> Rows | Gathered:
    if offsets is None or of_offsets is None or groups is None:
        return Rows(x)
    return Gathered(x, offsets, of_offsets, groups)


class LayerInput(NamedTuple):
    """Where the input of a layer comes from: rows as they are, or the products of the layer below, rectified."""

    rows: Rows | Gathered
    norm: Norm | None = None

    def chunk(self, chunk: Chunk, space: Tensor) -> Tensor:
        """The input of a chunk, but for scale and shift; `space` holds it if it must be computed."""
        rows = self.rows.chunk(chunk, space)
        return rows if self.norm is None else torch.maximum(rows, self.norm.threshold, out=space[: len(rows)])


class _Stack(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        offsets: Tensor | None,
        of_offsets: Tensor | None,
        layers: Sequence[Layer],
        groups: Neighborhoods | None,
        *parameters: Tensor,
    ) -> Tensor:
        often = groups.multiplicity if groups else None
        often = often if often is None else often.to(x.dtype)
        first = _rows(x, offsets, of_offsets, groups)
        source, stored, norms, weights = LayerInput(first), [], [], []
        pooled = None
        for i, layer in enumerate(layers):
            weight = parameters[i]
            if weight is not None:
                weight = weight * _sign(layer.norm)[:, None]
                weight = weight if source.norm is None else weight * source.norm.scale
            last = i == len(layers) - 1
            products, pooled, moments = _multiply(source, weight, layer, often, groups, last)
            norms.append(_statistics(layer, weight, source.norm, moments))
            stored.append(None if weight is None else products.table)
            weights.append(weight)
            source = LayerInput(products, norms[-1])
        ctx.layers, ctx.groups, ctx.norms, ctx.points = layers, groups, norms, len(x)
        ctx.save_for_backward(often, pooled, x, offsets, of_offsets, *stored, *weights)
        if pooled is not None and groups is not None:
            return ungroup(norms[-1].activate(pooled, torch.empty_like(pooled)), groups)
        out = x.new_empty(source.rows.shape)

        def activate(part: list[Chunk]) -> None:
            for chunk in part:
                norms[-1].activate(source.rows.chunk(chunk, out), out[chunk.rows])

        map_chunks(activate, row_chunks(*out.shape))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        layers, groups, norms, depth = ctx.layers, ctx.groups, ctx.norms, len(ctx.layers)
        often, pooled, x, offsets, of_offsets, *tensors = ctx.saved_tensors
        first = _rows(x, offsets, of_offsets, groups)
        products = [first if table is None else Rows(table) for table in tensors[:depth]]
        sources = [LayerInput(first), *map(LayerInput, products, norms)]  # sources[i] is the input of layer i
        weights = tensors[depth:]
        d_weights: list[Tensor | None] = [None] * depth
        d_scales, d_shifts = [], []
        norm = norms[-1]
        kept: Tensor | None
        if pooled is None:
            kept, sums = _rectify_all(products[-1], norm, gradient.contiguous())
        else:
            gradient = gradient if groups.order is None else gradient[groups.order]
            kept = (gradient * (pooled > norm.threshold)).mul_(norm.scale)
            sums = torch.stack([kept.sum(0), (kept * (pooled - norm.mean)).sum(0)])
        for i in reversed(range(depth)):
            norm, source = norms[i], sources[i]
            assert kept is not None  # wanted in every layer but the first
            sign = _sign(layers[i].norm)
            d_shifts.append(sums[0] / norm.scale)
            d_scales.append(sums[1] * norm.inverse_deviation / norm.scale * sign)
            slope_level = _through_statistics(layers[i].norm, norm, sums)
            d_products = _Gradient(products[i], kept, *slope_level, often, groups, pooled)
            kept, sums, d_weight = _pull_back(d_products, source, weights[i], any(ctx.needs_input_grad[:3]))
            if d_weight is not None:
                scale = sign[:, None] if source.norm is None else sign[:, None] * source.norm.scale
                d_weights[i] = d_weight * scale
            pooled = None
        d_biases = [None if layer.linear.bias is None else torch.zeros_like(layer.linear.bias) for layer in layers]
        d_offsets = d_of_offsets = None
        if isinstance(first, Gathered) and kept is not None:
            d_offsets = kept @ of_offsets if ctx.needs_input_grad[1] else None
            d_of_offsets = (offsets.t() @ kept).t()  # twice as fast as the other way around
            kept = scatter(kept, groups.source[:, None], None, ctx.points)
        d_parameters = *d_weights, *d_biases, *reversed(d_scales), *reversed(d_shifts)
        return kept, d_offsets, d_of_offsets, None, None, *d_parameters


def _chunks(rows: int, width: int, groups: Neighborhoods | None) -> list[Chunk]:
    return row_chunks(rows, width) if groups is None else group_chunks(groups, width)


def _multiply(
    source: LayerInput,
    weight: Tensor | None,
    layer: Layer,
    often: Tensor | None,
    groups: Neighborhoods | None,
    last: bool,
) -> tuple[Rows | Gathered, Tensor | None, Moments]:
    """Products (R, C) of a layer, after the last one their maxima (G, C) over groups if given, and their moments.

    A constant (C,), near the mean, is taken off the products: no digits are lost to it, in no layer that follows.
    """
    rows, columns = source.rows.shape
    like, width = layer.norm.weight.detach(), layer.norm.num_features
    products = source.rows if weight is None else Rows(like.new_empty(rows, width))
    pooled = like.new_empty(groups.number, width) if groups and last else None
    chunks = _chunks(rows, max(columns, width), groups)
    across = None if weight is None else weight.t().contiguous()
    sums = like.new_empty(len(chunks), 2, width)

    def multiply(chunk: Chunk, hidden: Tensor) -> Tensor:
        out = products.chunk(chunk, hidden)
        return out if across is None else torch.mm(source.chunk(chunk, hidden), across, out=out)

    with torch.no_grad():
        constant = multiply(chunks[0], Scratch(chunks[:1], like)(columns)).mean(0)
        total = _everywhere(layer.norm, constant, torch.ones_like(constant))
        constant = total[0] / total[1]  # the same in all processes

    def work(part: list[Chunk]) -> None:
        scratch = Scratch(part, like)
        hidden, space = scratch(columns), scratch(width)
        for chunk in part:
            out = multiply(chunk, hidden)
            free = space[: len(out)]
            shifted = torch.sub(out, constant, out=free if across is None else out)
            if pooled is not None:
                torch.amax(chunk.grouped(out), 1, out=pooled[chunk.groups])
            counts = scratch.ones[: len(out)] if often is None else often[chunk.rows]
            alone, squares = sums[chunk.number]
            torch.mv(shifted.t(), counts, out=alone)
            torch.mv(torch.square(shifted, out=free).t(), counts, out=squares)

    map_chunks(work, chunks)
    count = torch.tensor(float(rows), dtype=torch.float64) if often is None else often.double().sum()
    alone, squares = sums.double().sum(0)
    return products, pooled, Moments(count, alone, squares, constant.double(), across is not None)


def _statistics(layer: Layer, weight: Tensor | None, below: Norm | None, moments: Moments) -> Norm:
    """Batch norm from the moments of all products; updates the running statistics. `weight` is the one that the
    products were made with, from activations as `LayerInput` gives them."""
    norm, sign = layer.norm, _sign(layer.norm)
    count, mean, square = moments.rows, moments.mean, moments.square
    if norm.synchronized:
        count, total, square = _everywhere(norm, count.expand_as(mean), count * mean, square + count * mean.square())
        mean = total / count
        square = square - count * mean.square()
    check_rows(float(count.max()))
    inverse = (square / count + norm.eps).rsqrt()
    plain = mean + moments.constant if moments.taken_off else mean
    if weight is not None and below is not None:
        plain = plain - weight.double() @ below.threshold.double()
    plain = sign * plain
    norm.track(plain if layer.linear.bias is None else plain + layer.linear.bias.detach(), square / (count - 1))
    dtype = norm.weight.dtype
    scale = inverse * norm.weight.detach().double().abs().clamp_min(torch.finfo(dtype).eps)
    shift = norm.bias.detach().double() - mean * scale
    mean, inverse, scale, shift, threshold = (x.to(dtype) for x in (mean, inverse, scale, shift, -shift / scale))
    return Norm(mean, inverse, scale, shift, threshold, count.max().item())


def _everywhere(norm: BatchNorm, *sums: Tensor) -> list[Tensor]:
    """Sums over all processes, where batch norm is to be synchronized."""
    total = torch.stack(sums)
    return list(everywhere(total) if norm.synchronized and torch.distributed.is_initialized() else total)


class _Gradient(NamedTuple):
    """Gradient of the products of a layer: directly, and through the mean and variance that they enter."""

    products: Rows | Gathered
    kept: Tensor  # gradient before the ReLU times the scale, (R, C) or of the maxima (G, C)
    slope: Tensor
    level: Tensor
    often: Tensor | None
    groups: Neighborhoods | None
    pooled: Tensor | None  # maxima

    def chunk(self, chunk: Chunk, out: Tensor, space: Tensor) -> Tensor:
        """kept + often (slope products + level), (r, C)."""
        products = self.products.chunk(chunk, space)
        torch.addcmul(self.level, products, self.slope, out=out)
        if self.often is not None:  # only the first of a group counts several times
            chunk.grouped(out)[:, 0] *= chunk.grouped(self.often[chunk.rows, None])[:, 0]
        if self.pooled is None:
            return out.add_(self.kept[chunk.rows])
        # to the maximum, in equal parts where there are several
        pooled, gradient = self.pooled[chunk.groups], self.kept[chunk.groups]
        hit = torch.eq(chunk.grouped(products), pooled[:, None], out=chunk.grouped(space[: len(products)]))
        if hit.sum() > pooled.numel():
            gradient = gradient / hit.sum(1)
        chunk.grouped(out).addcmul_(hit, gradient[:, None])
        return out


def _through_statistics(module: BatchNorm, norm: Norm, sums: Tensor) -> tuple[Tensor, Tensor]:
    """Slope and level of the gradient that reaches all products alike, from the sums (2, C) of `kept`: alone, and times
    the deviation of the products from their mean."""
    alone, with_deviation = _everywhere(module, *sums)
    slope = -norm.inverse_deviation.square() * with_deviation / norm.total
    return slope, -alone / norm.total - slope * norm.mean


def _pull_back(
    gradient: _Gradient, source: LayerInput, weight: Tensor | None, wanted: bool
) -> tuple[Tensor | None, Tensor, Tensor | None]:
    """From the gradient of a layer's products to that of its input; if there is a layer below, before its ReLU and
    times its scale.

    Returns it (None if it is not wanted), its sums as `_through_statistics` takes them, and the gradient of the weight
    with respect to the activations as `LayerInput` gives them.
    """
    (rows, columns), below = source.rows.shape, source.norm
    width, like = gradient.products.shape[1], gradient.kept
    wanted = wanted or below is not None
    result = like.new_empty(rows, columns) if wanted else None
    chunks = _chunks(rows, max(columns, width), gradient.groups)
    sums = like.new_zeros(len(chunks), 2, columns)
    # where the threshold is far from the mean, the sum times the deviation is taken as it is
    far = below is not None and bool(((below.threshold - below.mean).abs() * below.inverse_deviation > FAR).any())

    def work(part: list[Chunk]) -> Tensor | None:
        scratch = Scratch(part, like)
        total = None if weight is None else torch.zeros_like(weight)
        hidden, space, products = scratch(columns), scratch(max(width, columns)).flatten(), scratch(width)
        for chunk in part:
            number = chunk.stop - chunk.start
            d_products = products[:number] if weight is not None or result is None else result[chunk.rows]
            gradient.chunk(chunk, d_products, space[: number * width].view(number, width))
            if weight is None or total is None:
                continue
            inputs = source.chunk(chunk, hidden)
            total.addmm_(d_products.t(), inputs)
            if result is None:
                continue
            out = torch.mm(d_products, weight, out=result[chunk.rows])
            if below is not None:
                free = space[: number * columns].view(number, columns)
                out *= torch.gt(inputs, below.threshold, out=free)
                alone, with_deviation = sums[chunk.number]
                torch.mv(out.t(), scratch.ones[:number], out=alone)
                if far:
                    torch.sub(inputs, below.mean, out=free).mul_(out)
                    torch.mv(free.t(), scratch.ones[:number], out=with_deviation)
        return total

    parts = map_chunks(work, chunks)
    d_weight = None if weight is None else torch.stack(parts).sum(0)  # type: ignore[arg-type]
    total = sums.sum(0)
    if below is not None and weight is not None and d_weight is not None and not far:
        total[1] = (weight * d_weight).sum(0) + (below.threshold - below.mean) * total[0]
    return result, total, d_weight


def _rectify_all(rows: Rows | Gathered, norm: Norm, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """The gradient (R, C) of a stack's output, before the last ReLU and times the last scale; and its sums (2, C)."""
    kept = torch.empty_like(gradient)
    chunks = row_chunks(*gradient.shape)
    sums = gradient.new_empty(len(chunks), 2, gradient.shape[1])

    def work(part: list[Chunk]) -> None:
        scratch = Scratch(part, gradient)
        hidden, space = scratch(gradient.shape[1]), scratch(gradient.shape[1])
        for chunk in part:
            products = rows.chunk(chunk, hidden)
            number = len(products)
            free, out = space[:number], kept[chunk.rows]
            torch.mul(gradient[chunk.rows], torch.gt(products, norm.threshold, out=free), out=out).mul_(norm.scale)
            alone, with_deviation = sums[chunk.number]
            torch.mv(out.t(), scratch.ones[:number], out=alone)
            torch.mv(torch.sub(products, norm.mean, out=free).mul_(out).t(), scratch.ones[:number], out=with_deviation)

    map_chunks(work, chunks)
    return kept, sums.sum(0)


def infer_stack(
    x: Tensor,
    layers: Sequence[Layer],
    *,
    projected: bool = False,
    groups: Neighborhoods | None = None,
    offsets: Tensor | None = None,
) -> Tensor:
    """`train_stack` in eval mode and without gradient: batch norm folded into the weights, no layer stored."""
    folded = [_fold(layer) for layer in layers]
    rows = _rows(x, offsets, None if offsets is None else layers[0].linear.weight[:, : offsets.shape[1]], groups)
    width = max(rows.shape[1], *(len(shift) for _, _, shift in folded))
    chunks = _chunks(rows.shape[0], width, groups)
    result = x.new_empty(rows.shape[0] if groups is None else groups.number, len(folded[-1][2]))

    def work(part: list[Chunk]) -> None:
        scratch = Scratch(part, x)
        spaces = scratch(width).flatten(), scratch(width).flatten()
        for chunk in part:
            number = chunk.stop - chunk.start
            h = rows.chunk(chunk, spaces[1][: number * rows.shape[1]].view(number, -1))
            for i, (weight, scale, shift) in enumerate(folded):
                out = spaces[i % 2][: len(h) * len(shift)].view(len(h), -1)
                if projected and i == 0:
                    h = torch.addcmul(shift, h, scale, out=out).relu_()
                else:
                    h = torch.addmm(shift, h, weight.t(), out=out).relu_()
            if groups is None:
                result[chunk.rows] = h
            else:
                torch.amax(chunk.grouped(h), 1, out=result[chunk.groups])

    map_chunks(work, chunks)
    return result if groups is None else ungroup(result, groups)


def _fold(layer: Layer) -> tuple[Tensor, Tensor, Tensor]:
    """Weight, scale and shift: a layer in eval mode is ReLU(weight x + shift), or ReLU(scale products + shift)."""
    norm, linear = layer.norm, layer.linear
    if norm.running_mean is None or norm.running_var is None:
        raise ValueError("batch norm: expected running statistics, which eval mode needs, found none")
    scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
    shift = norm.bias - norm.running_mean * scale
    return linear.weight * scale[:, None], scale, shift if linear.bias is None else shift + linear.bias * scale
