"""Locally optimal projection of points onto the median of a cloud."""

import numpy as np
import torch
from torch import Tensor

from pnu.geometry.normal_estimation import estimate_normals, flip_to_reference
from pnu.geometry.pair_weights import theta, within
from pnu.geometry.spacing import spacing
from pnu.upsamplers.context import Context
from pnu.upsamplers.midpoints import Midpoint


class LOP:
    """The input's points drawn to the local L1 median of the cloud and apart from each other; midpoints for a ratio.

    Lipman, Cohen-Or, Levin and Tal-Ezer 2007, "Parameterization-free projection for geometry reconstruction". The
    projection denoises and adds no points: with a ratio above 1 `Midpoint` fills between the projected ones.

    Args:
        radius: h, reach of the weights, in spacings of the cloud; wide ones smooth.
        repulsion: mu, between 0 and 0.5.
        turns: of the fixed point iteration.
    """

    name = "LOP"

    def __init__(self, radius: float = 6.0, repulsion: float = 0.3, turns: int = 15) -> None:
        check_projection(radius, repulsion, turns)
        self.radius, self.repulsion, self.turns = radius, repulsion, turns

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6): n projected points, and midpoints between them; nothing is random."""
        points = cloud[:, :3].cpu().double().numpy()
        radius = self.radius * spacing(points)
        moved = self.first(points, points, radius)
        for turn in range(self.turns):
            context.progress(f"{self.name}, {self.turns} turns", turn, self.turns)
            moved = self.step(moved, points, radius)
        context.progress(f"{self.name}, {self.turns} turns", self.turns, self.turns)
        return completed(moved, cloud.cpu().double(), count, context)

    def first(self, moved: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
        """Where the iteration starts: the mean of the points around each place, weighted by theta."""
        pairs = within(moved, points, radius)
        mean, found = pairs.mean(theta(pairs.dist, radius), points)
        return np.where(found[:, None], mean, moved)

    def step(self, moved: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
        """One turn of the fixed point iteration: moved (m, 3), points (n, 3) -> (m, 3)."""
        pairs = within(moved, points, radius)
        mean, found = pairs.mean(theta(pairs.dist, radius) / pairs.dist, points)
        return np.where(found[:, None], mean, moved) + self.repulsion * self.apart(moved, radius)

    def apart(self, moved: np.ndarray, radius: float) -> np.ndarray:
        """The way from the weighted mean of the other points to each: beta = theta / r |eta'|, eta = 1 / (3 r^3)."""
        pairs = within(moved, moved, radius, itself=False)
        ratio = pairs.dist / radius  # the weights' unit does not count; this one cannot overflow
        mean, found = pairs.mean(theta(pairs.dist, radius) / np.maximum(ratio, 1e-3) ** 5, moved)
        return np.where(found[:, None], moved - mean, 0)


def check_projection(radius: float, repulsion: float, turns: int) -> None:
    """ValueError for arguments that no projection can use."""
    if not 0 < radius < float("inf"):
        raise ValueError(f"radius={radius}: expected a number of spacings > 0")
    if not 0 <= repulsion < 0.5:
        raise ValueError(f"repulsion={repulsion}: expected a number from 0 to below 0.5, where the iteration converges")
    if turns < 1:
        raise ValueError(f"turns={turns}: expected at least 1")


def completed(moved: np.ndarray, cloud: Tensor, count: int, context: Context) -> Tensor:
    """Moved points (n, 3) with normals, and midpoints between them up to `count`: (count, 6).

    The normals are fitted anew to what is there now, each on the side of the nearest normal of the cloud (n, 6).
    """
    known = cloud.numpy()
    lines = estimate_normals(moved, min(16, len(moved)), orient=False)
    normals = flip_to_reference(lines, moved, known[:, :3], known[:, 3:])
    consolidated = torch.from_numpy(np.hstack([moved, normals]))
    return consolidated if count == len(consolidated) else Midpoint().upsample_cloud(consolidated, count, context)
