"""Farthest points of a large cloud block by block, without borders between the blocks.

Farthest points are a packing: those chosen last are about as far from the others all over the cloud. So blocks agree on
that distance first. Then each block takes farthest points down to it, beginning with what its neighbors have taken
already: nothing closer than the distance to a neighbor's point is a candidate any more, and all these points count in
the order of choice. Blocks that are no neighbors work at the same time; the result does not depend on it.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import count
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.spatial_blocks import Blocks, Index, split_blocks
from pnu.runtime.progress import Step, silent

BLOCK = 2**16  # points
SURPLUS = 1.01  # points to choose, of those wanted: the last ones are dropped for an exact count
CLOSE = 1.02  # a greater surplus is worth another try,
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
    of_block = np.concatenate(blocks.members)  # points in the order of the blocks
    xyz, blocks = xyz.take(of_block, 0), blocks.in_a_row()
    wanted = min(SURPLUS * m, n)
    done, total = 0, 2 * len(blocks.members)
    step(0, total)

    def tick() -> None:
        nonlocal done
        done += 1
        step(done, total)

    with ThreadPoolExecutor(threads) as pool:

        def alone(members: Index, share: float) -> Decline:
            number = min(int(share * len(members)) + 16, len(members))
            return decline_of(choose(xyz.take(members, 0), number)[1], len(members))

        declines = []
        for decline in pool.map(partial(alone, share=1.1 * wanted / n), blocks.members):
            declines.append(decline)
            tick()
        reach = _common_distance(declines, wanted)
        # a sparse block gives more than its share: how many is to be seen, not guessed
        sparse = [i for i, d in enumerate(declines) if d.distance[-1] > reach and d.number[-1] < d.most]
        full = pool.map(partial(alone, share=1.0), [blocks.members[number] for number in sparse])
        for number, decline in zip(sparse, full, strict=True):
            declines[number] = decline
        asked = wanted
        for attempt in count():
            reach = _common_distance(declines, asked) if attempt <= TRIES + 1 else 0.0  # 0 takes all
            total = (2 + attempt) * len(blocks.members)
            chosen, distance = _choose_all(xyz, blocks, reach, choose, pool, tick)
            surplus = len(chosen) / m
            if surplus >= 1 and (surplus <= CLOSE or attempt >= TRIES or len(chosen) == n):
                return of_block[chosen[np.argsort(-distance, kind="stable")[:m]]].astype(np.int64)
            asked *= wanted / len(chosen)
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
    free = np.ones(len(xyz), bool)  # points not chosen

    def work(number: int) -> tuple[Index, NDArray[np.float64]]:
        own = blocks.members[number]
        near = [chosen[other] for other in blocks.near(number, margin)]
        fixed = np.concatenate([none, *(idx[blocks.inside(xyz.take(idx, 0), number, margin)] for idx in near)])
        halo = blocks.halo(xyz, number, margin)
        both = np.concatenate([fixed, own, halo[waiting[halo]]])
        order, far = choose(xyz.take(both, 0), len(both), given=len(fixed), least=reach)
        mine = (order >= len(fixed)) & (order < len(fixed) + len(own))
        idx = both[order[mine]]
        # near a border the distance may be one to a point that the neighbor will not choose: such points are kept
        seen, places = np.zeros(len(idx), bool), xyz.take(idx, 0)
        for other in blocks.near(number, margin):
            seen |= blocks.inside(places, other, 2 * reach)
        return idx, np.where(seen, np.inf, far[mine])

    for group in blocks.colors(margin):
        for number in group:
            waiting[blocks.members[number]] = False
        for number, (idx, far) in zip(group, pool.map(work, group), strict=True):
            chosen[number], distance[number] = idx, far
            free[idx] = False
            tick()

    def fill(number: int) -> tuple[Index, NDArray[np.float64]]:
        """Holes at the borders, where a block relied on points of a neighbor's that were not chosen in the end."""
        own, mine, near = blocks.members[number], chosen[number], blocks.near(number, margin)
        own = own[free[own]]
        edge, beside = np.zeros(len(own), bool), np.zeros(len(mine), bool)
        own_places, places = xyz.take(own, 0), xyz.take(mine, 0)
        for other in near:
            edge |= blocks.inside(own_places, other, reach)
            beside |= blocks.inside(places, other, 2 * reach)
        theirs = [chosen[other][blocks.inside(xyz.take(chosen[other], 0), number, reach)] for other in near]
        taken, left = np.concatenate([mine[beside], *theirs]), own[edge]
        if not len(left) or not len(taken):
            return none, np.empty(0)
        both = np.concatenate([taken, left])
        order, _ = choose(xyz.take(both, 0), len(both), given=len(taken), least=reach)
        added = both[order[len(taken) :]]
        return added, np.full(len(added), np.inf)

    for group in blocks.colors(margin):
        for number, (idx, far) in zip(group, pool.map(fill, group), strict=True):
            free[idx] = False
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
