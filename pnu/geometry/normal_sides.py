"""The side that each normal looks to, chosen for axes that stay as they are.

*What is seen.* A sensor sees a surface from the front, so every axis that makes an angle with the way to the sensor
speaks for a side, the more the larger the angle. Neighbors on a surface speak for each other's: two dipoles on the same
side of a sheet, flat or bent, attract each other. Signs start from the clear points and follow the paths on which axes
turn least, or start as the lines came; then smooth pieces, and bodies of them, turn over while that satisfies more. Of
a single sensor it is not certain that it saw all: what is behind other points on its ray follows its neighbors alone.
From above, and from a camera whose pixels the points are, clear angles decide whatever the neighbors say. Assumed:
neighbors lie on the same sheet more often than not. Cost: n log n.

*What contradicts itself.* Of normals some of which are turned over, the field of `orientation` tells the sides, but for
walls thinner than their noise. There the given signs help as far as they are turned in patches: how often neighbors of
a turned point are turned too says how much each speaks for its neighbors (mean field of an Ising model).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pnu.geometry.connected_parts import connected_parts
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.orientation import SOME_NOISE, NeighborCloud, field, gauss_law, signs
from pnu.geometry.point_tree import PointTree

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

NEIGHBORS = 12
CLEAR = 0.5  # cosine between an axis and the way to the sensor from which on signs may start there
SEEN = 1.0  # how much the sensor speaks for a point, where each of its pairs speaks for 1
SURELY = 1e3  # as much for what is clear from above
SMOOTH, SLOPE = 0.8, 0.4  # pairs of one piece: cosine of their axes, and sine of the pair's with the tangent planes
HELD = 0.5  # balance of the pairs between two pieces of one body
TURNS = 40
DEEP = 1.0  # spacings behind the tangent planes of what is nearer on the same ray: not seen
COVERED = 1.5  # spacings around a point that hide what is behind
ALONG, ALIKE = 0.5, 0.5  # pairs whose signs can contradict: sine with the tangent planes, cosine of the axes
SURE = 2.0  # how sharply the field decides
ROUNDS = 30
LOOKED_FROM, LOOKED_AT = 48, 50_000  # of many places, and at points
MOST = 2 / 3  # of the given signs that decide the side of a closed shape too


class Couplings(NamedTuple):
    """Neighbors: pair p is of the points first[p] and second[p], each point's nearest 12."""

    first: np.ndarray  # (p,) int
    second: np.ndarray
    coupling: np.ndarray  # > 0: their axes, as they point, look to the same side of a surface through both
    cosine: np.ndarray  # of their axes
    rise: np.ndarray  # sine of the larger angle between the step from one to the other and the tangent planes

    @staticmethod
    def of(points: np.ndarray, lines: np.ndarray) -> Couplings:
        """The pairs of points (n, 3) with unit lines (n, 3)."""
        near = PointTree(points).among_themselves(min(NEIGHBORS + 1, len(points)))[1]
        first, second = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
        step = points[second] - points[first]
        step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300)
        here, there = (lines[first] * step).sum(1), (lines[second] * step).sum(1)
        cosine = (lines[first] * lines[second]).sum(1)
        coupling = np.clip(cosine - 3 * here * there, -1, 1)
        return Couplings(first, second, coupling, cosine, np.maximum(np.abs(here), np.abs(there)))


def seen_signs(
    points: np.ndarray,
    lines: np.ndarray,
    *,
    viewpoint: np.ndarray | None = None,
    up: np.ndarray | None = None,
    places: np.ndarray | None = None,
    surely: bool = False,
) -> np.ndarray:
    """+1 or -1 for each unit line (n, 3) at points (n, 3): the side that was seen, (n,).

    viewpoint: place of the sensor, (3,), or of each point's own, (n, 3), NaN where it is not known. up: (3,), the
    direction from which all was seen, as from the air. places: (k, 3), some of which saw each point. surely: no point
    hides another from the sensor. In a part of the cloud of which nothing is known, lines keep the side of most of
    their neighbors.
    """
    if places is not None:
        return voted_signs(points, lines, seen_from_some(points, lines, places))
    way = np.broadcast_to(np.asarray(up, np.float64), points.shape) if viewpoint is None else viewpoint - points
    with np.errstate(invalid="ignore"):
        way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-300)
    seen = np.nan_to_num((lines * way).sum(1))
    if viewpoint is not None and np.ndim(viewpoint) == 1 and not surely:
        seen[hidden(points, lines, np.asarray(viewpoint, np.float64))] = 0
    return voted_signs(points, lines, seen, surely=surely or viewpoint is None)


def seen_from_some(points: np.ndarray, lines: np.ndarray, places: np.ndarray) -> np.ndarray:
    """On which side, and how clearly, lines (n, 3) at points (n, 3) are seen from places (k, 3), -1 to 1, (n,).

    What sees a point counts the more the nearer it is; 0 where nothing does. Of many places an even part is looked
    from, and at a part of many points: the others have 0.
    """
    low, high = points.min(0), points.max(0)
    off = np.linalg.norm(np.maximum(np.maximum(low - places, places - high), 0), axis=1)
    near = places[off <= max(float(np.linalg.norm(high - low)), float(off.min()))]
    near = np.unique(near, axis=0)
    if len(near) > LOOKED_FROM:
        near = near[farthest_points_large(near, LOOKED_FROM)]
    rows = np.arange(len(points))
    if len(rows) > LOOKED_AT:
        rows = np.sort(np.random.default_rng(0).permutation(rows)[:LOOKED_AT])
    some, axes = points[rows], lines[rows]
    spacing = PointTree(some).among_themselves(min(6, len(some)))[0].mean(1)
    heard, weights = np.zeros(len(rows)), np.zeros(len(rows))
    for place in near:
        way = place - some
        distance = np.maximum(np.linalg.norm(way, axis=1), 1e-300)
        weight = np.where(hidden(some, axes, place, spacing), 0, 1 / distance**2)
        heard += weight * (axes * way).sum(1) / distance
        weights += weight
    seen = np.zeros(len(points))
    seen[rows] = heard / np.maximum(weights, 1e-300)
    return seen


def voted_signs(points: np.ndarray, lines: np.ndarray, seen: np.ndarray, *, surely: bool = False) -> np.ndarray:
    """+1 or -1 for each unit line (n, 3) at points (n, 3), as votes (n,) of -1 to 1 and the neighbors have it, (n,).

    surely: clear votes decide, whatever the neighbors say. Lines of a part without votes keep most of their sides.
    """
    pairs = Couplings.of(points, lines)
    graph = _graph(pairs, len(points), 1.01 - np.abs(pairs.coupling) + pairs.rise)
    part = connected_parts(pairs.first, pairs.second, len(points))
    sure = (np.abs(seen) > CLEAR) & surely
    as_given = np.where(np.bincount(part, seen)[part] < 0, -1.0, 1.0)
    followed = _followed(points, lines, seen, graph, part)
    voice = np.where(sure, SURELY * seen, seen)
    best, most = _turned(pairs, np.where(sure, np.sign(seen), as_given), voice, part)
    other, more = _turned(pairs, followed, voice, part)
    known = np.bincount(part, np.abs(seen)) > 0
    return np.where((known & (more > most + 1e-9))[part], other, best)


class Repair(NamedTuple):
    """Signs (n,) that make normals agree, and what decided their side."""

    signs: np.ndarray
    side: str  # "outward", or "most": that of most of the given ones


def repaired_signs(points: np.ndarray, normals: np.ndarray) -> Repair:
    """Of unit normals (n, 3) at points (n, 3) that contradict each other: +1, or -1 for each that is to be turned over.

    On a closed shape outward, unless two thirds of them look inward; on open ones, piece by piece, as most do.
    """
    cloud, given = NeighborCloud.of(points), normals.astype(np.float32)
    sign = signs(cloud, given)
    outward = (field(cloud, given * sign[:, None], SOME_NOISE) * given).sum(1).astype(np.float64)
    pairs = Couplings.of(points, normals)
    found = _patchwise(pairs, outward)
    if gauss_law(cloud, given * found.astype(np.float32)[:, None]).closed:
        return Repair(-found, "most") if (found > 0).mean() < 1 - MOST else Repair(found, "outward")
    part = connected_parts(pairs.first, pairs.second, len(points))
    found = _turned(pairs, found, np.zeros(len(points)), part)[0]
    return Repair(np.where(np.bincount(part, found)[part] < 0, -found, found), "most")


def largest_piece(points: np.ndarray, lines: np.ndarray, some: np.ndarray) -> int:
    """Points of the largest smooth piece that some (n,) of the points (n, 3) with unit lines (n, 3) make."""
    pairs = Couplings.of(points, lines)
    smooth = (np.abs(pairs.cosine) > SMOOTH) & (pairs.rise < SLOPE) & some[pairs.first] & some[pairs.second]
    part = connected_parts(pairs.first[smooth], pairs.second[smooth], len(points))
    return int(np.bincount(part[some], minlength=1).max())


def _patchwise(pairs: Couplings, outward: np.ndarray) -> np.ndarray:
    """Signs (n,) near those of `outward` (n,), alike among neighbors as far as those are."""
    n, plus = len(outward), outward >= 0
    same = plus[pairs.first] == plus[pairs.second]
    odds = min(same[plus[pairs.first] == kind].mean() for kind in (True, False) if (plus == kind).any())
    each = max(np.log(max(odds, 1 / n) / max(1 - odds, 1 / n)), 0) / NEIGHBORS
    clear = (pairs.rise < ALONG) & (np.abs(pairs.cosine) > ALIKE)
    weight = each * np.select([clear & (pairs.cosine < 0), clear], [0.0, 2.0], 1.0)  # none, where they contradict
    from scipy.sparse import csr_matrix

    graph = csr_matrix((weight, (pairs.first, pairs.second)), (n, n))
    graph = graph + graph.T
    mean = np.tanh(SURE * outward)
    for _ in range(ROUNDS):
        mean = np.tanh(SURE * (outward + graph @ mean))
    return np.where(mean < 0, -1.0, 1.0)


def _graph(pairs: Couplings, n: int, cost: np.ndarray) -> csr_matrix:
    """Couplings both ways, of those found twice the larger cost."""
    from scipy.sparse import csr_matrix

    graph = csr_matrix((cost, (pairs.first, pairs.second)), (n, n))
    return graph.maximum(graph.T)


def _followed(
    points: np.ndarray, lines: np.ndarray, seen: np.ndarray, graph: csr_matrix, part: np.ndarray
) -> np.ndarray:
    """Signs from the clear points, and the clearest of each part, along the paths on which lines turn least."""
    from scipy.sparse.csgraph import dijkstra

    start = np.abs(seen) > CLEAR
    order = np.argsort(np.abs(seen), kind="stable")
    clearest = np.zeros(part.max() + 1, np.int64)
    clearest[part[order]] = order
    start[clearest] = True
    before = dijkstra(graph, indices=np.flatnonzero(start), min_only=True, return_predecessors=True)[1]
    parent = np.where(start, np.arange(len(points)), before).astype(np.int64)
    step = points - points[parent]
    step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300)
    coupling = (lines * lines[parent]).sum(1) - 3 * (lines * step).sum(1) * (lines[parent] * step).sum(1)
    sign = np.where(np.where(start, seen, coupling) < 0, -1.0, 1.0)
    done = start.copy()
    while not done.all():  # pointer doubling
        sign = np.where(done, sign, sign * sign[parent])
        done, parent = done | done[parent], parent[parent]
    return sign


def _turned(pairs: Couplings, sign: np.ndarray, seen: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signs after pieces have turned over where that agrees more with neighbors and sensor, and how much they agree in
    each part. Smooth pieces first; where none turns any more, whole bodies of pieces that hold together at edges."""
    for _ in range(TURNS):
        agree = pairs.coupling * sign[pairs.first] * sign[pairs.second]
        smooth = (np.abs(pairs.cosine) > SMOOTH) & (pairs.rise < SLOPE) & (agree > 0)
        piece = connected_parts(pairs.first[smooth], pairs.second[smooth], len(sign))
        turn = _discontent(piece, pairs, agree, seen * sign)
        if not turn.any():
            piece = _bodies(piece, pairs, agree)[piece]
            turn = _discontent(piece, pairs, agree, seen * sign)
        if not turn.any():
            break
        sign = np.where(turn[piece], -sign, sign)
    agree = pairs.coupling * sign[pairs.first] * sign[pairs.second]
    return sign, np.bincount(part[pairs.first], agree, part.max() + 1) + np.bincount(part, SEEN * seen * sign)


def _discontent(piece: np.ndarray, pairs: Couplings, agree: np.ndarray, heard: np.ndarray) -> np.ndarray:
    """Which pieces agree less than they would if turned over, of two beside each other the one that gains more."""
    count = piece.max() + 1
    here, there = piece[pairs.first], piece[pairs.second]
    across = here != there
    here, there, agree = here[across], there[across], agree[across]
    gain: np.ndarray = np.bincount(piece, SEEN * heard, count)
    gain = gain + np.bincount(here, agree, count) + np.bincount(there, agree, count)
    turn = gain < 0
    both = turn[here] & turn[there]
    least = np.zeros(count)
    np.minimum.at(least, here[both], gain[there[both]])
    np.minimum.at(least, there[both], gain[here[both]])
    discontent: np.ndarray = turn & (gain <= least)
    return discontent


def _bodies(piece: np.ndarray, pairs: Couplings, agree: np.ndarray) -> np.ndarray:
    """For each piece the number of the body that it is part of: those that most pairs between them hold together."""
    count = piece.max() + 1
    here, there = piece[pairs.first], piece[pairs.second]
    low, high = np.minimum(here, there), np.maximum(here, there)
    from scipy.sparse import csr_matrix

    net = csr_matrix((agree, (low, high)), (count, count))
    all_pairs = csr_matrix((np.abs(agree), (low, high)), (count, count))
    held = (net - HELD * all_pairs).tocoo()
    firm = held.data > 0
    return connected_parts(held.row[firm], held.col[firm], count)


def hidden(
    points: np.ndarray, lines: np.ndarray, viewpoint: np.ndarray, spacing: np.ndarray | None = None
) -> np.ndarray:
    """Which of the points (n, 3) lie behind others, seen from there, (n,): those that face away too, as far as they are
    farther from the others than their tangent planes say. `spacing` (n,) is theirs, if it is known.

    Directions are sorted into cells, finer and finer; in each the nearest of the points that cover a cell hides others.
    """
    ray = points - viewpoint
    distance = np.linalg.norm(ray, axis=1)
    ray /= np.maximum(distance, 1e-300)[:, None]
    if spacing is None:
        spacing = PointTree(points).among_themselves(min(6, len(points)))[0].mean(1)
    angle = np.clip(COVERED * spacing / np.maximum(distance, 1e-300), 2.0**-16, 1)
    level = np.floor(-np.log2(angle)).astype(int)
    far_first = np.argsort(-distance, kind="stable")
    behind_others = np.zeros(len(points), bool)
    for fineness in np.unique(level):
        covers = far_first[level[far_first] <= fineness]
        for shift in (0.0, 0.5):
            cells = np.floor(ray * 2.0 ** (fineness + 1) + shift).astype(np.int64) @ np.array([2**40, 2**20, 1])
            known, cell = np.unique(cells, return_inverse=True)
            nearest = np.full(len(known), -1)
            nearest[cell[covers]] = covers
            other = nearest[cell]
            step = points[other] - points
            behind = np.minimum(
                np.abs((step * lines).sum(1)) / np.maximum(spacing, 1e-300),
                np.abs((step * lines[other]).sum(1)) / np.maximum(spacing[other], 1e-300),
            )
            behind_others |= (other >= 0) & (distance[other] < distance) & (behind > DEEP)
    return behind_others
