"""3D modified Fisher vectors: statistics of points against a fixed grid of Gaussians."""

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

STATISTICS = 20  # of each Gaussian


def grid_centers(size: int) -> Tensor:
    """Centers of size^3 equal cells of the cube from -1 to 1, (size^3, 3) float64, the last axis fastest."""
    axis = (2 * torch.arange(size, dtype=torch.float64) + 1) / size - 1
    return torch.cartesian_prod(axis, axis, axis)


def fisher_vectors(points: Tensor, size: int) -> Tensor:
    """3D modified Fisher vectors of clouds in the unit sphere, (N, k, 3) -> (N, size^3, 20), not normalized.

    K = size^3 Gaussians of weight w = 1 / K have their means m_j at `grid_centers` and the deviation s = 1 / size.
    With the share g_j of Gaussian j in the density at a point p, and d = (p - m_j) / s, a point's gradients are
    (g_j - w) / sqrt(w) by the weight, g_j d / sqrt(w) by the mean and g_j (d^2 - 1) / sqrt(2 w) by the deviation.
    The columns: mean and maximum over the points of the first; mean, maximum, minimum, of 3 each, of the second and of
    the third.

    Source: Ben-Shabat, Lindenbaum, Fischer, "3D Point Cloud Classification and Segmentation using 3D Modified Fisher
    Vector Representation for Convolutional Neural Networks", arXiv 1711.08241, 2017, equations of section 3.
    """
    apart = (points[:, :, None] - grid_centers(size).to(points)) * size
    share = torch.softmax(-0.5 * apart.square().sum(-1), -1)[..., None]
    weight = size**-3
    by_weight = (share - weight) / math.sqrt(weight)
    by_mean = share * apart / math.sqrt(weight)
    by_deviation = share * (apart.square() - 1) / math.sqrt(2 * weight)
    columns = [by_weight.mean(1), by_weight.amax(1)]
    for each in (by_mean, by_deviation):
        columns += [each.mean(1), each.amax(1), each.amin(1)]
    return torch.cat(columns, -1)


def normalized_vectors(vectors: Tensor) -> Tensor:
    """Fisher vectors (N, K, 20) with the signed root of each value, each statistic of length 1 over the Gaussians."""
    return normalize(vectors.sign() * vectors.abs().clamp_min(1e-12).sqrt(), dim=1)
