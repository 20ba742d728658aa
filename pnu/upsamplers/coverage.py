"""The promise that each point of a cloud has one of those made near it: which of them come nearer, and where to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import thread_count

SPACED = 6  # neighbors whose mean distance is the spacing at a point of the cloud,
COVERED = 0.5  # of which so much may lie between it and the nearest point made;
NEARER = 0.9  # that comes to this share of it
APPROACHES = 3  # times that points come nearer to those that have none near, as others lose their own by it
AT_HAND = 16  # nearest points made among which one is looked for that has not moved

Floats = NDArray[np.float64]
Index = NDArray[np.int64]


def covering(made: Floats, kept: Floats, cloud: Floats, onto: Callable[[Floats, int], Floats]) -> Floats:
    """Points made (m, 6) of which, or of those kept (k, 6), one lies within half a spacing of each point of a cloud.

    Where none does, the nearest that was made comes so near; onto(points, number) brings them back onto the surface.
    """
    made, coverage = made.copy(), Coverage(cloud[:, :3], made[:, :3], kept[:, :3])
    for number in range(1, APPROACHES + 1):
        rows, places = coverage.approach()
        if not len(rows):
            break
        made[rows] = onto(np.hstack([places, made[rows, 3:]]), number)
        coverage.move(rows, made[rows, :3])
    return made


class Coverage:
    """Points (n, 3) of a cloud, and which of the points made has each the nearest, kept up to date as some move.

    Args:
        points: (n, 3).
        made: (m, 3), which move,
        kept: (l, 3), and those that do not, m + l >= 1.
    """

    def __init__(self, points: Floats, made: Floats, kept: Floats) -> None:
        around = PointTree(points).among_themselves(min(SPACED + 1, len(points)), threads=thread_count())[0]
        self.points, self.reach = points, np.maximum(COVERED * around.mean(1), 1e-300)
        self.made, self.movable = np.concatenate([made, kept]), len(made)
        self._settle()
        self.apart, self.row = self._nearest(np.arange(len(points)))

    def approach(self) -> tuple[Index, Floats]:
        """Rows (k,) of what was made that should move, and where to (k, 3), for points that have none near.

        Near is half of the spacing of the points. Each row moves once, for the barest point.
        """
        share = self.apart / self.reach
        bare = (-share).argsort(kind="stable")[: int((share > 1).sum())]
        bare = bare[self.row[bare] < self.movable]
        _, barest = np.unique(self.row[bare], return_index=True)
        bare = bare[np.sort(barest)]
        row, apart = self.row[bare], self.apart[bare]
        step = (apart - NEARER * self.reach[bare]) / np.maximum(apart, 1e-300)
        return row, self.made[row] + step[:, None] * (self.points[bare] - self.made[row])

    def move(self, rows: Index, places: Floats) -> None:
        """These rows (k,) of what was made lie at other places (k, 3) now.

        Only points that had one of them for the nearest, or none near, may have none near after it.
        """
        self.made[rows] = places
        self.moved[rows] = True
        again = np.flatnonzero(self.moved[self.row] | (self.apart > self.reach))
        self.apart[again], self.row[again] = self._nearest(again)

    def _settle(self) -> None:
        """Search among the places of now."""
        self.tree, self.moved = PointTree(self.made.copy()), np.zeros(len(self.made), bool)

    def _nearest(self, some: Index) -> tuple[Floats, Index]:
        """Of some of the points, how far the nearest that was made is, and which that is, both (len(some),)."""
        places = self.points[some]
        others = np.flatnonzero(self.moved)
        k = min(AT_HAND, len(self.made)) if len(others) else 1
        distance, row = self.tree.nearest(places, k, threads=thread_count())
        distance[self.moved[row]] = np.inf
        first = distance.argmin(1)[:, None]
        apart, near = np.take_along_axis(distance, first, 1)[:, 0], np.take_along_axis(row, first, 1)[:, 0]
        if not len(others):
            return apart, near
        if not np.isfinite(apart).all():  # all at hand have moved
            self._settle()
            return self._nearest(some)
        far, other = PointTree(self.made[others]).nearest(places, 1, threads=thread_count())
        moved_apart, moved = far[:, 0], others[other[:, 0]]
        nearer = (moved_apart < apart) | ((moved_apart == apart) & (moved < near))
        return np.where(nearer, moved_apart, apart), np.where(nearer, moved, near)
