"""Farthest point sampling, exact, over a binary tree of boxes whose nodes know their farthest point.

A point that is chosen changes the distances of those around it alone: only leaves nearer to it than their farthest
point is to all chosen before are looked at. Distances are those of float32 additions as they are written, and of equal
ones the lowest index is taken: the indices are the same as by plain steps over all points.
"""

import numpy as np
from numpy.typing import NDArray

from pnu.kernels.boxes import Ints, box_order
from pnu.kernels.compilation import kernel

LEAF = 64  # points
Singles = NDArray[np.float32]
f32 = np.float32
UNKNOWN, CHOSEN, NO_POINT = f32(1e30), f32(-1), f32(-2)  # instead of the squared distance to the chosen points
OUTSIDE = f32(1e18)  # corners of empty boxes; its square is finite


def farthest_first(
    points: NDArray[np.float32], m: int, start: int, given: int = 0, least: float = 0.0
) -> tuple[Ints, NDArray[np.float32]]:
    """`pnu.geometry.farthest_sampling.farthest_apart` of points (n, 3), m <= n: indices (k,) and distances (k,)."""
    points = np.require(points, np.float32, ["C", "W", "A"])
    chosen, apart_sq = np.empty(m, np.int64), np.full(m, np.inf, np.float32)
    least_sq, count = np.full(1, least, np.float32) ** 2, np.zeros(1, np.int64)
    _choose(points, box_order(points.astype(np.float64), LEAF), start, given, least_sq, chosen, apart_sq, count)
    return chosen[: count[0]], np.sqrt(apart_sq[: count[0]])


@kernel(exact=True, inner=True)
def _to_box(x: np.float32, y: np.float32, z: np.float32, box: Singles) -> np.float32:
    """Squared distance to a box (6,); rounded as it is to points, so never greater than that to a point in it."""
    dx = max(max(box[0] - x, x - box[3]), f32(0))
    dy = max(max(box[1] - y, y - box[4]), f32(0))
    dz = max(max(box[2] - z, z - box[5]), f32(0))
    return dx * dx + dy * dy + dz * dz


@kernel(exact=True, inner=True)
def _look(
    x: np.float32, y: np.float32, z: np.float32, leaf: int, axes: Singles, dist: Singles, ids: Ints,
    best: Singles, best_id: Ints, node: int,
) -> None:  # fmt: skip
    """Distances in a leaf after a point was chosen, and its farthest point into its node."""
    first = leaf * LEAF
    most = NO_POINT
    for i in range(first, first + LEAF):
        dx, dy, dz = axes[0, i] - x, axes[1, i] - y, axes[2, i] - z
        nearer = min(dist[i], dx * dx + dy * dy + dz * dz)
        dist[i] = nearer
        most = max(most, nearer)
    i = first
    while dist[i] != most:
        i += 1
    best[node], best_id[node] = most, ids[i]


@kernel(exact=True, inner=True)
def _join(best: Singles, best_id: Ints, node: int) -> None:
    """The farthest point of a node from those of its children."""
    left, right = 2 * node, 2 * node + 1
    if best[right] > best[left] or (best[right] == best[left] and best_id[right] < best_id[left]):
        left = right
    best[node], best_id[node] = best[left], best_id[left]


@kernel(
    "void(float32[:, ::1], int64[::1], int64, int64, float32[::1], int64[::1], float32[::1], int64[::1])", exact=True
)
def _choose(
    points: Singles, order: Ints, start: int, given: int, least_sq: Singles, chosen: Ints, apart_sq: Singles,
    count: Ints,
) -> None:  # fmt: skip
    """See `farthest_first`; order: of boxes, in leaves of LEAF points."""
    n = len(points)
    filled = (n + LEAF - 1) // LEAF
    leaves = 1
    while leaves < filled:
        leaves *= 2
    axes, dist = np.zeros((3, filled * LEAF), np.float32), np.full(filled * LEAF, NO_POINT)
    ids, position = np.full(filled * LEAF, n), np.empty(n, np.int64)
    box, best = np.empty((2 * leaves, 6), np.float32), np.full(2 * leaves, NO_POINT)
    best_id = np.full(2 * leaves, n)
    box[:, :3], box[:, 3:] = OUTSIDE, -OUTSIDE
    for leaf in range(filled):
        first, stop = leaf * LEAF, min(leaf * LEAF + LEAF, n)
        for i in range(first, stop):
            at = i
            while at > first and ids[at - 1] > order[i]:
                ids[at] = ids[at - 1]
                at -= 1
            ids[at] = order[i]
        corners = box[leaves + leaf]
        for i in range(first, stop):
            position[ids[i]], dist[i] = i, UNKNOWN
            for axis in range(3):
                axes[axis, i] = points[ids[i], axis]
                corners[axis] = min(corners[axis], axes[axis, i])
                corners[3 + axis] = max(corners[3 + axis], axes[axis, i])
        best[leaves + leaf], best_id[leaves + leaf] = UNKNOWN, ids[first]
    for node in range(leaves - 1, 0, -1):
        for axis in range(3):
            box[node, axis] = min(box[2 * node, axis], box[2 * node + 1, axis])
            box[node, 3 + axis] = max(box[2 * node, 3 + axis], box[2 * node + 1, 3 + axis])
        _join(best, best_id, node)
    passed, waiting = np.empty(2 * leaves, np.int64), np.empty(128, np.int64)
    current = start
    for step in range(len(chosen)):
        if step < given:
            current = step
        elif step:
            current = best_id[1]
            apart_sq[step] = best[1]
            if best[1] < least_sq[0]:
                break
        chosen[step] = current
        count[0] = step + 1
        at = position[current]
        x, y, z = axes[0, at], axes[1, at], axes[2, at]
        dist[at] = CHOSEN
        home = leaves + at // LEAF
        _look(x, y, z, home - leaves, axes, dist, ids, best, best_id, home)
        number, depth = 0, 1
        waiting[0] = 1
        while depth:
            depth -= 1
            node = waiting[depth]
            if node >= leaves:
                if node != home:
                    _look(x, y, z, node - leaves, axes, dist, ids, best, best_id, node)
                continue
            passed[number] = node
            number += 1
            for child in (2 * node, 2 * node + 1):
                if _to_box(x, y, z, box[child]) < best[child]:
                    waiting[depth] = child
                    depth += 1
        for i in range(number - 1, -1, -1):
            _join(best, best_id, passed[i])
        node = home // 2
        while node:
            _join(best, best_id, node)
            node //= 2
