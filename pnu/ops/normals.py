"""Normals of a bare cloud: plane fits, one consistent side for all, and fits again within each sheet of the surface.

Orientation by the winding number. For outward normals n and point areas a the double layer
w(x) = sum_j a_j n_j.(p_j - x) / (4 pi |p_j - x|^3) is 1 inside, 0 outside and 1/2 on the surface (Gauss). Asking for
1/2 at every point, with unknown signed areas along given lines, is linear and does not depend on how the lines happen
to point; a few steps of conjugate gradients give the smooth solution, whose signs are the orientation up to stray
points. Those are settled by the gradient of w, which at each point must look along minus its normal: the field of all
other dipoles. Related: parametric Gauss reconstruction (Lin et al. 2022), winding number normal consistency (Lin et al.
2024), dipole propagation (Metzer et al. 2021); here the lines are known, which leaves one unknown a point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from pnu.ops.nearest import knn, nearest
from pnu.ops.noise import noise_level
from pnu.ops.sampling import farthest_points_large

ANCHORS = 4096  # points whose dipoles all see each other: 64 MiB a matrix
ROWS = 2**16  # points treated at once in local steps
SOME_NOISE = 0.1  # in spacings, until it can be measured


def estimate_normals(points: Tensor, k: int = 16, *, orient: bool = True) -> Tensor:
    """Unit normals of clouds (B, n, 3) -> (B, n, 3).

    Without `orient`: least squares plane of the k nearest points (PCA), sign arbitrary. With it: outward on closed
    shapes, one side on open ones (`orient_normals`), then fitted again to the neighbours on the same sheet only, which
    halves the error at edges and thin walls. ValueError if k is not in 3..n.
    """
    if not 3 <= k <= points.shape[1]:
        raise ValueError(f"k: expected 3 to {points.shape[1]} neighbours (the number of points), found {k}")
    points = points.detach()
    planes = [_plane_normals(xyz, near) for xyz, near in zip(points, knn(points, points, k).idx, strict=True)]
    if orient:
        planes = [_refined(_Cloud.of(xyz), lines) for xyz, lines in zip(points, planes, strict=True)]
    return torch.stack(planes).to(points)


def orient_normals(points: Tensor, normals: Tensor) -> Tensor:
    """The same normals (n, 3) of points (n, 3), each with the sign that makes them agree.

    Outward on closed shapes, whatever their number; the same side all over on an open sheet. Deterministic; beyond 4096
    points the global step sees an even subset, so that time stays linear.
    """
    cloud = _Cloud.of(points)
    lines = torch.nn.functional.normalize(normals.to(cloud.points), dim=1)
    return normals * _signs(cloud, lines)[:, None].to(normals)


def refit_normals(points: Tensor, normals: Tensor) -> Tensor:
    """What `estimate_normals` makes of points (n, 3) once it knows their sides, those of normals (n, 3)."""
    return _refined(_Cloud.of(points), normals, oriented=True).to(points)


def flip_to_reference(normals: Tensor, points: Tensor, ref_points: Tensor, ref_normals: Tensor) -> Tensor:
    """Normals (B, n, 3) at points (B, n, 3), each turned to the side of the nearest reference point's normal."""
    near = nearest(points, ref_points).idx[..., None].expand(-1, -1, 3)
    side = (normals * ref_normals.gather(1, near)).sum(-1, keepdim=True)
    return torch.where(side < 0, -normals, normals)


class _Cloud(NamedTuple):
    """A cloud in its unit sphere, and what local steps need to know of it."""

    points: Tensor  # (n, 3) float32
    idx: Tensor  # (n, k) nearest points, itself first
    spacing: Tensor  # (n,) usual distance to a neighbour
    area: Tensor  # (n,) of the surface that the point stands for

    @staticmethod
    def of(points: Tensor) -> _Cloud:
        points = points.detach().double()
        points = points - points.mean(0)
        points = (points / points.norm(dim=1).max().clamp_min(1e-30)).float()
        few, k = min(8, len(points)), min(48, len(points))
        dist_sq, idx = (found[0] for found in knn(points[None], points[None], k))
        spacing = dist_sq[:, 1:6].sqrt().mean(1)[idx[:, :few]].mean(1)
        area = (dist_sq[:, few - 1] * (torch.pi / (few - 0.5)))[idx[:, :few]].median(1).values
        floor = (0.1 * spacing.median()).clamp_min(1e-6)  # duplicates
        return _Cloud(points, idx, spacing.clamp_min(floor), area.clamp_min(floor**2))


def _plane_normals(points: Tensor, idx: Tensor, weight: Tensor | None = None) -> Tensor:
    """Direction of least variance of points[idx], (n, 3); idx (n, k), weights (n, k)."""
    normals = []
    for rows in torch.arange(len(idx), device=idx.device).split(ROWS):
        near = points[idx[rows]].double()
        share = torch.ones_like(near[..., :1]) if weight is None else weight[rows, :, None].double()
        near = near - (share * near).sum(1, keepdim=True) / share.sum(1, keepdim=True)
        normals.append(torch.linalg.eigh(near.mT @ (share * near))[1][:, :, 0])
    return torch.cat(normals)


def _refined(cloud: _Cloud, lines: Tensor, *, oriented: bool = False) -> Tensor:
    """Oriented normals from lines (n, 3). Each turn of field and fit leaves cleaner lines for the next."""
    normals, noise = lines.to(cloud.points), SOME_NOISE
    for _ in range(2):
        if not oriented:
            normals = normals * _signs(cloud, normals)[:, None]
        for _ in range(5):
            normals = _field(cloud, normals, noise)
        normals = _sheet_normals(cloud, normals, noise)
        noise = noise_level(cloud.points, normals) / cloud.spacing.median().item()
    return normals


def _signs(cloud: _Cloud, lines: Tensor) -> Tensor:
    """+1 or -1 for each line, (n,)."""
    if len(lines) <= ANCHORS:
        sign = _global_signs(cloud, lines)
    else:
        anchors = torch.from_numpy(farthest_points_large(cloud.points, ANCHORS)).to(lines.device)
        sign = _spread(cloud, lines, anchors, _global_signs(_Cloud.of(cloud.points[anchors]), lines[anchors]))
    for _ in range(3):
        turned = _field(cloud, lines * sign[:, None], SOME_NOISE)
        sign = torch.where((turned * lines).sum(1) < 0, -1.0, 1.0)
    return sign


def _global_signs(cloud: _Cloud, lines: Tensor) -> Tensor:
    points, area = cloud.points, cloud.area
    along = (points * lines).sum(1) - points @ lines.T  # n_i.(p_i - p_j) at [j, i]
    layer = _inverse_distances(cloud, 1.0).pow_(3).mul_(along).mul_(area.sqrt())
    layer.mul_(area.sqrt()[:, None] / (4 * torch.pi))
    half = 0.5 * area.sqrt()
    start = torch.where(_least_squares(layer, half, 4) < 0, -1.0, 1.0)
    # narrow dipoles keep thin walls apart, wide ones see past noise: Gauss' law tells which did better
    settled = [_settled(cloud, lines, along, start, width) for width in (1.0, 1.4, 2.0)]
    return min(settled, key=lambda sign: (layer @ (sign * area.sqrt()) - half).norm().item())


def _settled(cloud: _Cloud, lines: Tensor, along: Tensor, sign: Tensor, width: float) -> Tensor:
    """Signs turned along the field of all dipoles until they agree with it."""
    inverse = _inverse_distances(cloud, width)
    dipole = (along * along.T).mul_(inverse).mul_(inverse).mul_(3).addmm_(lines, lines.T)
    dipole.mul_(inverse.pow_(3)).mul_(cloud.area).fill_diagonal_(0)
    for _ in range(20):
        turned = torch.where(dipole @ sign < 0, -1.0, 1.0)
        if torch.equal(turned, sign):
            break
        sign = turned
    return sign


def _inverse_distances(cloud: _Cloud, width: float) -> Tensor:
    """1 / max(distance, width x spacing) between all points, (n, n)."""
    width_sq = (width * cloud.spacing) ** 2 / 2
    dist_sq = cloud.points.square().sum(1) + cloud.points.square().sum(1)[:, None]
    dist_sq.addmm_(cloud.points, cloud.points.T, alpha=-2)
    return torch.maximum(dist_sq, width_sq + width_sq[:, None], out=dist_sq).rsqrt_()


def _least_squares(matrix: Tensor, target: Tensor, steps: int) -> Tensor:
    """Conjugate gradients on the normal equations, stopped early: the smooth part of the solution."""
    x, residual = torch.zeros_like(target), target
    gradient = matrix.T @ residual
    direction, size = gradient, gradient @ gradient
    for _ in range(steps):
        change = matrix @ direction
        step = size / (change @ change).clamp_min(1e-30)
        x, residual = x + step * direction, residual - step * change
        gradient = matrix.T @ residual
        size, before = gradient @ gradient, size
        direction = gradient + size / before.clamp_min(1e-30) * direction
    return x


def _spread(cloud: _Cloud, normals: Tensor, anchors: Tensor, sign: Tensor) -> Tensor:
    """Signs of all points from those of the anchors, along paths on which the normals' lines turn least."""
    n, near = len(normals), cloud.idx[:, 1:13]
    cosine = (normals[:, None] * normals[near]).sum(-1)
    offset = cloud.points[near] - cloud.points[:, None]
    rise = (offset * normals[:, None]).sum(-1).abs() / offset.norm(dim=-1).clamp_min(1e-12)
    cost = (1.01 - cosine.abs() + rise).double().cpu().numpy()
    graph = csr_matrix((cost.ravel(), near.cpu().numpy().ravel(), np.arange(n + 1) * near.shape[1]), (n, n))
    source = anchors.cpu().numpy()
    before = dijkstra(graph.maximum(graph.T), indices=source, min_only=True, return_predecessors=True)[1]
    alone = before < 0
    alone[source] = False
    parent = torch.from_numpy(np.where(before < 0, np.arange(n), before).astype(np.int64)).to(normals.device)
    if alone.any():
        lost = torch.from_numpy(np.flatnonzero(alone)).to(normals.device)
        parent[lost] = anchors[nearest(cloud.points[None, lost], cloud.points[None, anchors]).idx[0]]
    agree = torch.where((normals * normals[parent]).sum(1) < 0, -1.0, 1.0)
    agree[anchors] = sign
    parent[anchors] = anchors
    rooted = torch.zeros(n, dtype=torch.bool, device=normals.device)
    rooted[anchors] = True
    while not bool(rooted.all()):  # pointer doubling
        agree = torch.where(rooted, agree, agree * agree[parent])
        rooted, parent = rooted | rooted[parent], parent[parent]
    return agree


def _field(cloud: _Cloud, normals: Tensor, noise: float) -> Tensor:
    """Minus the gradient of the neighbours' winding number at each point, as unit vectors (n, 3)."""
    width = 1 + 3 * noise
    out = []
    for rows in torch.arange(len(normals), device=normals.device).split(ROWS):
        idx = cloud.idx[rows, 1:]
        offset = cloud.points[idx] - cloud.points[rows, None]
        width_sq = width**2 * (cloud.spacing[rows, None] ** 2 + cloud.spacing[idx] ** 2) / 2
        dist_sq = torch.maximum(offset.square().sum(-1), width_sq)[..., None]
        along = (normals[idx] * offset).sum(-1, keepdim=True)
        dipoles = (normals[idx] - 3 * along / dist_sq * offset) * cloud.area[idx][..., None] / dist_sq**1.5
        out.append(torch.nn.functional.normalize(dipoles.sum(1), dim=1))
    return torch.cat(out)


def _sheet_normals(cloud: _Cloud, normals: Tensor, noise: float) -> Tensor:
    """Plane fits to the neighbours that face the same way and lie near the tangent plane, signs kept."""
    k = round(32 * min(1 + 3 * noise, 1.5))
    fitted = []
    for rows in torch.arange(len(normals), device=normals.device).split(ROWS):
        idx, normal = cloud.idx[rows, :k], normals[rows, None]
        offset = cloud.points[idx] - cloud.points[rows, None]
        distance = offset.norm(dim=-1)
        reach = distance[:, -1:] / 1.5
        rise = (offset * normal).sum(-1).abs() + (offset * normals[idx]).sum(-1).abs()
        facing = (normal * normals[idx]).sum(-1).clamp_min(0) ** (4 / (1 + 6 * noise))
        weight = facing * torch.exp(-((distance / reach) ** 2) - (rise / ((0.5 + 3 * noise) * reach)) ** 2)
        weight[:, 0] = 1
        fitted.append(_plane_normals(cloud.points, idx, weight).to(normals))
    lines = torch.cat(fitted)
    cosine = (lines * normals).sum(1, keepdim=True)
    # a fit across the given normal has found something else than its sheet
    return torch.where(cosine.abs() < 0.3, normals, lines * cosine.sign())
