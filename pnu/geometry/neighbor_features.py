"""Features at neighbors: gathered, or interpolated between the nearest three."""

import torch
from torch import Tensor

from pnu.geometry.neighbor_search import knn


def gather(features: Tensor, idx: Tensor) -> Tensor:
    """Rows of `features` at `idx`, differentiable with respect to the features.

    features (B, n, C), idx (B, ...) int64 in 0..n-1 -> (B, ..., C): out[b, i, j] = features[b, idx[b, i, j]].
    """
    if features.ndim != 3 or idx.shape[0] != features.shape[0]:
        raise ValueError(
            f"idx: expected features (B, n, C) and indices (B, ...), found {tuple(features.shape)}, {tuple(idx.shape)}"
        )
    clouds, n, channels = features.shape
    first = torch.arange(clouds, device=idx.device).mul_(n).view(-1, *[1] * (idx.ndim - 1))
    # not by indexing, whose gradient sorts the indices on a GPU
    return features.reshape(clouds * n, channels).index_select(0, (idx + first).flatten()).view(*idx.shape, channels)


def interpolate(features: Tensor, points: Tensor, query: Tensor, k: int = 3) -> Tensor:
    """Mean of the features of the k nearest points, weighted by inverse distance (feature propagation of PointNet++).

    features (B, n, C) at points (B, n, 3), wanted at query (B, m, 3) -> (B, m, C). Weights 1 / (d + 1e-8), d the plain
    distance, normalized to sum 1. Fewer than k points: all of them. Differentiable with respect to the features only.
    """
    dist_sq, idx = knn(query, points, min(k, points.shape[1]))
    weight = 1 / (dist_sq.sqrt() + 1e-8)
    weight = weight / weight.sum(-1, keepdim=True)
    return (gather(features, idx) * weight[..., None].to(features.dtype)).sum(2)
