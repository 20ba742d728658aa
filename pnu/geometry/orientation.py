"""One side for all normals of a cloud.

By the winding number. For outward normals n and point areas a the double layer
w(x) = sum_j a_j n_j.(p_j - x) / (4 pi |p_j - x|^3) is 1 inside, 0 outside and 1/2 on the surface (Gauss). Asking for
1/2 at every point, with unknown signed areas along given lines, is linear and does not depend on how the lines happen
to point; a few steps of conjugate gradients give the smooth solution, whose signs are the orientation up to stray
points. Those are settled by the gradient of w, which at each point must look along minus its normal: the field of all
other dipoles. Related: parametric Gauss reconstruction (Lin et al. 2022), winding number normal consistency (Lin et al.
2024), dipole propagation (Metzer et al. 2021); here the lines are known, which leaves one unknown a point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from pnu import kernels
from pnu.geometry.neighbor_search import knn, nearest
from pnu.geometry.sampling import farthest_points_large
from pnu.runtime import threads

ANCHORS = 4096  # points whose dipoles all see each other: 64 MiB a matrix
ROWS = 2**16  # points treated at once in local steps,
CHUNK = 2**11  # or so many by a thread
BLOCK = 128  # rows of a matrix of all pairs, few enough for a processor's cache
OPEN = 0.6  # relative misfit of Gauss' law; closed shapes stay below 0.5, a hemisphere too
SOME_NOISE = 0.1  # in spacings, where it is not known
Array = NDArray[np.float32]


class NeighborCloud(NamedTuple):
    """A cloud in its unit sphere, and what local steps need to know of it."""

    points: Tensor  # (n, 3) float32
    idx: Tensor  # (n, k) nearest points, itself first
    spacing: Tensor  # (n,) usual distance to a neighbor
    area: Tensor  # (n,) of the surface that the point stands for

    @staticmethod
    def of(points: Tensor) -> NeighborCloud:
        """Of points (n, 3) in any unit."""
        points = points.detach().double()
        points = points - points.mean(0)
        points = (points / points.norm(dim=1).max().clamp_min(1e-30)).float()
        few, k = min(8, len(points)), min(48, len(points))
        dist_sq, idx = (found[0] for found in knn(points[None], points[None], k))
        spacing = dist_sq[:, 1:6].sqrt().mean(1)[idx[:, :few]].mean(1)
        area = (dist_sq[:, few - 1] * (torch.pi / (few - 0.5)))[idx[:, :few]].median(1).values
        floor = (0.1 * spacing.median()).clamp_min(1e-6)  # duplicates
        return NeighborCloud(points, idx, spacing.clamp_min(floor), area.clamp_min(floor**2))


def signs(cloud: NeighborCloud, lines: Tensor) -> Tensor:
    """+1 or -1 for each line, (n,)."""
    if len(lines) <= ANCHORS:
        sign = _global_signs(cloud, lines)
    else:
        anchors = torch.from_numpy(farthest_points_large(cloud.points, ANCHORS)).to(lines.device)
        sign = _spread(cloud, lines, anchors, _global_signs(NeighborCloud.of(cloud.points[anchors]), lines[anchors]))
    for _ in range(3):
        turned = field(cloud, lines * sign[:, None], SOME_NOISE)
        sign = _sign((turned * lines).sum(1))
    return sign


def is_closed(cloud: NeighborCloud, normals: Tensor) -> bool:
    """Whether oriented normals (n, 3) bound something: as far as Gauss' law holds at an even subset of the points."""
    if len(normals) > ANCHORS:
        chosen = torch.from_numpy(farthest_points_large(cloud.points, ANCHORS)).to(normals.device)
        cloud, normals = NeighborCloud.of(cloud.points[chosen]), normals[chosen]
    weight = cloud.area.sqrt()
    winding = _layers(cloud, normals, torch.ones_like(weight)) @ cloud.area
    return bool(((winding.abs() - 0.5) * weight).norm() <= OPEN * (0.5 * weight).norm())


def _global_signs(cloud: NeighborCloud, lines: Tensor) -> Tensor:
    weight = cloud.area.sqrt()
    layer = _layers(cloud, lines, weight)
    areas = _least_squares(layer, 0.5 * weight, 4)

    def misfit(sign: Tensor) -> float:
        return float((layer @ (sign * weight) - 0.5 * weight).norm() / (0.5 * weight).norm())

    # narrow dipoles keep thin walls apart, wide ones see past noise: Gauss' law tells which did better
    sign = min((_settled(_dipoles(cloud, lines, width), _sign(areas))[0] for width in (1.0, 1.4, 2.0)), key=misfit)
    if misfit(sign) > OPEN:
        sign = _open_signs(cloud, lines, areas)
        sign = sign * _sign((layer @ (sign * weight) * weight).sum())
    return sign


def _open_signs(cloud: NeighborCloud, lines: Tensor, areas: Tensor) -> Tensor:
    """Of an open sheet, where Gauss' law says little: the signs of least energy from several guesses.

    Guesses: the areas' signs, lines followed from point to point, and the sides seen from 13 directions.
    """
    dipoles = _dipoles(cloud, lines, 1.4)
    axes = torch.linalg.eigh(cloud.points.T @ cloud.points)[1]
    steps = torch.cartesian_prod(*[torch.arange(-1.0, 2.0)] * 3)[14:].to(axes)
    piece = torch.from_numpy(connected_components(_graph(cloud, lines))[1]).to(lines.device)
    surest = torch.stack([(areas.abs() * (piece == i)).argmax() for i in range(int(piece.max()) + 1)])
    guesses = [_sign(areas), _spread(cloud, lines, surest, _sign(areas[surest]))]
    guesses += [_sign(lines @ axes @ step) for step in steps]
    return min((_settled(dipoles, guess) for guess in guesses), key=lambda found: found[1])[0]


def _settled(dipoles: Tensor, sign: Tensor) -> tuple[Tensor, float]:
    """Signs turned along the field of all dipoles until they agree with it, and their energy."""
    for _ in range(20):
        along = dipoles @ sign
        if bool((along * sign >= 0).all()):
            break
        sign = _sign(along)
    return sign, -(sign @ (dipoles @ sign)).item()


def _sign(values: Tensor) -> Tensor:
    return torch.where(values < 0, -1.0, 1.0)


def _blocks(lines: Tensor) -> tuple[Tensor, ...]:
    """Rows of a matrix of all pairs, block by block."""
    return torch.split(torch.arange(len(lines), device=lines.device), BLOCK)


def _layers(cloud: NeighborCloud, lines: Tensor, scale: Tensor) -> Tensor:
    """Winding number at each point of unit area at each point, times the factors (n,) of both: (n, n)."""
    if _compiled(cloud):
        from pnu.kernels.dipoles import winding_rows

        return _all_pairs(winding_rows, cloud, lines, cloud.spacing, scale)
    return torch.cat([_layer(cloud, lines, rows) for rows in _blocks(lines)]).mul_(scale).mul_(scale[:, None])


def _compiled(cloud: NeighborCloud) -> bool:
    return cloud.points.device.type == "cpu" and kernels.ready()


def _all_pairs(
    rows_of: Callable[[Array, int, Array], None], cloud: NeighborCloud, lines: Tensor, widths: Tensor, scale: Tensor
) -> Tensor:
    """A matrix (n, n) whose rows a kernel computes, on all threads."""
    from pnu.kernels.dipoles import as_sources

    sources = as_sources(*(values.numpy() for values in (cloud.points, lines, widths, scale)))
    matrix = np.empty((len(lines), len(lines)), np.float32)
    threads.map_on_threads(lambda i: rows_of(sources, i, matrix[i : i + BLOCK]), range(0, len(lines), BLOCK))
    return torch.from_numpy(matrix)


def _layer(cloud: NeighborCloud, lines: Tensor, rows: Tensor) -> Tensor:
    """Winding number at points `rows` of unit area at each point, (r, n)."""
    points = cloud.points
    along = (points * lines).sum(1) - points[rows] @ lines.T
    return _inverse_distances(cloud, rows, 1.0).pow_(3).mul_(along).div_(4 * torch.pi)


def _dipoles(cloud: NeighborCloud, lines: Tensor, width: float) -> Tensor:
    """Field at each point, along its line, of each point's dipole, times both areas: (n, n), symmetric."""
    if _compiled(cloud):
        from pnu.kernels.dipoles import dipole_rows

        return _all_pairs(dipole_rows, cloud, lines, width * cloud.spacing, cloud.area)
    points, height = cloud.points, (cloud.points * lines).sum(1)
    blocks = []
    for rows in _blocks(lines):
        inverse = _inverse_distances(cloud, rows, width)
        there, here = height - points[rows] @ lines.T, height[rows, None] - lines[rows] @ points.T
        block = there.mul_(here).mul_(inverse).mul_(inverse).mul_(3).addmm_(lines[rows], lines.T)
        blocks.append(block.mul_(inverse.pow_(3)).mul_(cloud.area).mul_(cloud.area[rows, None]))
    return torch.cat(blocks).fill_diagonal_(0)


def _inverse_distances(cloud: NeighborCloud, rows: Tensor, width: float) -> Tensor:
    """1 / max(distance, width x spacing) of points `rows` from all, (r, n)."""
    size, width_sq = cloud.points.square().sum(1), (width * cloud.spacing) ** 2 / 2
    dist_sq = (size + size[rows, None]).addmm_(cloud.points[rows], cloud.points.T, alpha=-2)
    return torch.maximum(dist_sq, width_sq + width_sq[rows, None], out=dist_sq).rsqrt_()


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


def _graph(cloud: NeighborCloud, lines: Tensor) -> csr_matrix:
    """Neighbors, both ways, by how much their lines turn and how far they leave each other's tangent plane."""
    n, near = len(lines), cloud.idx[:, 1:13]
    cosine = (lines[:, None] * lines[near]).sum(-1)
    offset = cloud.points[near] - cloud.points[:, None]
    rise = (offset * lines[:, None]).sum(-1).abs() / offset.norm(dim=-1).clamp_min(1e-12)
    cost = (1.01 - cosine.abs() + rise).double().cpu().numpy()
    graph = csr_matrix((cost.ravel(), near.cpu().numpy().ravel(), np.arange(n + 1) * near.shape[1]), (n, n))
    return graph.maximum(graph.T)


def _spread(cloud: NeighborCloud, lines: Tensor, anchors: Tensor, sign: Tensor) -> Tensor:
    """Signs of all points from those of the anchors, along paths on which the lines turn least."""
    n = len(lines)
    source = anchors.cpu().numpy()
    before = dijkstra(_graph(cloud, lines), indices=source, min_only=True, return_predecessors=True)[1]
    alone = before < 0
    alone[source] = False
    parent = torch.from_numpy(np.where(before < 0, np.arange(n), before).astype(np.int64)).to(lines.device)
    if alone.any():
        lost = torch.from_numpy(np.flatnonzero(alone)).to(lines.device)
        parent[lost] = anchors[nearest(cloud.points[None, lost], cloud.points[None, anchors]).idx[0]]
    agree = _sign((lines * lines[parent]).sum(1))
    agree[anchors] = sign
    parent[anchors] = anchors
    rooted = torch.zeros(n, dtype=torch.bool, device=lines.device)
    rooted[anchors] = True
    while not bool(rooted.all()):  # pointer doubling
        agree = torch.where(rooted, agree, agree * agree[parent])
        rooted, parent = rooted | rooted[parent], parent[parent]
    return agree


def field(cloud: NeighborCloud, normals: Tensor, noise: float) -> Tensor:
    """Minus the gradient of the neighbors' winding number at each point, as unit vectors (n, 3)."""
    width = 1 + 3 * noise
    if _compiled(cloud):
        return _compiled_field(cloud, normals, width)
    out = []
    for rows in torch.split(torch.arange(len(normals), device=normals.device), ROWS):
        idx = cloud.idx[rows, 1:]
        offset = cloud.points[idx] - cloud.points[rows, None]
        width_sq = width**2 * (cloud.spacing[rows, None] ** 2 + cloud.spacing[idx] ** 2) / 2
        dist_sq = torch.maximum(offset.square().sum(-1), width_sq)[..., None]
        along = (normals[idx] * offset).sum(-1, keepdim=True)
        dipoles = (normals[idx] - 3 * along / dist_sq * offset) * cloud.area[idx][..., None] / dist_sq**1.5
        out.append(torch.nn.functional.normalize(dipoles.sum(1), dim=1))
    return torch.cat(out)


def _compiled_field(cloud: NeighborCloud, normals: Tensor, width: float) -> Tensor:
    from pnu.kernels.dipoles import as_sources, neighbor_field

    values = (cloud.points, normals.float(), width * cloud.spacing, cloud.area)
    sources = np.ascontiguousarray(as_sources(*(value.numpy() for value in values)).T)
    idx, found = cloud.idx.contiguous().numpy(), np.empty((len(normals), 3), np.float32)
    parts = range(0, len(found), CHUNK)
    threads.map_on_threads(lambda i: neighbor_field(sources, idx, i, found[i : i + CHUNK]), parts)
    return torch.from_numpy(found).to(normals)
