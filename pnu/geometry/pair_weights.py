"""Weighted means over all points within a radius, as sparse matrices: what consolidation of point sets is made of."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from pnu.geometry.kd_tree import kd_tree

TINY = 1e-12  # in units of the radius: two points at one place


class Within(NamedTuple):
    """All pairs (i, j) of a point i and a target j that are at most a radius apart."""

    i: np.ndarray  # (e,)
    j: np.ndarray  # (e,)
    dist: np.ndarray  # (e,) greater than 0
    shape: tuple[int, int]  # points, targets

    def mean(self, weight: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the targets' values (m, d) by weights (e,), (n, d), and which points have any weight, (n,)."""
        matrix = csr_matrix((weight, (self.i, self.j)), self.shape)
        total = np.asarray(matrix.sum(axis=1)).ravel()
        found = total > 0
        sums: np.ndarray = matrix @ values
        return np.divide(sums, total[:, None], out=np.zeros_like(sums), where=found[:, None]), found

    def sum(self, weight: np.ndarray) -> np.ndarray:
        """Sum of weights (e,) of each point, (n,)."""
        return np.bincount(self.i, weight, self.shape[0])


def within(points: np.ndarray, targets: np.ndarray, radius: float, *, itself: bool = True) -> Within:
    """Pairs of points (n, 3) and targets (m, 3) within a radius, found by trees.

    itself: whether point i and target i, of the same cloud, are a pair.
    """
    pairs = kd_tree(points).sparse_distance_matrix(kd_tree(targets), radius, output_type="ndarray")
    if not itself:
        pairs = pairs[pairs["i"] != pairs["j"]]
    dist = np.maximum(pairs["v"], TINY * radius)
    return Within(pairs["i"], pairs["j"], dist, (len(points), len(targets)))


def theta(dist: np.ndarray, radius: float) -> np.ndarray:
    """The fast-decreasing weight of LOP, exp(-r^2 / (h/4)^2): Lipman et al. 2007, section 3."""
    weight: np.ndarray = np.exp(-((4 * dist / radius) ** 2))
    return weight
