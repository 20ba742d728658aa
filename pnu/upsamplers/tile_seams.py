"""Where tiles of a large cloud meet: points evened out across the borders, then all written, exactly as many.

Each tile has spread its points as if it were alone. Along a border a point may lie close to one of the next tile, or
leave a gap. There points push each other apart, those within a few spacings of the border moving, all others fixed, and
are projected onto the surface again. Tiles take turns, and each sees what those before it have become.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.attributes import carry
from pnu.geometry.even_spacing import REACH, USUAL, pushed_apart
from pnu.geometry.point_tree import PointTree
from pnu.io import atomic_path, kept_attributes, read_json
from pnu.io.scan_columns import tells_apart
from pnu.io.streamed_output import cloud_writer
from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.surface_projection import SurfaceProjection
from pnu.upsamplers.tile_plan import Plan, attributes_of
from pnu.upsamplers.tile_work import Whole, beside_borders, context_of, looked_at_beside_borders, spacing_between
from pnu.upsamplers.unit_normals import with_unit_normals

GAP = 0.49  # of the way between two points, from their middle to the nearest other one
CROWD = 12  # middles that may lie around another
TURNS = 2  # more, or weaker pushes, would make borders more even than all else


def seamed(plan: Plan, number: int, whole: Whole, upsampler: SurfaceProjection) -> None:
    """A tile whose points near its borders are evenly spaced with those beside them: file `seam`.

    Those with lower numbers are seamed, and all made.
    """
    if plan.path("seam", number).is_file():
        return
    dense, kept = np.load(plan.path("made", number)), int(read_json(plan.path("kept", number, ".json")))
    wide = beside_borders(whole)
    depth = plan.cells.depth(dense[:, :3], number) if len(dense) else np.empty(0)
    moving = np.flatnonzero((depth < wide) & (np.arange(len(dense)) >= kept))
    if len(moving) and len(plan.tiles) > 1:
        others = [dense[np.setdiff1d(np.flatnonzero(depth < 2 * wide), moving)]]
        others += _beside(plan, number, "seam", "made", wide)
        around = np.concatenate([dense[moving], *others])
        context = context_of(upsampler)
        cloud, frame = looked_at_beside_borders(plan, number, upsampler, context)
        query = frame.to_unit(evened_out(around, len(moving)))
        query, _ = upsampler.projected(query, cloud, context, "borders")
        dense[moving] = frame.from_unit(with_unit_normals(query, cloud))
    with atomic_path(plan.path("seam", number)) as temporary:
        np.save(temporary, dense)


def _beside(plan: Plan, number: int, before: str, after: str, wide: float) -> list[NDArray[np.float64]]:
    """Points (k, 6) of other tiles within `wide` of a tile, of those with lower numbers as in one file, of those with
    higher ones as in another."""
    found = []
    for other in plan.cells.near(number, wide):
        if plan.facts.sizes[other]:
            there = np.load(plan.path(before if other < number else after, other), mmap_mode="r")
            found.append(there[plan.cells.inside(np.asarray(there[:, :3]), number, wide)])
    return found


def evened_out(cloud: NDArray[np.float64], movable: int) -> NDArray[np.float64]:
    """The first `movable` of points with normals (n, 6), pushed apart in their tangent planes, (movable, 6).

    As `pnu.geometry.even_spacing.repel`, but each point by the spacing around it, so that a sparse place does not push
    a dense one.
    """
    points, normals = cloud[:, :3].copy(), cloud[:, 3:]
    k = min(USUAL + 3, len(points))
    if k < USUAL:
        return cloud[:movable]
    distance, near = PointTree(points).nearest(points, k)
    usual = distance[:, 1 : USUAL + 1].mean(1)
    reach = (REACH * np.median(usual[near], 1))[:movable]
    for _ in range(TURNS):
        near = PointTree(points).nearest(points[:movable], k)[1]
        points[:movable] = pushed_apart(points, normals, near[:, 1:], reach)
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
    wide, added = beside_borders(whole), np.empty((0, 6))
    with cloud_writer(output, whole.points, low, high, {name: np.asarray(some[name]) for name in names}) as write:
        for done, (number, wanted) in enumerate(zip(tiles, quotas, strict=True)):
            progress("writing", done, len(tiles))
            dense, kept = np.load(plan.path("seam", number)), int(read_json(plan.path("kept", number, ".json")))
            if not len(dense):
                continue
            beside = np.vstack([added, *_beside(plan, number, "seam", "seam", wide)])
            dense, before = exactly(dense, kept, int(wanted), beside), len(dense)
            added = np.vstack([added, dense[before:]])
            rows = np.load(plan.path("cloud", number))
            sparse = np.hstack([rows["point"], rows["normal"]])
            values = attributes_of(rows)
            carried = {name: carry(dense, sparse, values[name], kinds=tells_apart(name)) for name in names}
            write(dense[:, :3], dense[:, 3:], carried)
        progress("writing", len(tiles), len(tiles))
    return whole.points, names


def exactly(
    dense: NDArray[np.float64], kept: int, count: int, beside: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """So many of points (m, 6): the most crowded fall away, or more come to lie in the widest gaps.

    The first `kept` stay. Gaps are where no points `beside` (k, 3) lie either.
    """
    surplus = len(dense) - count
    if surplus == 0:
        return dense
    while len(dense) < count:
        dense = np.vstack([dense, _between(dense, count - len(dense), beside)])
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


def _between(dense: NDArray[np.float64], count: int, beside: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """At most so many middles of pairs of points (m, 6), those farthest apart with nothing between them.

    Neither points `beside` (k, 3) nor another middle lies there.
    """
    if len(dense) == 1:
        return np.repeat(dense, count, 0)
    near = PointTree(dense[:, :3]).among_themselves(min(4, len(dense)))[1]
    ends = np.stack([np.repeat(np.arange(len(dense)), near.shape[1]), near.ravel()], 1)
    pairs = np.unique(np.sort(ends, 1), axis=0)
    length = np.linalg.norm(dense[pairs[:, 0], :3] - dense[pairs[:, 1], :3], axis=1)
    places = dense[:, :3] if beside is None else np.vstack([dense[:, :3], beside[:, :3]])
    free = PointTree(places).nearest(dense[pairs, :3].mean(1), 1)[0][:, 0] > GAP * length
    order = np.argsort(-np.where(free, length, 0), kind="stable")[: max(int(free.sum()), 1)]
    widest = order[_apart(dense[pairs[order], :3].mean(1), GAP * length[order])][:count]
    middle: NDArray[np.float64] = dense[pairs[widest]].mean(1)
    length = np.linalg.norm(middle[:, 3:], axis=1, keepdims=True)
    one = dense[pairs[widest, 0], 3:]
    middle[:, 3:] = np.where(length > 1e-6, middle[:, 3:] / np.maximum(length, 1e-300), one)
    return middle


def _apart(places: NDArray[np.float64], room: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rows of places (m, 3), the first of all, then each that leaves its room (m,) to those before it."""
    distance, near = PointTree(places).among_themselves(min(CROWD + 1, len(places)))
    taken = np.zeros(len(places), bool)
    for row in range(len(places)):
        taken[row] = not (taken[near[row]] & (distance[row] < room[row])).any()
    return np.flatnonzero(taken)
