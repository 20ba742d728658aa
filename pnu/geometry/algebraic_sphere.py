"""Algebraic point set surfaces (Guennebaud and Gross 2007): the smooth surface that points with normals define."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from pnu.geometry.neighbor_search import knn

CHUNK_NEIGHBORS = 2**20  # neighbors held at once: about 100 MB


def apss_project(points: Tensor, cloud: Tensor, k: int = 10, *, steps: int = 4) -> Tensor:
    """Project points (m, 3) onto the algebraic point set surface of cloud (n, 6): (m, 6), points and unit normals.

    In each step a sphere is fitted to the k nearest points and normals of the cloud, with the paper's weights
    (1 - (d/h)^2)^4, h just beyond the k-th distance, and the point moves to the nearest point of that sphere; the
    normal is that of the last sphere. Computed in float64 around each point, so that neither place nor size of the
    cloud costs digits; returned in the dtype of `points`. Small k keeps detail, large k averages noise.
    ValueError if the shapes do not fit or k is not in 4..n.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected (m, 3), found {tuple(points.shape)}")
    if cloud.ndim != 2 or cloud.shape[1] != 6:
        raise ValueError(f"cloud: expected points and normals (n, 6), found {tuple(cloud.shape)}")
    if not 4 <= k <= len(cloud):
        raise ValueError(f"k: expected 4 to {len(cloud)} neighbors (the points of the cloud), found {k}")
    source = cloud.double()
    result = points.new_empty(len(points), 6)
    chunk = max(1, CHUNK_NEIGHBORS // k)
    for start in range(0, len(points), chunk):
        part = slice(start, start + chunk)
        x = points[part].double()
        normal = torch.zeros_like(x)
        for _ in range(steps):
            found = knn(x[None], source[None, :, :3], k)
            near = source[found.idx[0]]
            sphere = fit_sphere(near[..., :3] - x[:, None], near[..., 3:], neighbor_weights(found.dist_sq[0]))
            move, normal = project_to_sphere(*sphere)
            x = x + move
        result[part] = torch.cat([x, normal], dim=1).to(result)
    return result


def neighbor_weights(dist_sq: Tensor) -> Tensor:
    """Weights (1 - (d/h)^2)^4 of neighbors at ascending squared distances (..., k), with h^2 = 1.1 x the last."""
    h_sq = 1.1 * dist_sq[..., -1:].clamp(min=torch.finfo(dist_sq.dtype).tiny)
    return (1 - dist_sq / h_sq).pow(4)


def fit_sphere(points: Tensor, normals: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Algebraic sphere u0 + u.x + uq |x|^2 = 0 whose gradient fits the normals best: u0 (...), u (..., 3), uq (...).

    points, normals (..., k, 3), weights (..., k) not all zero. u and uq minimize the weighted sum of
    |u + 2 uq p - n|^2, then u0 makes the weighted mean of the field at the points zero: the closed form of
    Guennebaud, Germann and Gross 2008. A plane (uq = 0) where the points have no extent.
    """
    w = (weights / weights.sum(-1, keepdim=True))[..., None]
    mean_p, mean_n = (w * points).sum(-2), (w * normals).sum(-2)
    mean_pp = (w * points.square()).sum((-2, -1))
    covariance = (w * points * normals).sum((-2, -1)) - (mean_p * mean_n).sum(-1)
    variance = mean_pp - mean_p.square().sum(-1)
    flat = variance <= 1e-12 * mean_pp
    uq = torch.where(flat, 0, 0.5 * covariance / torch.where(flat, 1, variance))
    u = mean_n - 2 * uq[..., None] * mean_p
    return -(u * mean_p).sum(-1) - uq * mean_pp, u, uq


def project_to_sphere(u0: Tensor, u: Tensor, uq: Tensor) -> tuple[Tensor, Tensor]:
    """Step (..., 3) from the origin to the nearest point of an algebraic sphere, and the unit normal there.

    The root of the quadratic along the gradient in the form that stays exact as the sphere becomes a plane. Where the
    sphere is imaginary the step ends at the smallest residual; where the gradient vanishes there is no step.
    """
    length = u.norm(dim=-1)
    root = (length.square() - 4 * uq * u0).clamp(min=0).sqrt()
    reach = torch.where(length > 0, -2 * u0 / (length + root).clamp(min=torch.finfo(u.dtype).tiny), 0)
    move = reach[..., None] * normalize(u, dim=-1)
    return move, normalize(u + 2 * uq[..., None] * move, dim=-1)
