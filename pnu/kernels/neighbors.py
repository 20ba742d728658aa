"""The k nearest points of a cloud, exact in float64, on a tree of boxes with eight children each.

Queries that lie together, as they come along a curve, share what lies around all of them, in a radius by what the last
one needed; where that was too small, each collects all points within a radius of its own. What a search gives depends
on neither: neighbors come by distance, equal ones by their index.
"""

import numpy as np
from numpy.typing import NDArray

from pnu.kernels.boxes import Floats, Ints, box_order
from pnu.kernels.compilation import kernel

LEAF = 16  # points
CHILDREN = 8
NOWHERE = 1e150  # places of points and boxes that are not there; its square is finite
FAR = 1e305  # farther than any point, squared
MORE = 3.0  # / sqrt(k): by that share more than the squared radius in which the query before found its neighbors
ROOM = 8  # times k, at most, are collected before those too far are dropped
TOGETHER = 8  # queries that share what lies around them,
SPREAD = 20.0  # if none is farther from their middle, squared, than so many squared radii of the last one,
CROWD = 512  # and if there are fewer points
ROUNDS = 40  # of narrowing down which points are the k nearest
TINY = 1e-280  # squared radii below which rounding is no longer small
ROUNDING = 1e-9  # of distances, far more than there is


class NeighborTree:
    """A cloud (n, 3), n >= 1, made ready for searches."""

    def __init__(self, points: NDArray[np.floating]) -> None:
        places: Floats = np.require(points, np.float64, ["C", "W", "A"])
        self.order = box_order(places, LEAF)  # of the points, in which neighbors come soon after each other
        leaves = -(-len(places) // LEAF)
        levels, nodes = [0], leaves
        while nodes > 1 or len(levels) == 1:
            nodes = -(-nodes // CHILDREN)
            levels.append(levels[-1] + nodes)
        axes, ids = np.full((3, leaves * LEAF), NOWHERE), np.zeros(leaves * LEAF, np.int64)
        boxes = np.empty((levels[-1], 6, CHILDREN))
        boxes[:, :3], boxes[:, 3:] = NOWHERE, -NOWHERE
        self.parts = places, axes, ids, boxes, np.array(levels, np.int64)
        _fill_tree(places, self.order, *self.parts[1:])

    def search(self, queries: NDArray[np.floating], idx: Ints, dist_sq: Floats) -> None:
        """The k <= n nearest points of each query (m, 3): into `idx[i, j]` the j-th nearest of query i, and their
        squared distances, both (m, k). Fast where each query is near the one before (`box_order`)."""
        _search(np.require(queries, np.float64, ["C", "W", "A"]), idx.shape[1], *self.parts, idx, dist_sq)


@kernel("void(float64[:, ::1], int64[::1], float64[:, ::1], int64[::1], float64[:, :, ::1], int64[::1])", exact=True)
def _fill_tree(points: Floats, order: Ints, axes: Floats, ids: Ints, boxes: Floats, levels: Ints) -> None:
    """Coordinates (3, leaves x LEAF) in order; their indices; children's boxes (groups, 6, CHILDREN), low and high
    corners; the first group of each level, that of leaves first, and the end."""
    n = len(points)
    for i in range(n):
        ids[i] = order[i]
        for axis in range(3):
            axes[axis, i] = points[order[i], axis]
    for i in range(n):
        leaf = i // LEAF
        box = boxes[leaf // CHILDREN]
        child = leaf % CHILDREN
        for axis in range(3):
            box[axis, child] = min(box[axis, child], axes[axis, i])
            box[3 + axis, child] = max(box[3 + axis, child], axes[axis, i])
    for level in range(1, len(levels) - 1):
        for group in range(levels[level] - levels[level - 1]):
            box, below = boxes[levels[level] + group // CHILDREN], boxes[levels[level - 1] + group]
            for axis in range(3):
                for child in range(CHILDREN):
                    low, high = below[axis, child], below[3 + axis, child]
                    box[axis, group % CHILDREN] = min(box[axis, group % CHILDREN], low)
                    box[3 + axis, group % CHILDREN] = max(box[3 + axis, group % CHILDREN], high)


@kernel(exact=True, inner=True)
def _before(a: float, i: int, b: float, j: int) -> bool:
    return a < b or (a == b and i < j)


@kernel(exact=True, inner=True)
def _keep_nearest(dist: Floats, ids: Ints, count: int, k: int) -> None:
    """Bring the k nearest of `count` points to the front, in any order (Hoare's selection)."""
    low, high = 0, count - 1
    cut = k - 1
    while low < high:
        middle = (low + high) // 2
        pivot, pivot_id = dist[middle], ids[middle]
        i, j = low, high
        while i <= j:
            while _before(dist[i], ids[i], pivot, pivot_id):
                i += 1
            while _before(pivot, pivot_id, dist[j], ids[j]):
                j -= 1
            if i <= j:
                dist[i], dist[j] = dist[j], dist[i]
                ids[i], ids[j] = ids[j], ids[i]
                i += 1
                j -= 1
        if cut <= j:
            high = j
        elif cut >= i:
            low = i
        else:
            break


@kernel(exact=True, inner=True)
def _farthest(dist: Floats, k: int) -> float:
    limit = dist[0]
    for i in range(1, k):
        limit = max(limit, dist[i])
    return limit


@kernel(exact=True, inner=True)
def _sift(dist: Floats, ids: Ints, count: int, k: int, guess: float) -> int:
    """Bring the k nearest of `count` points to the front, in any order, and with them some that are as far as the last.

    By regula falsi over the radius: the number of points in it grows about as its square, where they lie on a surface.
    Returns how many there are.
    """
    low, high, within, inside, limit = 0.0, FAR, 0, count, guess
    for number in range(ROUNDS):
        if inside == k:
            break
        nearer = 0
        for i in range(count):
            nearer += dist[i] <= limit
        if nearer < k:
            low, within = limit, nearer
        else:
            high, inside = limit, nearer
        if high == FAR:
            limit *= 2
        elif number % 3 == 2:
            limit = 0.5 * (low + high)
        else:
            limit = low + (high - low) * ((k - within) / (inside - within))
        if not low < limit < high:
            break
    kept = 0
    for i in range(count):
        near, index = dist[i], ids[i]
        dist[kept], ids[kept] = near, index
        kept += near <= high
    return kept


@kernel(exact=True, inner=True)
def _put_in_order(dist: Floats, ids: Ints, ranks: Ints, count: int, guess: float, idx: Ints, dist_sq: Floats) -> None:
    """The nearest of `count` points, by distance and then by index, as many as idx (k,) and dist_sq (k,) hold.

    guess: of the squared distance of the last of them.
    """
    k = len(idx)
    count = _sift(dist, ids, count, k, guess)
    if count > 2 * k + LEAF:
        _keep_nearest(dist, ids, count, k)
        count = k
    total = 0
    for i in range(count):
        rank = 0
        for j in range(count):
            rank += dist[j] < dist[i]
        ranks[i] = rank
        total += rank
    if 2 * total < count * (count - 1):  # some are equally far
        for i in range(count):
            for j in range(count):
                ranks[i] += (dist[j] == dist[i]) & (ids[j] < ids[i])
    for i in range(count):
        if ranks[i] < k:
            idx[ranks[i]], dist_sq[ranks[i]] = ids[i], dist[i]


@kernel(exact=True, inner=True)
def _to_boxes(x: float, y: float, z: float, box: Floats, far: Floats) -> None:
    """Squared distances (CHILDREN,) of a place to boxes (6, CHILDREN)."""
    for child in range(CHILDREN):
        dx = max(max(box[0, child] - x, x - box[3, child]), 0.0)
        dy = max(max(box[1, child] - y, y - box[4, child]), 0.0)
        dz = max(max(box[2, child] - z, z - box[5, child]), 0.0)
        far[child] = dx * dx + dy * dy + dz * dz


@kernel(exact=True, inner=True)
def _enough(
    x: float,
    y: float,
    z: float,
    k: int,
    n: int,
    axes: Floats,
    boxes: Floats,
    levels: Ints,
    far: Floats,
    dist: Floats,
    found: Ints,
) -> float:
    """A squared radius in which there are k points: those of the smallest node near the place that has so many."""
    level, group, size = len(levels) - 2, 0, LEAF * CHILDREN ** (len(levels) - 1)
    first, stop = 0, n
    while level >= 0:
        _to_boxes(x, y, z, boxes[levels[level] + group], far)
        child = 0
        for other in range(1, CHILDREN):
            if far[other] < far[child]:
                child = other
        size //= CHILDREN
        group = group * CHILDREN + child
        if min((group + 1) * size, n) - group * size < k:
            break
        first, stop = group * size, min((group + 1) * size, n)
        level -= 1
    if stop - first > len(dist):
        stop = first + len(dist)
    for i in range(first, stop):
        dx, dy, dz = axes[0, i] - x, axes[1, i] - y, axes[2, i] - z
        dist[i - first] = dx * dx + dy * dy + dz * dz
        found[i - first] = i
    _keep_nearest(dist, found, stop - first, k)
    return _farthest(dist, k)


@kernel(exact=True, inner=True)
def _within(
    x: float, y: float, z: float, limit: float, k: int, axes: Floats, ids: Ints, boxes: Floats, levels: Ints,
    far: Floats, stack: Ints, dist: Floats, found: Ints,
) -> int:  # fmt: skip
    """Points within a squared radius, in any order, without some of those that cannot be among the k nearest.

    Of very many at the place of the query the first k that come; -1 where that was found out later than from a radius
    of zero on, in which case the search begins anew from there: so those that come first are always the same.
    """
    count, depth, begun = 0, 1, limit
    stack[0, 0], stack[0, 1] = len(levels) - 2, 0
    while depth:
        depth -= 1
        level, group = stack[depth]
        _to_boxes(x, y, z, boxes[levels[level] + group], far)
        for child in range(CHILDREN):
            if far[child] > limit:
                continue
            below = group * CHILDREN + child
            if level:
                stack[depth, 0], stack[depth, 1] = level - 1, below
                depth += 1
                continue
            first = below * LEAF
            for i in range(LEAF):
                dx, dy, dz = axes[0, first + i] - x, axes[1, first + i] - y, axes[2, first + i] - z
                dist[count + i] = dx * dx + dy * dy + dz * dz
            start = count
            for i in range(LEAF):
                near = dist[start + i]
                dist[count], found[count] = near, ids[first + i]
                count += near <= limit
            if count + LEAF > len(found):
                _keep_nearest(dist, found, count, k)
                count, limit = k, _farthest(dist, k)
                if limit == 0:  # no other can be nearer
                    return k if begun == 0 else -1
    return count


@kernel(exact=True, inner=True)
def _middle(queries: Floats, first: int, stop: int, middle: Floats) -> float:
    """The mean of some queries -> middle (3,), and the largest squared distance of one from it."""
    widest = 0.0
    for axis in range(3):
        total = 0.0
        for q in range(first, stop):
            total += queries[q, axis]
        middle[axis] = total / (stop - first)
    for q in range(first, stop):
        dx, dy, dz = queries[q, 0] - middle[0], queries[q, 1] - middle[1], queries[q, 2] - middle[2]
        widest = max(widest, dx * dx + dy * dy + dz * dz)
    return widest


@kernel(
    "void(float64[:, ::1], int64, float64[:, ::1], float64[:, ::1], int64[::1], float64[:, :, ::1], int64[::1],"
    " int64[:, ::1], float64[:, ::1])",
    exact=True,
)
def _search(
    queries: Floats, k: int, points: Floats, axes: Floats, ids: Ints, boxes: Floats, levels: Ints,
    idx: Ints, dist_sq: Floats,
) -> None:  # fmt: skip
    """See `NeighborTree.search`."""
    n = len(ids)
    while n and axes[0, n - 1] == NOWHERE:
        n -= 1
    room = max(ROOM * k + 4 * LEAF * CHILDREN, 2 * CROWD)
    dist, found, ranks = np.empty(room), np.empty(room, np.int64), np.empty(room, np.int64)
    nearby = np.empty(max(room, CHILDREN * k + LEAF * CHILDREN))
    nearby_ids = np.empty(len(nearby), np.int64)
    far, stack = np.empty(CHILDREN), np.empty((24 * CHILDREN, 2), np.int64)
    crowd, crowd_ids, middle = np.empty((3, CROWD)), np.empty(2 * CROWD, np.int64), np.empty(3)
    limit, grow, around, reach = -1.0, 1 + MORE / np.sqrt(k), 0, 0.0
    for q in range(len(queries)):
        x, y, z = queries[q]
        if q % TOGETHER == 0:
            widest, around = _middle(queries, q, min(q + TOGETHER, len(queries)), middle), 0
            if limit > TINY and widest < SPREAD * limit:
                reach = np.sqrt(widest) + np.sqrt(limit * grow)
                around = _within(
                    middle[0],
                    middle[1],
                    middle[2],
                    reach * reach,
                    CROWD,
                    axes,
                    ids,
                    boxes,
                    levels,
                    far,
                    stack,
                    dist,
                    crowd_ids,
                )
                if around >= CROWD:  # some may have been dropped
                    around = 0
                for i in range(around):
                    for axis in range(3):
                        crowd[axis, i] = points[crowd_ids[i], axis]
        if around >= k:
            for i in range(around):
                dx, dy, dz = crowd[0, i] - x, crowd[1, i] - y, crowd[2, i] - z
                dist[i], found[i] = dx * dx + dy * dy + dz * dz, crowd_ids[i]
            _put_in_order(dist, found, ranks, around, limit, idx[q], dist_sq[q])
            dx, dy, dz = x - middle[0], y - middle[1], z - middle[2]
            sure = (1 - ROUNDING) * reach - np.sqrt(dx * dx + dy * dy + dz * dz)  # so near all points are in the crowd
            if sure > 0 and dist_sq[q, k - 1] < sure * sure:
                limit = dist_sq[q, k - 1]
                continue
        count = 0
        if limit >= 0:
            count = _within(x, y, z, limit * grow, k, axes, ids, boxes, levels, far, stack, dist, found)
        if 0 <= count < k:
            limit = _enough(x, y, z, k, n, axes, boxes, levels, far, nearby, nearby_ids)
            count = _within(x, y, z, limit, k, axes, ids, boxes, levels, far, stack, dist, found)
        if count < 0:
            count = _within(x, y, z, 0.0, k, axes, ids, boxes, levels, far, stack, dist, found)
        _put_in_order(dist, found, ranks, count, limit, idx[q], dist_sq[q])
        limit = dist_sq[q, k - 1]
