"""Where tiles of a large cloud meet: points evened out across the borders, then all written, exactly as many.

Each tile has spread its points as if it were alone. Along a border a point may lie close to one of the next tile, or
leave a gap. There points push each other apart, those within a few spacings of the border moving, all others fixed, and
are projected onto the surface again. Tiles take turns, and each sees what those before it have become.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from pnu.geometry.attributes import carry
from pnu.geometry.point_tree import PointTree
from pnu.io import atomic_path, kept_attributes, read_json
from pnu.io.streamed_output import cloud_writer
from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.context import Context
from pnu.upsamplers.patches import with_unit_normals
from pnu.upsamplers.surface_projection import SurfaceProjection
from pnu.upsamplers.tile_plan import Plan, attributes_of
from pnu.upsamplers.tile_work import Whole, in_unit_sphere

WIDTH = 4.0  # spacings on each side of a border where points move
TURNS = 2  # more, or weaker pushes, would make borders more even than all else
NEIGHBORS = 6
REACH = 1.25  # usual distances up to which points push each other


def spacing_between(whole: Whole) -> float:
    """The distance between points made, where it is widest."""
    return 1.08 * whole.widest  # as in a hexagonal pattern


def seamed(plan: Plan, number: int, whole: Whole, upsampler: SurfaceProjection) -> None:
    """A tile whose points near its borders are evenly spaced with those beside them: file `seam`.

    Those with lower numbers are seamed, and all made.
    """
    if plan.path("seam", number).is_file():
        return
    dense, kept = np.load(plan.path("made", number)), int(read_json(plan.path("kept", number, ".json")))
    wide = WIDTH * spacing_between(whole)
    depth = plan.cells.depth(dense[:, :3], number) if len(dense) else np.empty(0)
    moving = np.flatnonzero((depth < wide) & (np.arange(len(dense)) >= kept))
    if len(moving) and len(plan.tiles) > 1:
        others = [dense[np.setdiff1d(np.flatnonzero(depth < 2 * wide), moving)]]
        for other in plan.cells.near(number, wide):
            if plan.facts.sizes[other]:
                done = plan.path("seam", other)
                there = np.load(done if other < number else plan.path("made", other), mmap_mode="r")
                others.append(there[plan.cells.inside(np.asarray(there[:, :3]), number, wide)])
        around = np.concatenate([dense[moving], *others])
        rows = np.load(plan.path("cloud", number))
        cloud, frame = in_unit_sphere(rows["point"], rows["normal"])
        moved = torch.from_numpy(pushed_apart(around, len(moving)))
        device = next(upsampler.network.parameters()).device
        query = frame.to_unit(moved[None])[0]
        query, _ = upsampler.projected(query.to(device), cloud.to(device), Context(device), "borders")
        found = with_unit_normals(query.cpu().double(), cloud)
        dense[moving] = frame.from_unit(found[None])[0].numpy()
    with atomic_path(plan.path("seam", number)) as temporary:
        np.save(temporary, dense)


def pushed_apart(cloud: NDArray[np.float64], movable: int) -> NDArray[np.float64]:
    """The first `movable` of points with normals (n, 6), pushed apart in their tangent planes, (movable, 6).

    As `pnu.geometry.even_spacing.repel`, but each point by the spacing around it, so that a sparse place does not push
    a dense one.
    """
    points, normals = cloud[:, :3].copy(), cloud[:, 3:]
    k = min(NEIGHBORS + 3, len(points))
    if k < NEIGHBORS:
        return cloud[:movable]
    distance, near = PointTree(points).nearest(points, k)
    usual = distance[:, 1 : NEIGHBORS + 1].mean(1)
    radius = REACH * np.median(usual[near], 1)
    for _ in range(TURNS):
        distance, near = PointTree(points).nearest(points[:movable], k)
        distance, near = distance[:, 1:], near[:, 1:]
        away = points[:movable, None] - points[near]
        alike = (normals[:movable, None] * normals[near]).sum(-1) > -0.2
        reach = radius[:movable, None]
        force = np.maximum(1 - distance / reach, 0) * alike / np.maximum(distance, 1e-9 * reach)
        push = 0.5 * reach * (force[..., None] * away).sum(1)
        push -= (push * normals[:movable]).sum(-1, keepdims=True) * normals[:movable]
        length = np.linalg.norm(push, axis=1, keepdims=True)
        points[:movable] += push * np.minimum(1, 0.3 * reach / np.maximum(length, 1e-300))
    return np.hstack([points[:movable], normals[:movable]])


def write_tiles(plan: Plan, whole: Whole, output: str, progress: Progress = silent) -> tuple[int, list[str]]:
    """All tiles, seamed, in one file, and as many points as are wanted: how many, and which attributes it has."""
    tiles = plan.tiles
    sizes = [len(np.load(plan.path("seam", number), mmap_mode="r")) for number in tiles]
    total = sum(sizes)
    if not total:
        raise ValueError(f"{plan.keys.input}: no tile has enough points to work with; give more memory")
    quotas = np.diff(np.round(np.cumsum(sizes) * (whole.points / total)).astype(int), prepend=0)
    some = attributes_of(np.load(plan.path("cloud", tiles[0]), mmap_mode="r")[:8])
    names = kept_attributes(output, some)
    # projected points may leave the box of those measured by a little
    slack = spacing_between(whole)
    low, high = np.array(plan.facts.low) - slack, np.array(plan.facts.high) + slack
    with cloud_writer(output, whole.points, low, high, {name: np.asarray(some[name]) for name in names}) as write:
        for done, (number, wanted) in enumerate(zip(tiles, quotas, strict=True)):
            progress("writing", done, len(tiles))
            dense, kept = np.load(plan.path("seam", number)), int(read_json(plan.path("kept", number, ".json")))
            if not len(dense):
                continue
            dense = exactly(dense, kept, int(wanted))
            rows = np.load(plan.path("cloud", number))
            sparse = np.hstack([rows["point"], rows["normal"]])
            values = attributes_of(rows)
            carried = {name: carry(dense, sparse, values[name]) for name in names}
            write(dense[:, :3], dense[:, 3:], carried)
        progress("writing", len(tiles), len(tiles))
    return whole.points, names


def exactly(dense: NDArray[np.float64], kept: int, count: int) -> NDArray[np.float64]:
    """So many of points (m, 6): the most crowded fall away, or more come to lie in the widest gaps.

    The first `kept` stay.
    """
    surplus = len(dense) - count
    if surplus == 0:
        return dense
    while len(dense) < count:
        dense = np.vstack([dense, _between(dense, count - len(dense))])
    if surplus < 0:
        return dense
    distance, near = (found[:, 1] for found in PointTree(dense[:, :3]).nearest(dense[:, :3], 2))
    free = np.arange(len(dense)) >= kept
    order = np.argsort(np.where(free, distance, np.inf), kind="stable")
    stays = np.ones(len(dense), bool)
    for spare in (True, False):  # first none whose nearest point falls away too
        for row in order[: 16 * surplus] if spare else order:
            if surplus == 0 or not free[row]:
                break
            if stays[row] and (stays[near[row]] or not spare):
                stays[row] = False
                surplus -= 1
    return dense[stays]


def _between(dense: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """At most so many middles of pairs of points (m, 6), those farthest apart with nothing between them."""
    if len(dense) == 1:
        return np.repeat(dense, count, 0)
    tree = PointTree(dense[:, :3])
    distance, near = tree.among_themselves(min(4, len(dense)))
    ends = np.stack([np.repeat(np.arange(len(dense)), near.shape[1]), near.ravel()], 1)
    pairs, first = np.unique(np.sort(ends, 1), axis=0, return_index=True)
    length = distance.ravel()[first]
    free = tree.nearest(dense[pairs, :3].mean(1), 1)[0][:, 0] > 0.49 * length
    widest = np.argsort(-np.where(free, length, 0), kind="stable")[: min(count, max(int(free.sum()), 1))]
    middle: NDArray[np.float64] = dense[pairs[widest]].mean(1)
    length = np.linalg.norm(middle[:, 3:], axis=1, keepdims=True)
    one = dense[pairs[widest, 0], 3:]
    middle[:, 3:] = np.where(length > 1e-6, middle[:, 3:] / np.maximum(length, 1e-300), one)
    return middle
