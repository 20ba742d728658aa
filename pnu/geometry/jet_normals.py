"""Normals by osculating jets: a polynomial height field fitted to the neighbors of each point."""

import torch
from torch import Tensor

from pnu.geometry.neighbor_search import knn
from pnu.geometry.orientation import ROWS


def jet_normals(points: Tensor, k: int = 24, degree: int = 2) -> Tensor:
    """Unit normals (B, n, 3) of clouds (B, n, 3), signs arbitrary, at the top of jets of the k nearest points.

    In the frame of the neighbors' principal axes the height is fitted by all monomials u^a v^b with a + b <= degree,
    least squares, lengths scaled to about 1; the normal is that of the graph over the point, (-h_u, -h_v, 1).
    ValueError if k is not in 3..n, or too small for the monomials.

    Source: Cazals and Pouget, "Estimating differential quantities using polynomial fitting of osculating jets", CAGD
    2005.
    """
    powers = [(a, b) for a in range(degree + 1) for b in range(degree + 1 - a)]
    if degree < 1:
        raise ValueError(f"degree: expected at least 1, found {degree}")
    if not max(3, len(powers)) <= k <= points.shape[1]:
        raise ValueError(
            f"k: expected {max(3, len(powers))} (the polynomial's terms) to {points.shape[1]} neighbors (the number of "
            f"points), found {k}"
        )
    clouds = []
    for cloud, idx in zip(points.detach().double(), knn(points, points, k).idx, strict=True):
        rows = [_graph_normals(cloud, part, powers) for part in torch.split(idx, ROWS)]
        clouds.append(torch.cat(rows))
    return torch.stack(clouds).to(points)


def _graph_normals(cloud: Tensor, idx: Tensor, powers: list[tuple[int, int]]) -> Tensor:
    """Normals of points idx[:, 0], the nearest of themselves, from their neighbors idx (m, k): (m, 3)."""
    near = cloud[idx]
    offset = near - near[:, :1]  # the jet is expanded at the point itself
    spread = near - near.mean(1, keepdim=True)
    axes = torch.linalg.eigh(spread.mT @ spread)[1].flip(2)  # u, v, height
    u, v, height = (offset @ axes).unbind(-1)
    size = (u.square() + v.square()).mean(1, keepdim=True).sqrt().clamp_min(torch.finfo(u.dtype).tiny)
    u, v, height = u / size, v / size, height / size
    terms = torch.stack([u**a * v**b for a, b in powers], -1)
    system = terms.mT @ terms + 1e-9 * torch.eye(len(powers), dtype=u.dtype, device=u.device)
    jet = torch.linalg.solve(system, terms.mT @ height[..., None])[..., 0]
    slope = torch.stack([-jet[:, powers.index((1, 0))], -jet[:, powers.index((0, 1))], torch.ones_like(jet[:, 0])], -1)
    return torch.nn.functional.normalize((axes @ slope[..., None])[..., 0], dim=1)
