"""Large clouds by place: blocks, compact and of bounded size, and an order in which neighbors are close."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.floating]
Index = NDArray[np.signedinteger]

CURVE = 16  # bits of a coordinate on the curve
SPREAD_BITS = ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249))  # 1 bit in 3


class Blocks(NamedTuple):
    """A cloud cut into b blocks; every point is in one."""

    members: list[Index]  # points of each block, ascending
    low: Points  # (b, 3) and
    high: Points  # (b, 3): corners of the boxes that hold them

    def in_a_row(self) -> "Blocks":
        """The same of the cloud whose points are put in the order of the blocks, so that those of each lie together."""
        stops = np.cumsum([len(part) for part in self.members])
        rows = np.arange(stops[-1], dtype=self.members[0].dtype)
        return self._replace(members=np.split(rows, stops[:-1]))

    def near(self, number: int, margin: float) -> list[int]:
        """Other blocks whose boxes are at most `margin` away, in each axis, from the box of a block."""
        apart = np.maximum(self.low - self.high[number], self.low[number] - self.high).max(1)
        return [other for other in np.flatnonzero(apart <= margin).tolist() if other != number]

    def inside(self, points: Points, number: int, margin: float) -> NDArray[np.bool_]:
        """Which points (n, 3) lie in the box of a block, grown by `margin` on all sides."""
        low, high = self.low[number] - margin, self.high[number] + margin
        within = np.ones(len(points), bool)
        for axis in range(3):
            within &= (points[:, axis] >= low[axis]) & (points[:, axis] <= high[axis])
        return within

    def halo(self, points: Points, number: int, margin: float) -> Index:
        """Points of the cloud that are no members of a block but in its box, grown by `margin`."""
        parts = [np.empty(0, np.int64)]
        for other in self.near(number, margin):
            members = self.members[other]
            parts.append(members[self.inside(points.take(members, 0), number, margin)])
        return np.concatenate(parts)

    def colors(self, margin: float) -> list[list[int]]:
        """Groups of blocks, no two of a group within `margin` of each other."""
        groups: list[list[int]] = []
        taken: list[set[int]] = []
        for number in range(len(self.members)):
            near = set(self.near(number, margin))
            free = next((i for i, group in enumerate(taken) if not near & group), len(taken))
            if free == len(taken):
                taken.append(set())
                groups.append([])
            taken[free].add(number)
            groups[free].append(number)
        return groups


def split_blocks(points: Points, size: int) -> Blocks:
    """Blocks of at most `size` of the points (n, 3), by halving the longest side of the box, always at the median."""
    members: list[Index] = []
    boxes: list[tuple[Points, Points]] = []
    kind = np.int32 if len(points) < 2**31 else np.int64
    todo = [(np.arange(len(points), dtype=kind), np.ascontiguousarray(points.T))]
    while todo:
        part, axes = todo.pop()
        low, high = axes.min(1), axes.max(1)
        if len(part) <= size:
            members.append(np.sort(part))
            boxes.append((low, high))
            continue
        half = len(part) // 2
        order = np.argpartition(axes[(high - low).argmax()], half)
        todo += [(part[rows], axes.take(rows, 1)) for rows in (order[half:], order[:half])]
    return Blocks(members, np.array([low for low, _ in boxes]), np.array([high for _, high in boxes]))


def along_curve(points: Points) -> NDArray[np.int64]:
    """Order of the points (n, 3) along a Morton curve, (n,): what is near in the order is near in space, mostly.

    Searches and gathers in this order find in the processor's cache what the ones before have used.
    """
    low, high = points.min(0), points.max(0)
    scale = (2**CURVE - 1) / max((high - low).max(), 2**CURVE * np.finfo(points.dtype).tiny)
    code = np.zeros(len(points), np.int64)
    for axis in range(3):
        cell = ((points[:, axis] - low[axis]) * scale).astype(np.int64)
        for shift, mask in SPREAD_BITS:
            cell = (cell | (cell << shift)) & mask
        code |= cell << axis
    return _stable_order(code)


def _stable_order(code: NDArray[np.int64]) -> NDArray[np.int64]:
    """As `code.argsort(kind="stable")` of (n,), in a third of the time where few are equal."""
    order = code.argsort()
    sorted_ = code.take(order)
    equal = np.zeros(len(code) + 1, bool)
    equal[1:-1] = sorted_[1:] == sorted_[:-1]
    rows = np.flatnonzero(equal[1:] | equal[:-1])
    some = order[rows]
    order[rows] = some[np.lexsort((some, sorted_[rows]))]
    return order


def some_rows(points: np.ndarray, count: int) -> np.ndarray:
    """Rows (at most `count`,) spread over points (n, 3) along z: the same points in whatever order all come."""
    places = np.unique(np.linspace(0, len(points) - 1, count).round().astype(np.int64))
    rows: np.ndarray = np.lexsort(points.T)[places]
    return rows
