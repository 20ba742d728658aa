"""The nearest points of a cloud on the CPU: a compiled search, or SciPy's where that is not to be had."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from pnu import kernels

CHUNK = 2048  # queries that a thread takes at once
FEW = 256  # queries whose order does not matter
RUN = 16  # queries beside each other, of more of them, whose order does not


class PointTree:
    """The nearest of some points (n, 3), n >= 1, in float64, looked up again and again.

    ValueError where points or queries are not finite, or fewer points there are than neighbors asked for.
    """

    def __init__(self, points: NDArray[np.floating]) -> None:
        self.points = finite(points, "points")
        self.compiled = kernels.ready()
        if self.compiled:
            from pnu.kernels.neighbors import NeighborTree

            self.tree = NeighborTree(self.points)
        else:
            from pnu.geometry.kd_tree import kd_tree

            self.plain = kd_tree(self.points)

    def nearest(
        self, queries: NDArray[np.floating], k: int, *, threads: int = 1
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Distances (m, k) of each query (m, 3) to its k <= n nearest points, ascending, and which points they are."""
        dist, idx = self.nearest_sq(queries, k, threads=threads)
        return np.sqrt(dist, out=dist), idx

    def among_themselves(self, k: int, *, threads: int = 1) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Distances (n, k - 1) of each point to its k - 1 nearest others, ascending, and which points they are."""
        dist, idx = self.nearest(self.points, k, threads=threads)
        return dist[:, 1:], idx[:, 1:]

    def nearest_sq(
        self, queries: NDArray[np.floating], k: int, *, threads: int = 1, ordered: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """As `nearest`, but squared distances. ordered: queries come along a curve, which saves time."""
        queries = finite(queries, "queries")
        if not 1 <= k <= len(self.points):
            raise ValueError(f"k: expected 1 to {len(self.points)} neighbors, found {k}")
        if not self.compiled:
            dist, idx = self.plain.query(queries, k=np.arange(1, k + 1), workers=threads)
            return np.multiply(dist, dist, out=dist), idx
        dist, idx = np.empty((len(queries), k)), np.empty((len(queries), k), np.int64)
        order = None if ordered or len(queries) <= FEW else self._order(queries)

        def search(part: slice) -> None:
            if order is None:
                self.tree.search(queries[part], idx[part], dist[part])
                return
            rows = order[part]
            near, far = np.empty((len(rows), k), np.int64), np.empty((len(rows), k))
            self.tree.search(queries.take(rows, 0), near, far)
            idx[rows], dist[rows] = near, far

        parts = [slice(start, start + CHUNK) for start in range(0, len(queries), CHUNK)]
        if threads == 1 or len(parts) < 2:
            for part in parts:
                search(part)
            return dist, idx
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(search, parts))
        return dist, idx

    def _order(self, queries: NDArray[np.float64]) -> NDArray[np.int64]:
        if queries is self.points:
            return np.asarray(self.tree.order)
        from pnu.kernels.boxes import box_order

        return np.asarray(box_order(np.require(queries, np.float64, ["C", "W", "A"]), RUN))


def finite(points: NDArray[np.floating], name: str) -> NDArray[np.float64]:
    """Points in float64; `ValueError` for one that is not finite: compiled searches would go astray."""
    found = np.asarray(points, np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{name}: expected finite coordinates, found NaN or infinite ones")
    return found
