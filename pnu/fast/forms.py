"""Fast forms of the parts of `pnu.networks`. Each is a subclass that replaces `forward`.

On the CPU layers run chunk by chunk (`stack`). A first layer, which is linear, multiplies before its input is gathered,
interpolated or repeated: once a point, not once a neighbor or copy. A GPU has products to spare: there batch norm, ReLU
and the maximum over neighbors are kernels of their own (`norm_kernels`).
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnu.fast import stack
from pnu.fast.combine import combine
from pnu.fast.gpu import kernels
from pnu.fast.neighborhoods import Neighborhoods, distinct, pool, single, whole
from pnu.geometry.neighbor_features import gather
from pnu.geometry.neighbor_search import ball_query, knn
from pnu.networks import layers, pugeo
from pnu.networks.norm import check_rows


def streamed(x: Tensor, training: bool) -> bool:
    """Whether layers run chunk by chunk (`stack`): on the CPU, but for gradients in eval mode and mixed precision."""
    plainly = torch.is_autocast_enabled("cpu") or (torch.is_grad_enabled() and not training)
    return x.device.type == "cpu" and not plainly


def through(
    mlp: layers.MLP,
    x: Tensor,
    *,
    projected: bool = False,
    groups: Neighborhoods | None = None,
    offsets: Tensor | None = None,
) -> Tensor:
    """Rows (..., C) through all layers.

    Args:
        projected: x already holds the products of the first layer's weight, without bias.
        groups: x is (R, C) and the output the maximum over groups of rows, (G, C').
        offsets: (R, D), if projected and with groups: x is a table (n, C) of the products of all columns but the first
            D, and row r is x[source[r]] plus the products of offsets[r], the first D.
    """
    rows = x.reshape(-1, x.shape[-1])
    if streamed(x, mlp.training):
        run = stack.train_stack if mlp.training else stack.infer_stack
        rows = run(rows, layers_of(mlp), projected=projected, groups=groups, offsets=offsets)
    else:
        if groups is not None and offsets is not None:
            of_offsets, _ = first_weight(mlp, offsets.shape[1])
            rows = combine(rows, groups.source[:, None]) + F.linear(offsets, of_offsets)
        for i, layer in enumerate(layers_of(mlp)):
            rows = normed(layer, rows) if projected and i == 0 else layer(rows)
        rows = rows if groups is None else pool(rows, groups)
    return rows if groups is not None else rows.view(*x.shape[:-1], rows.shape[-1])


def normed(layer: layers.Layer, products: Tensor, size: int | None = None) -> Tensor:
    """A layer from the products of its input with its weight, without bias: rows (R, C) -> (R, C).

    size: with it the maximum over each group of so many rows, (R / size, C).
    """
    norm, bias = layer.norm, layer.linear.bias
    fused = kernels("norm_kernels", products) if norm.training and not norm.synchronized and norm.momentum else None
    if fused is not None:
        check_rows(len(products))
        out: Tensor = fused.normed_relu(products, norm, bias, size)
        return out
    rows: Tensor = norm(products if bias is None else products + bias).relu()
    return rows if size is None else rows.view(-1, size, rows.shape[1]).amax(1)


def pooled(mlp: layers.MLP, x: Tensor) -> Tensor:
    """Groups of rows (..., k, C) through all layers, and the maximum of each: (..., C'). For a GPU."""
    *others, last = layers_of(mlp)
    for layer in others:
        x = layer(x)
    products = F.linear(x, last.linear.weight)
    return normed(last, products.flatten(0, -2), x.shape[-2]).view(*x.shape[:-2], -1)


def layers_of(mlp: layers.MLP) -> Sequence[layers.Layer]:
    """The layers of an MLP, for the streamed form."""
    return [layer for layer in mlp if isinstance(layer, layers.Layer)]


def first_weight(mlp: layers.MLP, split: int) -> tuple[Tensor, Tensor]:
    """Weight of the first layer for the first `split` columns of its input, and for the others."""
    weight = layers_of(mlp)[0].linear.weight
    return weight[:, :split], weight[:, split:]


class Layer(layers.Layer):
    """`networks.layers.Layer`, on a GPU with batch norm and ReLU as one."""

    def forward(self, x: Tensor) -> Tensor:
        if x.device.type == "cpu" or not self.training:
            return super().forward(x)
        return normed(self, F.linear(x, self.linear.weight).flatten(0, -2)).view(*x.shape[:-1], -1)


class MLP(layers.MLP):
    """`networks.layers.MLP`, its layers streamed."""

    def forward(self, x: Tensor) -> Tensor:
        return through(self, x)


class PooledMLP(layers.PooledMLP):
    """The maximum is taken of the last products, before batch norm and ReLU."""

    def forward(self, x: Tensor) -> Tensor:
        if x.device.type != "cpu":
            return pooled(self, x)
        return through(self, x.flatten(0, 1), groups=whole(*x.shape[:2]))


class JoinedMLP(layers.JoinedMLP):
    """The cloud's part of the first products is computed once a cloud."""

    def forward(self, each: Tensor, cloud: Tensor | None = None) -> Tensor:
        of_each, of_cloud = first_weight(self, each.shape[-1])
        products = F.linear(each, of_each)
        if cloud is not None:
            products += F.linear(cloud, of_cloud)[:, None]
        return through(self, products, projected=True)


class Abstraction(layers.Abstraction):
    """Features are multiplied before they are gathered; an offset is point minus center first, and multiplied then."""

    def forward(self, points: Tensor, features: Tensor, centers: Tensor) -> Tensor:
        if points.device.type != "cpu":
            return pooled(self.mlp, self.grouped(points, features, centers))
        (clouds, n, _), m = points.shape, centers.shape[1]
        neighbors = ball_query(centers, points, self.radius, self.k)
        groups = (distinct if streamed(points, self.training) else single)(neighbors, n)
        there, here = combine(points.flatten(0, 1), groups.source[:, None]), centers.flatten(0, 1)[groups.owner]
        _, of_features = first_weight(self.mlp, 3)
        products = F.linear(features.flatten(0, 1), of_features)
        return through(self.mlp, products, projected=True, groups=groups, offsets=there - here).view(clouds, m, -1)


class Propagation(layers.Propagation):
    """Features are multiplied at the coarse points, then interpolated."""

    def forward(self, fine_points: Tensor, coarse_points: Tensor, skip: Tensor, features: Tensor) -> Tensor:
        if fine_points.device.type != "cpu":
            return super().forward(fine_points, coarse_points, skip, features)
        clouds, m, _ = coarse_points.shape
        dist_sq, idx = knn(fine_points, coarse_points, min(3, m))
        inverse = 1 / (dist_sq.sqrt() + 1e-8)
        inverse = inverse / inverse.sum(-1, keepdim=True)
        idx = idx + torch.arange(clouds, device=idx.device).view(-1, 1, 1) * m
        of_features, of_skip = first_weight(self.mlp, features.shape[-1])
        rows = combine(F.linear(features.flatten(0, 1), of_features), idx.flatten(0, 1), inverse.flatten(0, 1))
        rows = torch.addmm(rows, skip.flatten(0, 1), of_skip.t())
        return through(self.mlp, rows, projected=True).view(clouds, fine_points.shape[1], -1)


class EdgeConvolution(pugeo.EdgeConvolution):
    """Neighbors are multiplied before they are gathered."""

    def forward(self, x: Tensor, neighbors: Tensor) -> Tensor:
        return self.pooled(self.center(x)[:, :, None] + gather(self.neighbor(x), neighbors))


ALL: tuple[type[nn.Module], ...] = (Layer, MLP, PooledMLP, JoinedMLP, Abstraction, Propagation, EdgeConvolution)
