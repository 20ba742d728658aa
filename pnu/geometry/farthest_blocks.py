"""Farthest points of a large cloud block by block, without borders between the blocks.

Farthest points are a packing: those chosen last are about as far from the others all over the cloud. So blocks agree on
that distance first. Then each block takes farthest points down to it, beginning with what its neighbors have taken
already: nothing closer than the distance to a neighbor's point is a candidate any more, and all these points count in
the order of choice. Blocks that are no neighbors work at the same time; the result does not depend on it.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.point_tree import PointTree
from pnu.geometry.spatial_blocks import Blocks, Index, split_blocks
from pnu.runtime.progress import Step, silent

BLOCK = 2**16  # points
SURPLUS = 1.006  # points to choose, of those wanted: the last ones are dropped for an exact count
CLOSE = 1.01  # a greater surplus is worth another try,
TRIES = 3  # of so many
MARGIN = 4  # distances around a block within which it sees its neighbors
PROBES = 48  # chosen points whose distance to those chosen before is looked up

Choose = Callable[[NDArray[np.float32], int], Index]
"""choose(points (n, 3), m) -> m farthest points from point 0 on, in the order of choice."""


class Decline(NamedTuple):
    """How the distance to all points chosen before falls with the number of points chosen."""

    number: NDArray[np.float64]  # ascending
    distance: NDArray[np.float64]  # not ascending
    most: int  # points there are

    def at(self, number: NDArray[np.int64]) -> NDArray[np.float64]:
        """The distance (k,) when so many points (k,) were chosen, interpolated."""
        return np.interp(number, self.number, self.distance)

    def before(self, distance: float) -> float:
        """Points chosen before the distance falls below `distance`; on, as on a surface, where no more were chosen."""
        if distance <= 0:
            return self.most
        if distance < self.distance[-1]:
            beyond: float = min(self.number[-1] * min(self.distance[-1] / distance, 1e6) ** 2, self.most)
            return beyond
        return float(np.interp(-distance, -self.distance, self.number))


def farthest_in_blocks(
    xyz: NDArray[np.float32],
    m: int,
    choose: Choose,
    *,
    threads: int = 1,
    size: int | None = None,
    step: Step = silent,
) -> Index:
    """m of the points (n, 3), as evenly spread as by `choose` from all at once, in about its order: (m,) indices.

    Time grows as the number of points, memory beyond the result with the blocks. `size`: points of a block.
    """
    n = len(xyz)
    blocks = split_blocks(xyz, size or BLOCK)
    wanted = min(SURPLUS * m, n)
    done, total = 0, 2 * len(blocks.members)
    step(0, total)

    def tick() -> None:
        nonlocal done
        done += 1
        step(done, total)

    with ThreadPoolExecutor(threads) as pool:

        def first(members: Index) -> Decline:
            number = min(int(1.1 * wanted * len(members) / n) + 16, len(members))
            return decline_of(xyz[members[choose(xyz[members], number)]], len(members))

        declines = []
        for decline in pool.map(first, blocks.members):
            declines.append(decline)
            tick()
        reach, power, before = _common_distance(declines, wanted), 2.0, (0.0, 0)
        for attempt in count():
            total = (2 + attempt) * len(blocks.members)
            chosen, distance = _choose_all(xyz, blocks, declines, reach, choose, pool, tick)
            surplus = len(chosen) / m
            if surplus >= 1 and (surplus <= CLOSE or attempt >= TRIES or len(chosen) == n):
                return chosen[np.argsort(-distance, kind="stable")[:m]]
            if attempt > TRIES or reach < 1e-9 * np.ptp(xyz, axis=0).max():
                reach = 0.0  # takes all
            else:
                # on a surface the number falls with the square of the distance, in a thick layer faster
                if before[1] not in (0, len(chosen)):
                    power = min(max(math.log(before[1] / len(chosen)) / math.log(reach / before[0]), 1.0), 6.0)
                before = reach, len(chosen)
                reach *= (len(chosen) / wanted) ** (1 / power)
    raise AssertionError


def _choose_all(
    xyz: NDArray[np.float32],
    blocks: Blocks,
    declines: list[Decline],
    reach: float,
    choose: Choose,
    pool: ThreadPoolExecutor,
    tick: Callable[[], None],
) -> tuple[Index, NDArray[np.float64]]:
    """All points chosen down to a distance, and how far each was from those chosen before it."""
    none = np.empty(0, np.int64)
    chosen = [none] * len(blocks.members)
    distance = [np.empty(0)] * len(blocks.members)
    margin = MARGIN * reach
    waiting = np.ones(len(xyz), bool)  # members of blocks whose turn is yet to come

    def work(number: int) -> tuple[Index, NDArray[np.float64]]:
        own = blocks.members[number]
        near = [chosen[other] for other in blocks.near(number, margin)]
        fixed = np.concatenate([none, *(idx[blocks.inside(xyz[idx], number, margin)] for idx in near)])
        halo = blocks.halo(xyz, number, margin)
        free = np.concatenate([own, halo[waiting[halo]]])
        if len(fixed):
            free = free[PointTree(xyz[fixed]).nearest(xyz[free], 1)[0][:, 0] >= reach]
        both = np.concatenate([fixed, free])
        if not len(free):
            return none, np.empty(0)
        share = declines[number].before(reach) / len(own)
        m = min(len(fixed) + int(1.02 * share * len(free)) + 16, len(both))
        while True:
            order = choose(xyz[both], m)
            decline = decline_of(xyz[both[order]], len(both))
            if m == len(both) or decline.distance[-1] < reach:
                break
            m = min(max(int(1.05 * decline.before(reach)), m + m // 20 + 16), len(both))
        order = order[: round(decline.before(reach))]
        mine = np.flatnonzero((order >= len(fixed)) & np.isin(both[order], own, assume_unique=True))
        idx = both[order[mine]]
        # near a border the distance may be one to a point that the neighbor will not choose: such points are kept
        seen = np.zeros(len(idx), bool)
        for other in blocks.near(number, margin):
            seen |= blocks.inside(xyz[idx], other, 2 * reach)
        return idx, np.where(seen, np.inf, decline.at(mine))

    for group in blocks.colors(margin):
        for number in group:
            waiting[blocks.members[number]] = False
        for number, (idx, far) in zip(group, pool.map(work, group), strict=True):
            chosen[number], distance[number] = idx, far
            tick()

    def fill(number: int) -> tuple[Index, NDArray[np.float64]]:
        """Holes at the borders, where a block relied on points of a neighbor's that were not chosen in the end."""
        own, near = blocks.members[number], blocks.near(number, margin)
        edge = np.zeros(len(own), bool)
        for other in near:
            edge |= blocks.inside(xyz[own], other, reach)
        free = own[edge]
        around = [idx[blocks.inside(xyz[idx], number, margin)] for idx in (chosen[other] for other in [number, *near])]
        taken = np.concatenate(around)
        if not len(free) or not len(taken):
            return none, np.empty(0)
        far = PointTree(xyz[taken]).nearest(xyz[free], 1)[0][:, 0]
        added, distances = [none], [np.empty(0)]
        while (far >= reach).any() and far.max() > 0:
            farthest = far.argmax()
            added.append(free[[farthest]])
            distances.append(np.array([np.inf]))
            far = np.minimum(far, np.linalg.norm(xyz[free] - xyz[free[farthest]], axis=1))
        return np.concatenate(added), np.concatenate(distances)

    for group in blocks.colors(margin):
        for number, (idx, far) in zip(group, pool.map(fill, group), strict=True):
            chosen[number] = np.concatenate([chosen[number], idx])
            distance[number] = np.concatenate([distance[number], far])
    return np.concatenate(chosen), np.concatenate(distance)


def decline_of(points: NDArray[np.floating], most: int) -> Decline:
    """From points in the order of choice."""
    m = len(points)
    probes = np.unique(np.linspace(m // 8, m - 1, PROBES).astype(np.int64))
    k = min(PROBES, m)
    far, idx = PointTree(points).nearest(points[probes], k)
    before = idx < probes[:, None]
    found = before.any(1)
    if not found.any():
        return Decline(np.array([1.0]), np.array([np.inf]), most)
    distance = np.take_along_axis(far, before.argmax(1)[:, None], 1)[found, 0]
    falling = np.asarray(np.minimum.accumulate(distance), np.float64)
    return Decline(np.asarray(probes[found] + 1.0, np.float64), falling, most)


def _common_distance(declines: list[Decline], wanted: float) -> float:
    """The distance down to which all blocks together choose about as many points as wanted."""
    if wanted >= sum(decline.most for decline in declines):
        return 0.0
    finite = [d.distance[np.isfinite(d.distance)] for d in declines]
    low, high = 0.0, max(float(d.max()) for d in finite if len(d))
    for _ in range(60):
        middle = (low + high) / 2
        if sum(decline.before(middle) for decline in declines) > wanted:
            low = middle
        else:
            high = middle
    return low
