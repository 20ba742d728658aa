"""Exact closest points of triangles: a tree of boxes, walked by all queries at once."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.kd_tree import kd_tree

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PAIRS = 2**20  # pairs of a query and a box held at once
LEAF = 4  # pieces in a box of the last level
PIECES = 20_000  # triangles are cut until there are about as many, so that no box is much larger than its surface


class Closest(NamedTuple):
    """Closest point, its distance, and the triangle that it lies on, of each query."""

    points: Array  # (m, 3)
    distance: Array  # (m,)
    triangle: Index  # (m,)


def closest_on_triangles(queries: Array, triangles: Array) -> Closest:
    """Closest points of triangles (f, 3, 3), f >= 1, to queries (m, 3). Triangles without area count as segments."""
    pieces, owner = _pieces(triangles)
    tree = _BoxTree.of(pieces)
    # the nearest centroids give a bound on the distance that is nearly tight
    few = min(3, len(owner))
    guess = owner[kd_tree(pieces.mean(1)).query(queries, k=np.arange(1, few + 1))[1]]
    best = _best(queries, triangles, np.repeat(np.arange(len(queries)), few), guess.ravel())
    todo = [part for part in np.split(np.arange(len(queries)), range(2**14, len(queries), 2**14)) if len(part)]
    while todo:
        part = todo.pop()
        pairs = tree.near(queries[part], best.distance[part])
        if pairs is None:
            todo += np.array_split(part, 2)
            continue
        query, piece = pairs
        found = _best(queries[part], triangles, query, owner[piece])
        closer = found.distance < best.distance[part]
        for old, new in zip(best, found, strict=True):
            old[part[closer]] = new[closer]
    return best


def closest_on_triangle(query: Array, triangle: Array) -> Array:
    """Closest point of each triangle (..., 3, 3) to query (..., 3): its plane's if inside, else its edges' best."""
    best, best_sq = triangle[..., 0, :], np.full(triangle.shape[:-2], np.inf)
    for i in range(3):
        start = triangle[..., i, :]
        edge = triangle[..., (i + 1) % 3, :] - start
        length_sq = _dot(edge, edge)
        along = _dot(query - start, edge) / np.where(length_sq > 0, length_sq, 1)
        point = start + along.clip(0, 1)[..., None] * edge
        dist_sq = _dot(query - point, query - point)
        closer = dist_sq < best_sq
        best, best_sq = np.where(closer[..., None], point, best), np.where(closer, dist_sq, best_sq)
    a = triangle[..., 0, :]
    ab, ac, aq = triangle[..., 1, :] - a, triangle[..., 2, :] - a, query - a
    normal = np.cross(ab, ac)
    norm_sq = _dot(normal, normal)
    safe = np.where(norm_sq > 0, norm_sq, 1)
    v, w = _dot(np.cross(aq, ac), normal) / safe, _dot(np.cross(ab, aq), normal) / safe
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (norm_sq > 0)
    foot = a + v[..., None] * ab + w[..., None] * ac
    # on slivers the division can lose its digits: the foot counts only where it is no worse than the edges
    inside &= _dot(query - foot, query - foot) <= best_sq
    return np.where(inside[..., None], foot, best)


def _dot(a: Array, b: Array) -> Array:
    product: Array = np.einsum("...i,...i", a, b)
    return product


def _best(queries: Array, triangles: Array, query: Index, candidate: Index) -> Closest:
    """Best of the candidate triangles of each query, by pairs; infinitely far where a query has none."""
    point = closest_on_triangle(queries[query], triangles[candidate])
    distance = np.linalg.norm(queries[query] - point, axis=1)
    order = np.lexsort((distance, query))
    first = order[np.unique(query[order], return_index=True)[1]]
    best = Closest(
        np.zeros((len(queries), 3)), np.full(len(queries), np.inf), np.zeros(len(queries), np.int64)
    )  # fmt: skip
    best.points[query[first]] = point[first]
    best.distance[query[first]] = distance[first]
    best.triangle[query[first]] = candidate[first]
    return best


class _BoxTree(NamedTuple):
    """Boxes of a full binary tree: level i has 2**i, the last one holds LEAF pieces each."""

    low: list[Array]
    high: list[Array]
    order: Index  # pieces by leaf; the last one is repeated to fill the last leaves
    piece_low: Array
    piece_high: Array

    @staticmethod
    def of(pieces: Array) -> "_BoxTree":
        depth = max(0, int(np.ceil(np.log2(len(pieces) / LEAF))))
        order = np.resize(np.arange(len(pieces)), LEAF * 2**depth)
        order[len(pieces) :] = len(pieces) - 1
        center = pieces.mean(1)
        for level in range(depth):  # halve each box at the median of its widest axis
            block = center[order].reshape(2**level, -1, 3)
            axis = np.ptp(block, axis=1).argmax(1)
            value = np.take_along_axis(block, axis[:, None, None], 2)[:, :, 0]
            half = np.argsort(value, axis=1, kind="stable")
            order = np.take_along_axis(order.reshape(2**level, -1), half, 1).ravel()
        low, high = pieces.min(1)[order], pieces.max(1)[order]
        lows, highs = [low.reshape(-1, LEAF, 3).min(1)], [high.reshape(-1, LEAF, 3).max(1)]
        for _ in range(depth):
            lows.append(lows[-1].reshape(-1, 2, 3).min(1))
            highs.append(highs[-1].reshape(-1, 2, 3).max(1))
        return _BoxTree(lows[::-1], highs[::-1], order, low, high)

    def near(self, queries: Array, reach: Array) -> tuple[Index, Index] | None:
        """Pairs (query, piece) whose box is nearer than `reach` (m,); None if too many and queries can be split."""
        query, box = np.arange(len(queries)), np.zeros(len(queries), np.int64)
        limit = reach**2

        def touching(query: Index, box: Index, low: Array, high: Array) -> tuple[Index, Index]:
            gap = np.maximum(np.maximum(low[box] - queries[query], queries[query] - high[box]), 0)
            kept = _dot(gap, gap) < limit[query]
            return query[kept], box[kept]

        for level, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            if level:
                query, box = np.repeat(query, 2), (2 * box[:, None] + np.arange(2)).ravel()
            if len(query) > PAIRS and len(queries) > 1:
                return None
            query, box = touching(query, box, low, high)
        if LEAF * len(query) > PAIRS and len(queries) > 1:
            return None
        query, slot = np.repeat(query, LEAF), (LEAF * box[:, None] + np.arange(LEAF)).ravel()
        query, slot = touching(query, slot, self.piece_low, self.piece_high)
        return query, self.order[slot]


def _pieces(triangles: Array) -> tuple[Array, Index]:
    """Triangles cut at their longest edge until all are small: corners (p, 3, 3) and the triangle of each."""
    corners, owner = triangles, np.arange(len(triangles))
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    extent = np.ptp(corners.reshape(-1, 3), axis=0).max()
    longest = max(3 * np.sqrt(area / max(2 * len(owner), PIECES)), extent / 100)
    done, done_owner = [], []
    while len(owner):
        edges = np.linalg.norm(corners - np.roll(corners, -1, 1), axis=2)
        fits = edges.max(1) <= longest
        done.append(corners[fits])
        done_owner.append(owner[fits])
        corners, owner, start = corners[~fits], owner[~fits], edges[~fits].argmax(1)
        turned = np.take_along_axis(corners, ((start[:, None] + np.arange(3)) % 3)[:, :, None], 1)
        a, b, c = turned[:, 0], turned[:, 1], turned[:, 2]
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        owner = np.concatenate([owner, owner])
    return np.concatenate(done), np.concatenate(done_owner)
