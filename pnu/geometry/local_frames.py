"""Local frames: a point's surroundings as seen from the surface below it, free of place, rotation and size."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from pnu.geometry.algebraic_sphere import fit_sphere, neighbor_weights, project_to_sphere

FEATURES = 11  # numbers that describe a neighbor
REACH = 1.5  # longest step to the fitted sphere, in units of the spacing
FLAT = 0.03  # weight of positions beside normals in the choice of the first axis


class LocalFrames(NamedTuple):
    """Frames of m queries and their k neighbors in them."""

    base: Tensor  # (m, 3) foot of the query on the sphere that fits its neighbors, relative to the query
    axes: Tensor  # (m, 3, 3) rows x, y and z; z is the sphere's normal; orthonormal, of either hand
    spacing: Tensor  # (m, 1) mean distance of the neighbors, the unit of length
    height: Tensor  # (m, 1) of the query above the foot, in spacings
    features: Tensor  # (m, k, 11): position 0:3, normal 3:6, then lengths and products of them


def local_frames(offsets: Tensor, normals: Tensor, hint: Tensor, *, sphere: bool = True) -> LocalFrames:
    """Frames for queries by offsets and normals (m, k, 3) of their neighbors, nearest first, and a rough normal.

    One step of an algebraic point set surface (`pnu.geometry.algebraic_sphere`) gives foot and normal; neighbors that
    look away from the rough normal count little. The first axis is where normals change most, across an edge say, or
    where the neighbors spread most on a plane; the signs of both axes come from the third moment of the positions. So
    frames turn, move and grow with the cloud. Without `sphere` the foot is the query and its normal the rough one.
    """
    spacing, seen, weights = _surroundings(offsets, normals, hint)
    x = offsets / spacing[..., None]
    step, z = _foot(x, normals, hint, weights) if sphere else (torch.zeros_like(hint), hint)
    x = x - step[:, None]
    axes = torch.stack([*_tangents(x, normals, z, weights), z], 1)
    local, local_normals = x @ axes.mT, normals @ axes.mT
    height = (local * local_normals).sum(-1, keepdim=True)  # of the foot below the neighbor's plane
    bent = 0.5 * (height + local[..., 2:])  # the same if the surface bends evenly: exact on a sphere
    share = weights[..., None] * weights.shape[1]
    length = local.norm(dim=-1, keepdim=True)
    features = torch.cat([local, local_normals, length, bent, height, seen[..., None], share], -1)
    return LocalFrames(step * spacing, axes, spacing, -(step * z).sum(-1, keepdim=True), features)


def feet(offsets: Tensor, normals: Tensor, hint: Tensor) -> tuple[Tensor, Tensor]:
    """Step (m, 3) from each query to its foot, and the unit normal there (m, 3), alone; else as `local_frames`."""
    spacing, _, weights = _surroundings(offsets, normals, hint)
    step, normal = _foot(offsets / spacing[..., None], normals, hint, weights)
    return step * spacing, normal


def _surroundings(offsets: Tensor, normals: Tensor, hint: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean distance of the neighbors (m, 1), cosine of their normals and the rough one, their weights (m, k)."""
    dist = offsets.norm(dim=-1)
    spacing = dist.mean(1, keepdim=True).clamp(min=torch.finfo(dist.dtype).tiny)
    seen = (normals @ hint[..., None])[..., 0]
    weights = neighbor_weights((dist / spacing).square()) * ((1 + seen).clamp(min=2e-3) / 2).square()
    return spacing, seen, weights / weights.sum(1, keepdim=True).clamp(min=torch.finfo(dist.dtype).tiny)


def _foot(x: Tensor, normals: Tensor, hint: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Step in spacings onto the sphere that fits neighbors x (m, k, 3), and the normal there."""
    step, z = project_to_sphere(*fit_sphere(x, normals, weights))
    step = step * (REACH / step.norm(dim=-1, keepdim=True).clamp(min=REACH))
    return step, torch.where(z.norm(dim=-1, keepdim=True) > 0.5, z, hint)


def _tangents(x: Tensor, normals: Tensor, z: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    u, v = tangent_basis(z)
    basis = torch.stack([u, v], 1).mT
    turn, place = normals @ basis, x @ basis
    w = weights[..., None]
    spread = ((w * turn).mT @ turn) + FLAT * ((w * place).mT @ place)
    angle = 0.5 * torch.atan2(2 * spread[:, 0, 1], spread[:, 0, 0] - spread[:, 1, 1])[:, None]
    first = angle.cos() * u + angle.sin() * v
    second = torch.linalg.cross(z, first)

    def with_sign(axis: Tensor) -> Tensor:
        moment = (weights * (x * axis[:, None]).sum(-1).pow(3)).sum(1, keepdim=True)
        return torch.where(moment < 0, -axis, axis)

    return with_sign(first), with_sign(second)


def tangent_basis(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (m, 3) that complete unit normals (m, 3) to a right-handed frame."""
    aside = torch.zeros_like(normals).scatter_(1, normals.abs().argmin(1, keepdim=True), 1)
    u = normalize(torch.linalg.cross(normals, aside), dim=-1)
    return u, torch.linalg.cross(normals, u)
