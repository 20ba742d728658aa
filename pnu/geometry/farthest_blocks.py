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
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.spatial_blocks import Blocks, Index, split_blocks
from pnu.runtime.progress import Step, silent

BLOCK = 2**16  # points
SURPLUS = 1.006  # points to choose, of those wanted: the last ones are dropped for an exact count
CLOSE = 1.01  # a greater surplus is worth another try,
TRIES = 3  # of so many
MARGIN = 4  # distances around a block within which it sees its neighbors
PROBES = 48  # chosen points whose distance to those chosen before is looked up

Apart = NDArray[np.float32]


class Choose(Protocol):
    """`pnu.geometry.farthest_sampling.farthest_apart`."""

    def __call__(
        self, xyz: NDArray[np.float32], m: int, *, given: int = 0, least: float = 0.0
    ) -> tuple[Index, Apart]: ...


class Decline(NamedTuple):
    """How the distance to all points chosen before falls with the number of points chosen."""

    number: NDArray[np.float64]  # ascending
    distance: NDArray[np.float64]  # not ascending
    most: int  # points there are

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
            return decline_of(choose(xyz[members], number)[1], len(members))

        declines = []
        for decline in pool.map(first, blocks.members):
            declines.append(decline)
            tick()
        reach, power, before = _common_distance(declines, wanted), 2.0, (0.0, 0)
        for attempt in count():
            total = (2 + attempt) * len(blocks.members)
            chosen, distance = _choose_all(xyz, blocks, reach, choose, pool, tick)
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
        both = np.concatenate([fixed, own, halo[waiting[halo]]])
        order, far = choose(xyz[both], len(both), given=len(fixed), least=reach)
        mine = (order >= len(fixed)) & (order < len(fixed) + len(own))
        idx = both[order[mine]]
        # near a border the distance may be one to a point that the neighbor will not choose: such points are kept
        seen = np.zeros(len(idx), bool)
        for other in blocks.near(number, margin):
            seen |= blocks.inside(xyz[idx], other, 2 * reach)
        return idx, np.where(seen, np.inf, far[mine])

    for group in blocks.colors(margin):
        for number in group:
            waiting[blocks.members[number]] = False
        for number, (idx, far) in zip(group, pool.map(work, group), strict=True):
            chosen[number], distance[number] = idx, far
            tick()

    def fill(number: int) -> tuple[Index, NDArray[np.float64]]:
        """Holes at the borders, where a block relied on points of a neighbor's that were not chosen in the end."""
        own, mine, near = blocks.members[number], chosen[number], blocks.near(number, margin)
        edge, beside = np.zeros(len(own), bool), np.zeros(len(mine), bool)
        for other in near:
            edge |= blocks.inside(xyz[own], other, reach)
            beside |= blocks.inside(xyz[mine], other, 2 * reach)
        theirs = [chosen[other][blocks.inside(xyz[chosen[other]], number, reach)] for other in near]
        taken, free = np.concatenate([mine[beside], *theirs]), np.setdiff1d(own[edge], mine)
        if not len(free) or not len(taken):
            return none, np.empty(0)
        both = np.concatenate([taken, free])
        order, _ = choose(xyz[both], len(both), given=len(taken), least=reach)
        added = both[order[len(taken) :]]
        return added, np.full(len(added), np.inf)

    for group in blocks.colors(margin):
        for number, (idx, far) in zip(group, pool.map(fill, group), strict=True):
            chosen[number] = np.concatenate([chosen[number], idx])
            distance[number] = np.concatenate([distance[number], far])
    return np.concatenate(chosen), np.concatenate(distance)


def decline_of(apart: Apart, most: int) -> Decline:
    """From the distances (m,) of points from all chosen before them, in the order of choice."""
    m = len(apart)
    if m == 1:
        return Decline(np.array([1.0]), np.array([np.inf]), most)
    probes = np.unique(np.linspace(max(m // 8, 1), m - 1, PROBES).astype(np.int64))
    return Decline(probes.astype(np.float64) + 1, apart[probes].astype(np.float64), most)


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
