"""Spread points over a surface that is known by points and normals: seeds between the points, even spacing."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu import kernels
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spatial_blocks import along_curve
from pnu.runtime.progress import Step, silent
from pnu.runtime.threads import map_on_threads, thread_count

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
ROWS = 2**16  # points whose neighbors are gathered at once: bounds the memory,
CHUNK = 2**11  # or so many by a thread
RANK = 12  # of the neighbor that a disc of seeds reaches
AROUND = 8  # neighbors push a point
USUAL = 6  # neighbors whose mean distance tells how far apart points lie,
REACH = 1.25  # and so many of these distances points push each other
FACING = -0.2  # cosine of normals from which on they do
LONGEST = 0.3  # reaches that a point moves at once, at most
LEAST = 1e-150  # reach, where all points lie at one place

Floats = NDArray[np.float64]


def tangent_discs(
    points: NDArray[np.floating], normals: NDArray[np.floating], count: int, *, rank: int = RANK,
    first: int | None = None, out: NDArray[np.floating] | None = None,
) -> NDArray[np.floating]:  # fmt: skip
    """Seeds on a disc around each point in its tangent plane, as wide as the rank-th neighbor is far.

    points, normals (n, 3) -> (n, count, 3), or (first, count, 3) around the first points alone, into `out` if given.
    Evenly spread by area (a sunflower), turned from point to point and measured from the direction of the nearest
    neighbor: nothing is random, and seeds turn and grow with the cloud. The discs overlap, so that seeds also lie in
    holes between points.
    """
    rank = min(rank, len(points) - 1)
    kind: Any = points.dtype
    cloud, points, normals = points, points[:first], normals[:first]
    distance, idx = PointTree(cloud).nearest(points, rank + 1, threads=thread_count())
    radius = distance[:, -1:].astype(kind)
    toward = cloud[idx[:, 1]] - points
    along = toward - (toward * normals).sum(-1, keepdims=True) * normals
    short = np.linalg.norm(along, axis=-1, keepdims=True) <= 1e-6 * radius
    along = _unit(np.where(short, perpendicular(normals), along))
    across = np.cross(normals, along)
    seed = np.arange(count, dtype=kind)
    discs = np.empty((len(points), count, 3), kind) if out is None else out
    rows = max(ROWS // count, 1)
    for start in range(0, len(points), rows):
        part = slice(start, start + rows)
        point = np.arange(start, min(start + rows, len(points)), dtype=kind)[:, None]
        share = (seed + (point * kind.type(1 / GOLDEN_ANGLE)) % 1) / count
        angle = kind.type(GOLDEN_ANGLE) * (seed + count * point)
        r = radius[part] * np.sqrt(share)
        discs[part] = points[part, None]
        discs[part] += (r * np.cos(angle))[..., None] * along[part, None]
        discs[part] += (r * np.sin(angle))[..., None] * across[part, None]
    return discs


def repel(points: Floats, normals: Floats, *, steps: int, step: Step = silent, movable: int | None = None) -> Floats:
    """Even out the spacing: points (m, 3) push neighbors apart in their tangent planes, `steps` times.

    Only the first `movable` move, all by default.

    Points push each other with a force that falls to zero at about the distance that evenly spread points have, so
    a cloud does not grow beyond its border. Points of sheets that look opposite ways ignore each other.
    """
    m, k = len(points), min(AROUND + 1, len(points))
    done, total = 0, steps * -(-m // ROWS)
    step(0, total)
    if m < 2:
        step(total, total)
        return points.copy()
    order = along_curve(points)
    points, normals = points.take(order, 0), normals.take(order, 0)
    fixed = order >= (m if movable is None else movable)
    usual, near = np.empty(m), np.empty((m, k - 1), np.int64)
    for _ in range(steps):
        tree = PointTree(points)
        for start in range(0, m, ROWS):
            part = slice(start, start + ROWS)
            dist_sq, idx = tree.nearest_sq(points[part], k, threads=thread_count(), ordered=True)
            usual[part], near[part] = np.sqrt(dist_sq[:, 1 : USUAL + 1]).mean(1), idx[:, 1:]
            done += 1
            step(done, total)
        del tree
        reach = np.full(m, REACH * np.quantile(usual, 0.5, method="lower"))
        moved = pushed_apart(points, normals, near, reach)
        moved[fixed] = points[fixed]
        points = moved
    back = np.empty_like(points)
    back[order] = points
    return back


def pushed_apart(points: Floats, normals: Floats, near: NDArray[np.int64], reach: Floats) -> Floats:
    """Where the first r of points (m, 3) go when their neighbors near (r, k) push them in their tangent planes, each
    within its reach (r,): (r, 3)."""
    moved, reach = np.empty((len(near), 3)), np.maximum(reach, LEAST)
    parts = [slice(start, start + CHUNK) for start in range(0, len(near), CHUNK)]
    if kernels.ready():
        from pnu.kernels.pushes import push_apart

        arrays = [np.ascontiguousarray(values) for values in (points, normals, near, reach)]
        map_on_threads(lambda part: push_apart(*arrays, part.start, moved[part]), parts)
        return moved
    for part in parts:
        here, idx, far = slice(part.start, min(part.stop, len(near))), near[part], reach[part, None]
        away = points[here, None] - points[idx]
        distance = np.linalg.norm(away, axis=-1)
        facing = (normals[here, None] * normals[idx]).sum(-1) > FACING
        force = np.maximum(1 - distance / far, 0) * facing / np.maximum(distance, 1e-9 * far)
        push = 0.5 * far * (force[..., None] * away).sum(1)
        push -= (push * normals[here]).sum(-1, keepdims=True) * normals[here]
        longest = LONGEST * far
        moved[part] = points[here] + push * (longest / np.maximum(np.linalg.norm(push, axis=1, keepdims=True), longest))
    return moved


def _unit(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    found: NDArray[np.floating] = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    return found


def perpendicular(normals: NDArray[np.floating]) -> NDArray[np.floating]:
    """A unit vector across each unit normal (n, 3), the first of `pnu.geometry.local_frames.tangent_basis`."""
    aside = np.zeros_like(normals)
    np.put_along_axis(aside, np.abs(normals).argmin(1)[:, None], 1, 1)
    return _unit(np.cross(normals, aside))
