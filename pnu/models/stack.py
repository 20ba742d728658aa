"""Layers over very many rows, made for the CPU: all that is not a matrix product happens in the cache.

A stack of layers (linear, batch norm, ReLU) on rows (R, C) as torch runs it moves every activation about ten times
through memory. Here each layer runs chunk by chunk: normalise and rectify the chunk below, multiply, collect
statistics, store the products, nothing else. Backward computes the activations of a chunk anew. Three identities save
more:

- batch norm cancels the bias of its linear layer, which enters the running mean only (its gradient is zero);
- the maximum over a group commutes with the monotone batch norm and ReLU after it, so the products are pooled;
- rows that count several times (`Groups.multiplicity`) are computed once and weighted in the statistics.

Results are those of the plain layers to rounding, and the same bit for bit in every run with as many threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.distributed
from torch import Tensor
from torch.autograd.function import once_differentiable

from pnu.models.chunks import Chunk, Scratch, group_chunks, row_chunks, spread
from pnu.models.neighborhoods import Groups, ungroup
from pnu.models.norm import BatchNorm, everywhere

if TYPE_CHECKING:
    from pnu.models.layers import Layer


def train(x: Tensor, layers: Sequence[Layer], *, projected: bool = False, groups: Groups | None = None) -> Tensor:
    """Layers in training mode on CPU rows x (R, C): (R, C'), or their maximum over groups, (G, C').

    With `projected`, x already holds the products of the first layer.
    """
    weights = [None if projected and i == 0 else layer.linear.weight for i, layer in enumerate(layers)]
    biases = [layer.linear.bias for layer in layers]
    scales, shifts = [layer.norm.weight for layer in layers], [layer.norm.bias for layer in layers]
    return _Stack.apply(x, layers, groups, *weights, *biases, *scales, *shifts)


class Norm(NamedTuple):
    """Batch norm of one layer in one step: statistics of its products, and the affine map that it makes of them."""

    mean: Tensor
    inverse_deviation: Tensor
    scale: Tensor
    shift: Tensor
    total: float  # rows, in all processes

    def activate(self, products: Tensor, out: Tensor) -> Tensor:
        """Batch norm and ReLU."""
        return torch.addcmul(self.shift, products, self.scale, out=out).relu_()


class Source(NamedTuple):
    """Where the input of a layer comes from: rows as they are, or the products of the layer below."""

    rows: Tensor
    norm: Norm | None = None

    def chunk(self, chunk: Chunk, space: Tensor) -> Tensor:
        """The input of a chunk; `space` holds it if it must be computed."""
        rows = self.rows[chunk.rows]
        return rows if self.norm is None else self.norm.activate(rows, space[: len(rows)])


class _Stack(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, layers: Sequence[Layer], groups: Groups | None, *parameters: Tensor) -> Tensor:
        weights: list[Tensor | None] = list(parameters[: len(layers)])
        often = groups.multiplicity if groups else None
        often = often if often is None else often.to(x.dtype)
        source, sources, norms = Source(x), [], []
        for i, layer in enumerate(layers):
            sign = None
            if groups and i == len(layers) - 1:
                # a falling batch norm would ask for the minimum: let all rise
                sign = torch.where(layer.norm.weight < 0, -1.0, 1.0).to(x.dtype)
                weights[i] = parameters[i] * sign[:, None]
            products, pooled, moments = _multiply(
                source, weights[i], layer, often, groups if sign is not None else None
            )
            norms.append(_statistics(layer, sign, *moments))
            sources.append(source)
            source = Source(products, norms[-1])
        ctx.layers, ctx.groups, ctx.norms, ctx.sign = layers, groups, norms, sign
        ctx.save_for_backward(often, pooled, *(source.rows for source in sources), source.rows, *weights)
        if pooled is not None and groups is not None:
            return ungroup(norms[-1].activate(pooled, torch.empty_like(pooled)), groups)
        out = torch.empty_like(source.rows)

        def activate(part: list[Chunk]) -> None:
            for chunk in part:
                source.chunk(chunk, out[chunk.rows])

        spread(activate, row_chunks(*out.shape))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        layers, groups, norms, depth = ctx.layers, ctx.groups, ctx.norms, len(ctx.layers)
        often, pooled, *tensors = ctx.saved_tensors
        rows, weights = tensors[: depth + 1], tensors[depth + 1 :]
        d_weights: list[Tensor | None] = [None] * depth
        d_scales, d_shifts = [], []
        maxima = None
        kept: Tensor | None
        if pooled is None:
            kept, sums = _rectify_all(Source(rows[depth], norms[-1]), gradient.contiguous())
        else:
            gradient = gradient if groups.order is None else gradient[groups.order]
            kept = gradient * (norms[-1].activate(pooled, torch.empty_like(pooled)) > 0)
            sums = torch.stack([kept.sum(0), (kept * (pooled - norms[-1].mean)).sum(0)])
            maxima = (pooled, groups)
        for i in reversed(range(depth)):
            norm = norms[i]
            sign = ctx.sign if i == depth - 1 else None
            assert kept is not None  # wanted in every layer but the first
            d_shifts.append(sums[0])
            d_scales.append(sums[1] * norm.inverse_deviation * (1 if sign is None else sign))
            products = _Gradient(
                rows[i + 1], kept, norm, *_through_statistics(layers[i].norm, norm, sums), often, maxima
            )
            source = Source(rows[i], norms[i - 1] if i else None)
            kept, sums, d_weight = _pull_back(products, source, weights[i], ctx.needs_input_grad[0])
            d_weights[i] = d_weight if d_weight is None or sign is None else d_weight * sign[:, None]
            maxima = None
        d_biases = [None if layer.linear.bias is None else torch.zeros_like(layer.linear.bias) for layer in layers]
        return (kept, None, None, *d_weights, *d_biases, *reversed(d_scales), *reversed(d_shifts))


def _multiply(
    source: Source, weight: Tensor | None, layer: Layer, often: Tensor | None, groups: Groups | None
) -> tuple[Tensor, Tensor | None, tuple[Tensor, Tensor]]:
    """Products (R, C) of a layer, their maxima (G, C) over groups if given, and counts and moments of their chunks."""
    x, width = source.rows, layer.norm.num_features
    products = x if weight is None else x.new_empty(len(x), width)
    pooled = None if groups is None else x.new_empty(groups.number, width)
    chunks = row_chunks(len(x), max(x.shape[1], width)) if groups is None else group_chunks(groups, width)
    counts = _counts(chunks, often)
    numbers = counts.flatten().tolist()
    moments = x.new_empty(len(chunks), 2, width)

    def work(part: list[Chunk]) -> None:
        scratch = Scratch(part, x)
        hidden, space = scratch(x.shape[1]), scratch(width)
        for chunk in part:
            out = products[chunk.rows]
            if weight is not None:
                torch.mm(source.chunk(chunk, hidden), weight.t(), out=out)
            if pooled is not None:
                torch.amax(chunk.grouped(out), 1, out=pooled[chunk.groups])
            ones = scratch.ones[: len(out)] if often is None else often[chunk.rows]
            mean, square = moments[chunk.number]
            torch.mv(out.t(), ones, out=mean).div_(numbers[chunk.number])
            deviation = torch.sub(out, mean, out=space[: len(out)])
            mean += torch.mv(deviation.t(), ones).div_(numbers[chunk.number])  # what the first sum lost to rounding
            torch.mv(deviation.square_().t(), ones, out=square)

    spread(work, chunks)
    return products, pooled, (counts, moments)


def _counts(chunks: list[Chunk], often: Tensor | None) -> Tensor:
    """Rows of each chunk, each as often as it counts: (chunks, 1) float64."""
    if often is None:
        return torch.tensor([[chunk.stop - chunk.start] for chunk in chunks], dtype=torch.float64)
    total = torch.cat([often.new_zeros(1), often]).double().cumsum(0)
    stops = torch.tensor([chunk.stop for chunk in chunks])
    starts = torch.tensor([chunk.start for chunk in chunks])
    return (total[stops] - total[starts])[:, None]


def _statistics(layer: Layer, sign: Tensor | None, counts: Tensor, moments: Tensor) -> Norm:
    """Batch norm from the counts (chunks, 1), means and summed squared deviations (chunks, 2, C); updates the running
    statistics. `sign` (C,) is what the products were multiplied with, so that all scales are positive."""
    norm = layer.norm
    means, squares = moments.double().unbind(1)
    count = counts.sum()
    mean = (counts * means).sum(0) / count
    square = (squares + counts * (means - mean).square()).sum(0)
    if norm.synchronized:
        count, total, square = _everywhere(norm, count.expand_as(mean), count * mean, square + count * mean.square())
        mean = total / count
        square = square - count * mean.square()
    inverse = (square / count + norm.eps).rsqrt()
    _track(layer, mean if sign is None else mean * sign, square / (count - 1))
    gamma = norm.weight.detach().double()
    scale = inverse * (gamma if sign is None else gamma.abs())
    shift = norm.bias.detach().double() - mean * scale
    dtype = norm.weight.dtype
    return Norm(mean.to(dtype), inverse.to(dtype), scale.to(dtype), shift.to(dtype), count.max().item())


def _track(layer: Layer, mean: Tensor, variance: Tensor) -> None:
    """Update the running statistics with the bias that the products lack."""
    bias = layer.linear.bias
    layer.norm.track(mean if bias is None else mean + bias, variance)


def _everywhere(norm: BatchNorm, *sums: Tensor) -> list[Tensor]:
    """Sums over all processes, where batch norm is to be synchronised."""
    total = torch.stack(sums)
    return list(everywhere(total) if norm.synchronized and torch.distributed.is_initialized() else total)


class _Gradient(NamedTuple):
    """Gradient of the products of a layer: directly, and through the mean and variance that they enter."""

    products: Tensor
    kept: Tensor  # gradient before the ReLU, (R, C) or of the maxima (G, C)
    norm: Norm
    slope: Tensor
    level: Tensor
    often: Tensor | None
    maxima: tuple[Tensor, Groups] | None

    @property
    def chunks(self) -> list[Chunk]:
        rows, width = self.products.shape
        return row_chunks(rows, width) if self.maxima is None else group_chunks(self.maxima[1], width)

    def chunk(self, chunk: Chunk, out: Tensor, space: Tensor) -> Tensor:
        """scale kept + often (slope products + level), (r, C)."""
        products = self.products[chunk.rows]
        torch.addcmul(self.level, products, self.slope, out=out)
        if self.often is not None:
            out *= self.often[chunk.rows, None]
        if self.maxima is None:
            return out.addcmul_(self.kept[chunk.rows], self.norm.scale)
        # to the maximum, in equal parts where there are several
        pooled = self.maxima[0][chunk.groups]
        hit = torch.eq(chunk.grouped(products), pooled[:, None], out=chunk.grouped(space[: len(products)]))
        gradient = self.kept[chunk.groups] * self.norm.scale
        if hit.sum() > pooled.numel():
            gradient /= hit.sum(1)
        chunk.grouped(out).addcmul_(hit, gradient[:, None])
        return out


def _through_statistics(module: BatchNorm, norm: Norm, sums: Tensor) -> tuple[Tensor, Tensor]:
    """Slope and level of the gradient that reaches all products alike, from the sums (2, C) of `_rectify`."""
    alone, with_deviation = _everywhere(module, *sums)
    slope = -norm.scale * norm.inverse_deviation.square() * with_deviation / norm.total
    return slope, -norm.scale * alone / norm.total - slope * norm.mean


def _pull_back(
    gradient: _Gradient, source: Source, weight: Tensor | None, wanted: bool
) -> tuple[Tensor | None, Tensor, Tensor | None]:
    """From the gradient of a layer's products to that of its input, before the ReLU below if there is a layer below.

    Returns it (None if it is not wanted), its sums as of `_rectify`, and the gradient of the weight.
    """
    x, below = source.rows, source.norm
    wanted = wanted or below is not None
    result = torch.empty_like(x) if wanted else None
    chunks = gradient.chunks
    sums = x.new_zeros(len(chunks), 2, x.shape[1])

    def work(part: list[Chunk]) -> Tensor | None:
        scratch = Scratch(part, x)
        width = gradient.products.shape[1]
        total = None if weight is None else torch.zeros_like(weight)
        hidden, space, products = scratch(x.shape[1]), scratch(max(width, x.shape[1])).flatten(), scratch(width)
        for chunk in part:
            rows = chunk.stop - chunk.start
            d_products = products[:rows] if weight is not None or result is None else result[chunk.rows]
            gradient.chunk(chunk, d_products, space[: rows * width].view(rows, width))
            if weight is None or total is None:
                continue
            inputs = source.chunk(chunk, hidden)
            total.addmm_(d_products.t(), inputs)
            if result is not None:
                out = torch.mm(d_products, weight, out=result[chunk.rows])
                if below is not None:
                    free = space[: rows * x.shape[1]].view(rows, -1)
                    _rectify(below, x[chunk.rows], inputs, out, free, scratch.ones[:rows], sums[chunk.number])
        return total

    parts = spread(work, chunks)
    return result, sums.sum(0), None if weight is None else torch.stack(parts).sum(0)  # type: ignore[arg-type]


def _rectify(
    norm: Norm, products: Tensor, hidden: Tensor, gradient: Tensor, space: Tensor, ones: Tensor, sums: Tensor
) -> None:
    """Turn the gradient after a ReLU into that before it, in place, and sum it over rows (2, C): alone, and times the
    deviation of the products from their mean."""
    torch.ops.aten.threshold_backward.grad_input(gradient, hidden, 0, grad_input=gradient)
    torch.mv(gradient.t(), ones, out=sums[0])
    torch.sub(products, norm.mean, out=space)
    torch.mv(space.mul_(gradient).t(), ones, out=sums[1])


def _rectify_all(source: Source, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """`_rectify` of all rows, into a new tensor; and the sums (2, C)."""
    kept = torch.empty_like(gradient)
    chunks = row_chunks(*gradient.shape)
    sums = gradient.new_empty(len(chunks), 2, gradient.shape[1])

    def work(part: list[Chunk]) -> None:
        scratch = Scratch(part, gradient)
        hidden, space = scratch(gradient.shape[1]), scratch(gradient.shape[1])
        for chunk in part:
            out = kept[chunk.rows].copy_(gradient[chunk.rows])
            inputs = source.chunk(chunk, hidden)
            products, rows = source.rows[chunk.rows], len(out)
            _rectify(source.norm, products, inputs, out, space[:rows], scratch.ones[:rows], sums[chunk.number])  # type: ignore[arg-type]

    spread(work, chunks)
    return kept, sums.sum(0)


def infer(x: Tensor, layers: Sequence[Layer], *, projected: bool = False, groups: Groups | None = None) -> Tensor:
    """`train` in eval mode and without gradient: batch norm folded into the weights, nothing stored between layers."""
    folded = [_fold(layer) for layer in layers]
    width = max(x.shape[1], *(len(shift) for _, _, shift in folded))
    chunks = row_chunks(len(x), width) if groups is None else group_chunks(groups, width)
    result = x.new_empty(len(x) if groups is None else groups.number, len(folded[-1][2]))

    def work(part: list[Chunk]) -> None:
        scratch = Scratch(part, x)
        spaces = scratch(width).flatten(), scratch(width).flatten()
        for chunk in part:
            h = x[chunk.rows]
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

    spread(work, chunks)
    return result if groups is None else ungroup(result, groups)


def _fold(layer: Layer) -> tuple[Tensor, Tensor, Tensor]:
    """Weight, scale and shift: a layer in eval mode is ReLU(weight x + shift), or ReLU(scale products + shift)."""
    norm, linear = layer.norm, layer.linear
    if norm.running_mean is None or norm.running_var is None:
        raise ValueError("batch norm: expected running statistics, which eval mode needs, found none")
    scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
    shift = norm.bias - norm.running_mean * scale
    return linear.weight * scale[:, None], scale, shift if linear.bias is None else shift + linear.bias * scale
