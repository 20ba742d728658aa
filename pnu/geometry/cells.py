"""Space cut into cells, as many points in each: a large cloud in pieces that know nothing but their borders."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Cells(NamedTuple):
    """c cells that fill all of space, made by halving: cell i reaches from low[i] to high[i], infinite at the outside.

    A point on a border belongs to the cell above it.
    """

    low: NDArray[np.float64]  # (c, 3)
    high: NDArray[np.float64]  # (c, 3)
    axis: NDArray[np.int64]  # (c - 1,) of the cuts, from the first on, those of each half after it;
    cut: NDArray[np.float64]  # (c - 1,) where they are

    @staticmethod
    def of(points: NDArray[np.float64], depth: int) -> Cells:
        """2^depth cells with equal shares of the points (n, 3), by cutting the longest side of their box at the median.

        Many equal points stay in one cell, and leave others empty.
        """
        axis, cut = np.zeros(2**depth - 1, np.int64), np.zeros(2**depth - 1)
        low, high = np.full((1, 3), -np.inf), np.full((1, 3), np.inf)
        groups = [points]
        for level in range(depth):
            first = 2**level - 1
            below, above, lows, highs = [], [], [], []
            for i, group in enumerate(groups):
                longest = int(np.ptp(group, axis=0).argmax()) if len(group) else 0
                middle = np.median(group[:, longest]) if len(group) else 0.0
                axis[first + i], cut[first + i] = longest, middle
                under = group[:, longest] < middle
                below.append(group[under])
                above.append(group[~under])
                top, bottom = high[i].copy(), low[i].copy()
                top[longest], bottom[longest] = middle, middle
                lows += [low[i], bottom]
                highs += [top, high[i]]
            groups = [group for pair in zip(below, above, strict=True) for group in pair]
            low, high = np.array(lows), np.array(highs)
        return Cells(low, high, axis, cut)

    def of_points(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """The cell that each of the points (n, 3) is in, (n,)."""
        node = np.zeros(len(points), np.int64)
        rows = np.arange(len(points))
        for _ in range(len(self.low).bit_length() - 1):
            node = 2 * node + 1 + (points[rows, self.axis[node]] >= self.cut[node])
        return node - len(self.cut)

    def near(self, number: int, margin: float) -> list[int]:
        """Other cells that come within `margin`, along each axis, of a cell."""
        apart = np.maximum(self.low - self.high[number], self.low[number] - self.high).max(1)
        return [other for other in np.flatnonzero(apart <= margin).tolist() if other != number]

    def inside(self, points: NDArray[np.float64], number: int, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which points (n, 3) are in a cell, grown by `margin` on all sides, (n,)."""
        within = (points >= self.low[number] - margin) & (points < self.high[number] + margin)
        every: NDArray[np.bool_] = within.all(1)
        return every

    def depth(self, points: NDArray[np.float64], number: int) -> NDArray[np.float64]:
        """How far points (n, 3) of a cell are from its nearest border to another one, (n,)."""
        inward = np.minimum(points - self.low[number], self.high[number] - points)
        nearest: NDArray[np.float64] = inward.min(1)
        return nearest
