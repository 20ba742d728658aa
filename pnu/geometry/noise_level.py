"""How noisy a cloud is."""

import math

import torch
from torch import Tensor

from pnu.geometry.neighbor_search import knn
from pnu.geometry.sampling import farthest_points_large

PLACES = 1000
QUIET = 0.1  # the quietest tenth of the places: elsewhere edges and second sheets look like noise
# neighbors, and the noise in spacings up to which they tell it apart from the spread of the points themselves
WINDOWS = ((16, 0.22), (24, 0.4), (48, torch.inf))


def noise_level(points: Tensor, normals: Tensor | None = None) -> float:
    """Standard deviation of the points (n, 3) across the surface, in their unit of length.

    Residual of quadratic fits to small neighborhoods, at the quietest tenth of a thousand places. Good to about a
    quarter from 0.1 to 0.8 spacings; below, it is an upper bound: curvature that the points do not resolve counts as
    noise, and so do walls that are thin beside the spacing, unless `normals` (n, 3) tell their sides apart (NaN: not
    known). 0 where there are too few points to tell: fewer than 16, or hardly ten of like side around most places.
    """
    xyz = points.detach().double()
    level = 0.0
    for k, enough in WINDOWS:
        if k > len(xyz):
            break
        places = torch.from_numpy(farthest_points_large(xyz, min(PLACES, len(xyz)))).to(xyz.device)
        dist_sq, idx = (found[0] for found in knn(xyz[None, places], xyz[None], k))
        weight = torch.ones_like(dist_sq)
        if normals is not None:
            weight = (~((normals[idx] * normals[places, None]).sum(-1) <= 0.3)).double()  # NaN: no side is known
        quietest = _residuals(xyz[idx], weight).quantile(QUIET).item()
        if not math.isfinite(quietest):
            continue
        level = quietest
        if level < enough * dist_sq[:, 1:6].sqrt().mean(1).median().item():
            break
    return level


def _residuals(near: Tensor, weight: Tensor) -> Tensor:
    """Root mean square distance of points (m, k, 3) from their best quadratic height field, (m,), or infinity."""
    total, weight = weight.sum(1), weight[..., None]
    near = near - (weight * near).sum(1, keepdim=True) / total[:, None, None]
    height, u, v = (near @ torch.linalg.eigh(near.mT @ (weight * near))[1]).unbind(-1)
    size = u.square().add(v.square()).mean(1, keepdim=True).sqrt().clamp_min(torch.finfo(near.dtype).tiny)
    u, v = u / size, v / size
    terms = torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], -1)
    normal = terms.mT @ (weight * terms) + 1e-9 * torch.eye(6, dtype=near.dtype, device=near.device)
    fit = terms @ torch.linalg.solve(normal, (weight * terms).mT @ height[..., None])
    square = (weight[..., 0] * (height - fit[..., 0]).square()).sum(1)
    return torch.where(total > 9, square / (total - 6).clamp_min(1), torch.inf).sqrt()
