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
from pnu.ops.sampling import farthest_points_large

ANCHORS = 4096  # points whose dipoles all see each other: 64 MiB a matrix
ROWS = 2**16  # points treated at once in local steps
FIELD_NEIGHBORS = 48


def estimate_normals(points: Tensor, k: int = 16, *, orient: bool = True) -> Tensor:
    """Unit normals of clouds (B, n, 3) -> (B, n, 3).

    Without `orient`: least squares plane of the k nearest points (PCA), sign arbitrary. With it: outward on closed
    shapes, one side on open ones (`orient_normals`), then fitted again to the neighbours on the same sheet only, which
    halves the error at edges and thin walls. ValueError if k is not in 3..n.
    """
    if not 3 <= k <= points.shape[1]:
        raise ValueError(f"k: expected 3 to {points.shape[1]} neighbours (the number of points), found {k}")
    idx = knn(points, points, k).idx
    planes = torch.stack([_plane_normals(cloud, near) for cloud, near in zip(points.detach(), idx, strict=True)])
    if not orient:
        return planes
    return torch.stack([_refined(cloud, lines) for cloud, lines in zip(points.detach(), planes, strict=True)])


def orient_normals(points: Tensor, normals: Tensor) -> Tensor:
    """The same unit normals (n, 3) of points (n, 3), each with the sign that makes them agree.

    Outward on closed shapes, whatever their number; the same side all over on an open sheet. Deterministic; beyond 4096
    points the global step sees an even subset, so that time stays linear.
    """
    cloud = _Cloud.of(points)
    return normals * _signs(cloud, normals.to(cloud.points))[:, None].to(normals)


def refit_normals(points: Tensor, normals: Tensor) -> Tensor:
    """Oriented normals (n, 3) of points (n, 3), fitted again to the neighbours on the same sheet; signs stay."""
    cloud = _Cloud.of(points)
    turned = normals.to(cloud.points)
    for _ in range(4):
        turned = _field(cloud, turned)
    return _sheet_normals(cloud, turned).to(points.dtype)


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
        k = min(FIELD_NEIGHBORS, len(points))
        dist_sq, idx = (found[0] for found in knn(points[None], points[None], k))
        few = min(8, k)
        spacing = dist_sq[:, 1 : min(6, k)].sqrt().mean(1)[idx[:, :few]].mean(1)
        area = (dist_sq[:, few - 1] * (torch.pi / (few - 0.5)))[idx[:, :few]].median(1).values
        floor = (0.1 * spacing.median()).clamp_min(1e-6)  # duplicates
        return _Cloud(points, idx, spacing.clamp_min(floor), area.clamp_min(floor**2))

    def part(self, keep: Tensor) -> _Cloud:
        """A subset as a cloud of its own."""
        return _Cloud.of(self.points[keep])


def _plane_normals(points: Tensor, idx: Tensor, weight: Tensor | None = None) -> Tensor:
    """Direction of least variance of points[idx], (n, 3); idx (n, k), weights (n, k)."""
    normals = []
    for rows in torch.arange(len(idx), device=idx.device).split(ROWS):
        near = points[idx[rows]].double()
        share = torch.ones_like(near[..., :1]) if weight is None else weight[rows, :, None].double()
        near = near - (share * near).sum(1, keepdim=True) / share.sum(1, keepdim=True)
        normals.append(torch.linalg.eigh(near.mT @ (share * near))[1][:, :, 0])
    return torch.cat(normals).to(points.dtype)


def _refined(points: Tensor, lines: Tensor) -> Tensor:
    return refit_normals(points, orient_normals(points, lines))


def _signs(cloud: _Cloud, normals: Tensor) -> Tensor:
    """+1 or -1 for each normal, (n,)."""
    n = len(normals)
    anchors = torch.arange(n, device=normals.device)
    if n > ANCHORS:
        anchors = torch.from_numpy(farthest_points_large(cloud.points, ANCHORS)).to(normals.device)
    few = cloud if n <= ANCHORS else cloud.part(anchors)
    sign = _global_signs(few, normals[anchors])
    if n > ANCHORS:
        sign = _spread(cloud, normals, anchors, sign)
    for _ in range(3):
        turned = _field(cloud, normals * sign[:, None])
        sign = torch.where((turned * normals).sum(1) < 0, -1.0, 1.0)
    return sign


def _global_signs(cloud: _Cloud, normals: Tensor) -> Tensor:
    points, area = cloud.points, cloud.area
    width_sq = cloud.spacing**2
    dist_sq = (points @ points.T).mul_(-2) + points.square().sum(1)[:, None] + points.square().sum(1)
    dist_sq = torch.maximum(dist_sq, (width_sq[:, None] + width_sq) / 2)
    along = (points * normals).sum(1) - points @ normals.T  # n_i.(p_i - p_j) at [j, i]
    layer = along / dist_sq**1.5 * (area.sqrt() * area.sqrt()[:, None] / (4 * torch.pi))
    sign = torch.where(_least_squares(layer, 0.5 * area.sqrt(), 4) < 0, -1.0, 1.0)
    dipole = (normals @ normals.T + 3 * along * along.T / dist_sq) / dist_sq**1.5 * area
    dipole.fill_diagonal_(0)
    for _ in range(20):
        settled = torch.where(dipole @ sign < 0, -1.0, 1.0)
        if torch.equal(settled, sign):
            break
        sign = settled
    return sign


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


def _field(cloud: _Cloud, normals: Tensor, width: float = 1.4) -> Tensor:
    """Minus the gradient of the neighbours' winding number at each point, as unit vectors (n, 3)."""
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


def _sheet_normals(cloud: _Cloud, normals: Tensor, k: int = 32) -> Tensor:
    """Plane fits to the neighbours that face the same way and lie near the tangent plane, signs kept."""
    idx = cloud.idx[:, :k]
    offset = cloud.points[idx] - cloud.points[:, None]
    distance = offset.norm(dim=-1)
    reach = distance[:, -1:] / 1.5
    rise = (offset * normals[:, None]).sum(-1).abs() + (offset * normals[idx]).sum(-1).abs()
    facing = (normals[:, None] * normals[idx]).sum(-1).clamp_min(0)
    weight = facing**4 * torch.exp(-((distance / reach) ** 2) - (rise / (0.5 * reach)) ** 2)
    weight[:, 0] = 1
    fitted = _plane_normals(cloud.points, idx, weight)
    return torch.where((fitted * normals).sum(1, keepdim=True) < 0, -fitted, fitted)
