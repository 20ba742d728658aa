"""Farthest points of one whole cloud, in NumPy: compiled, or by plain steps; large clouds block by block."""

import numpy as np
from numpy.typing import NDArray

from pnu import kernels
from pnu.geometry.farthest_blocks import farthest_in_blocks
from pnu.geometry.spatial_blocks import split_blocks
from pnu.runtime.progress import Step, silent
from pnu.runtime.threads import thread_count

LARGE = 2**20  # points; more are sampled in blocks,
LARGE_BLOCK: int | None = None  # of so many points, None the default of `farthest_blocks`,
LARGE_SHARE = 64  # unless so few are wanted that blocks would hold too few of them
BLOCKS_PAY = 2**14  # points from which on plain steps look at near blocks alone,
NEAR_BLOCK = 2**9  # of at most so many points


def farthest_points_large(points: NDArray[np.floating], m: int, *, step: Step = silent) -> NDArray[np.int64]:
    """`pnu.geometry.sampling.farthest_points` from point 0 of one whole cloud (n, 3): idx (m,), exactly m, all
    different.

    Beyond LARGE points it works block by block (`farthest_blocks`), as evenly but from another point on, in time
    linear in n. ValueError if m is not in 1..n.
    """
    check_count(m, len(points))
    if len(points) <= LARGE or m < len(points) // LARGE_SHARE:
        step(0, 1)
        chosen = farthest_order(single_precision(points), m, 0)
        step(1, 1)
        return chosen
    threads = thread_count()
    return farthest_in_blocks(single_precision(points), m, farthest_apart, threads=threads, size=LARGE_BLOCK, step=step)


def thinned_to(points: NDArray[np.float64], distance: float) -> NDArray[np.int64]:
    """Rows of those of the points (n, 3), ascending, that farthest points take down to a distance between them."""
    single, few = single_precision(points), min(len(points), 16)
    order, _ = farthest_apart(single, len(points), least=distance)
    return np.sort(order if len(order) >= few else farthest_order(single, few, 0))


def single_precision(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Points (n, 3), those in float64 about their mean: map coordinates, say, lose their detail in float32."""
    points = np.asarray(points)
    return np.ascontiguousarray(points - points.mean(0) if points.dtype == np.float64 else points, np.float32)


def check_count(m: int, n: int) -> None:
    """ValueError where m points of n cannot be chosen."""
    if not 1 <= m <= n:
        raise ValueError(f"m: expected 1 to {n} points (the size of the cloud), found {m}")


def farthest_order(xyz: NDArray[np.float32], m: int, start: int) -> NDArray[np.int64]:
    """m farthest points of (n, 3) from `start` on, in the order of choice, (m,)."""
    return farthest_apart(xyz, m, start=start)[0]


def farthest_apart(
    xyz: NDArray[np.float32], m: int, *, start: int = 0, given: int = 0, least: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Farthest points of (n, 3) in the order of choice, and how far each is from all chosen before: (k,) and (k,).

    The first `given` points are chosen already, else `start` is first; their distance is infinite. It ends with m
    points, or where none is at least `least` away from those chosen. Of equal distances the lowest index, so that all
    three ways give the same.
    """
    if not np.isfinite(xyz).all():  # as in a training that breaks, which is told elsewhere
        with np.errstate(invalid="ignore"):
            return _farthest_plain(xyz, m, start, given, least)
    if kernels.ready():
        from pnu.kernels.greedy_sampling import farthest_first

        return farthest_first(xyz, m, start, given, least)
    return (_farthest_near if len(xyz) > BLOCKS_PAY else _farthest_plain)(xyz, m, start, given, least)


def _farthest_plain(
    xyz: NDArray[np.float32], m: int, start: int, given: int = 0, least: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    axes, step = np.ascontiguousarray(xyz.T), np.empty_like(xyz.T, order="C")
    dist_sq, least_sq = np.full(len(xyz), np.inf, np.float32), np.float32(least) ** 2
    chosen, apart_sq = np.empty(m, np.int64), np.full(m, np.inf, np.float32)
    count = 0
    for i in range(m):
        if i < given:
            start = i
        elif i:
            start = int(dist_sq.argmax())
            apart_sq[i] = dist_sq[start]
            if apart_sq[i] < least_sq:
                break
        chosen[i], count = start, i + 1
        np.subtract(axes, axes[:, start, None], out=step)
        np.multiply(step, step, out=step)
        np.minimum(dist_sq, step.sum(0), out=dist_sq)
        dist_sq[start] = -1
    return chosen[:count], np.sqrt(apart_sq[:count])


def _farthest_near(
    xyz: NDArray[np.float32], m: int, start: int, given: int = 0, least: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The same with a look at those blocks alone that are nearer than their farthest point is to all chosen before."""
    blocks = split_blocks(xyz, NEAR_BLOCK)
    number, size = len(blocks.members), max(len(part) for part in blocks.members)
    dist_sq, ids = np.full((number, size), -2, np.float32), np.full((number, size), len(xyz))
    axes, home = np.zeros((number, 3, size), np.float32), np.empty((len(xyz), 2), np.int64)
    for row, part in enumerate(blocks.members):
        dist_sq[row, : len(part)], ids[row, : len(part)], axes[row, :, : len(part)] = np.inf, part, xyz[part].T
        home[part, 0], home[part, 1] = row, np.arange(len(part))
    low, high = (np.ascontiguousarray(corners.T, np.float32) for corners in (blocks.low, blocks.high))
    best, best_id = dist_sq.max(1), ids[:, 0].copy()
    chosen, apart_sq = np.empty(m, np.int64), np.full(m, np.inf, np.float32)
    least_sq, count = np.float32(least) ** 2, 0
    for i in range(m):
        if i < given:
            start = i
        elif i:
            apart_sq[i] = best.max()
            start = int(best_id[best == apart_sq[i]].min())
            if apart_sq[i] < least_sq:
                break
        chosen[i], count = start, i + 1
        place, own = xyz[start, :, None], home[start, 0]
        apart = np.maximum(np.maximum(low - place, place - high), 0)
        near = (apart * apart).sum(0) < best
        near[own] = True
        rows = near.nonzero()[0]
        step = axes[rows] - place
        part = np.minimum(dist_sq[rows], (step * step).sum(1))
        part[np.searchsorted(rows, own), home[start, 1]] = -1
        dist_sq[rows] = part
        farthest = part.argmax(1)
        best[rows], best_id[rows] = part[np.arange(len(rows)), farthest], ids[rows, farthest]
    return chosen[:count], np.sqrt(apart_sq[:count])
