"""Weighted locally optimal projection: LOP for clouds of uneven density."""

import numpy as np

from pnu.geometry.pair_weights import theta, within
from pnu.upsamplers.lop import LOP


class WLOP(LOP):
    """LOP whose terms are weighted by local density; midpoints for a ratio.

    Huang, Li, Zhang, Ascher and Cohen-Or 2009, "Consolidation of unorganized point clouds for surface reconstruction":
    v_j = 1 + sum theta(p_j - p_j') makes dense places of the cloud draw no more than sparse ones, w_i = 1 + sum
    theta(x_i - x_i') pushes harder where the projected points crowd, and eta(r) = -r repels farther than LOP's. It
    denoises and adds no points: with a ratio above 1 `Midpoint` fills between the projected ones.

    Args:
        radius: h, reach of the weights, in spacings of the cloud; wide ones smooth.
        repulsion: mu, between 0 and 0.5.
        turns: of the fixed point iteration.
    """

    name = "WLOP"

    def __init__(self, radius: float = 8.0, repulsion: float = 0.45, turns: int = 20) -> None:
        super().__init__(radius, repulsion, turns)

    def step(self, moved: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
        """One turn of the fixed point iteration: moved (m, 3), points (n, 3) -> (m, 3)."""
        pairs = within(moved, points, radius)
        weight = theta(pairs.dist, radius) / pairs.dist / density(points, radius)[pairs.j]
        mean, found = pairs.mean(weight, points)
        return np.where(found[:, None], mean, moved) + self.repulsion * self.apart(moved, radius)

    def apart(self, moved: np.ndarray, radius: float) -> np.ndarray:
        """The way from the weighted mean of the other points to each: beta = w theta / r."""
        pairs = within(moved, moved, radius, itself=False)
        weight = density(moved, radius)[pairs.j] * theta(pairs.dist, radius) / pairs.dist
        mean, found = pairs.mean(weight, moved)
        return np.where(found[:, None], moved - mean, 0)


def density(points: np.ndarray, radius: float) -> np.ndarray:
    """1 + the sum of theta over all other points, (n,): the weights v and w."""
    pairs = within(points, points, radius, itself=False)
    sums: np.ndarray = 1 + pairs.sum(theta(pairs.dist, radius))
    return sums
