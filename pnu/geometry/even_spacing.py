"""Spread points over a surface that is known by points and normals: seeds between the points, even spacing."""

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from pnu.geometry.local_frames import tangent_basis
from pnu.geometry.neighbor_search import Search, knn
from pnu.geometry.spatial_blocks import along_curve
from pnu.runtime.progress import Step, silent

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
ROWS = 2**18  # points whose neighbors are gathered at once: bounds the memory
RANK = 12  # of the neighbor that a disc of seeds reaches


def tangent_discs(points: Tensor, normals: Tensor, count: int, *, rank: int = RANK, first: int | None = None) -> Tensor:
    """Seeds on a disc around each point in its tangent plane, as wide as the rank-th neighbor is far.

    points, normals (n, 3) -> (n, count, 3), or (first, count, 3) around the first points alone. Evenly spread by area
    (a sunflower), turned from point to point and measured from the direction of the nearest neighbor: nothing is
    random, and seeds turn and grow with the cloud. The discs overlap, so that seeds also lie in holes between points.
    """
    rank = min(rank, len(points) - 1)
    cloud = points
    points, normals = points[:first], normals[:first]
    found = knn(points[None], cloud[None], rank + 1)
    radius = found.dist_sq[0, :, -1:].sqrt()
    toward = cloud[found.idx[0, :, 1]] - points
    along = toward - (toward * normals).sum(-1, keepdim=True) * normals
    short = along.norm(dim=-1, keepdim=True) <= 1e-6 * radius
    along = normalize(torch.where(short, tangent_basis(normals)[0], along), dim=-1)
    across = torch.linalg.cross(normals, along)
    seed = torch.arange(count, device=points.device, dtype=points.dtype)
    discs = points.new_empty(len(points), count, 3)
    for part in torch.split(torch.arange(len(points), device=points.device), max(ROWS // count, 1)):
        point = part[:, None].to(points.dtype)
        share = (seed + (point * (1 / GOLDEN_ANGLE)).frac()) / count
        angle = GOLDEN_ANGLE * (seed + count * point)
        r = radius[part] * share.sqrt()
        discs[part] = (
            points[part, None]
            + (r * angle.cos())[..., None] * along[part, None]
            + (r * angle.sin())[..., None] * across[part, None]
        )
    return discs


def repel(
    points: Tensor,
    normals: Tensor,
    *,
    steps: int,
    neighbors: int = 8,
    step: Step = silent,
    movable: int | None = None,
) -> Tensor:
    """Even out the spacing: points (m, 3) push neighbors apart in their tangent planes, `steps` times.

    Only the first `movable` move, all by default.

    Points push each other with a force that falls to zero at about the distance that evenly spread points have, so
    a cloud does not grow beyond its border. Points of sheets that look opposite ways ignore each other.
    """
    m, k = len(points), min(neighbors + 1, len(points))
    parts = torch.split(torch.arange(m, device=points.device), ROWS)
    dist, idx = points.new_empty(m, k - 1), torch.empty(m, k - 1, dtype=torch.int32, device=points.device)
    done, total = 0, steps * len(parts)
    step(0, total)
    order = along_curve(points)
    points, normals = points[order], normals[order]
    free = (order < (m if movable is None else movable))[:, None].to(points)
    for _ in range(steps):
        search = Search(points)
        for part in parts:
            found = search.knn(points[part], k, ordered=True)
            dist[part], idx[part] = found.dist_sq[:, 1:].sqrt(), found.idx[:, 1:].int()
            done += 1
            step(done, total)
        radius = 1.25 * dist[:, :6].mean(1).median()
        moved = []
        for part in parts:
            near = idx[part].long()
            away = points[part, None] - points[near]
            alike = (normals[part, None] * normals[near]).sum(-1) > -0.2
            force = (1 - dist[part] / radius).clamp(min=0) * alike / dist[part].clamp(min=1e-9 * radius)
            push = 0.5 * radius * (force[..., None] * away).sum(1)
            push = push - (push * normals[part]).sum(-1, keepdim=True) * normals[part]
            push = push * free[part]
            moved.append(points[part] + push * (0.3 * radius / push.norm(dim=-1, keepdim=True).clamp(min=0.3 * radius)))
        points = torch.cat(moved)
    back = torch.empty_like(points)
    back[order] = points
    return back
