"""What a cloud is like, before anything is made of it: spacing, evenness, noise."""

from typing import NamedTuple

import numpy as np

from pnu.geometry.flipped_parts import flipped_share
from pnu.geometry.noise_level import noise_level
from pnu.geometry.point_tree import PointTree

NEIGHBORS = 8
PLACES = 4000
CONTRADICTING = (
    0.06  # share of pairs; 0.03 on clean shapes of 300 points, 0.06 on thin ones with noise, 2 f (1 - f) for f flipped
)
FAR = 1.0  # radii of the middle 99 % of the points: one that far from its fourth neighbor stands alone
UNEVEN = 2.0  # random points of an even density stay below
FAINT = 0.05  # noise in spacings that does not stand out from curvature
NOTHING = 0.001  # below that, as on flat faces, it is rounding


class CloudStatistics(NamedTuple):
    """Lengths in the unit of the cloud."""

    dense: float  # spacing where a tenth of the points lie closer: what as many points have if evenly spread
    middle: float
    sparse: float  # where a tenth of them lie farther apart
    noise: float  # standard deviation across the surface, an upper bound
    radius: float  # largest distance from the middle of the box
    contradicting: float  # share of neighboring pairs whose normals look against each other
    flipped: float  # share of the points in whole parts whose normals look to the other side than those beside them
    far: int  # points that lie farther from all others than those are from each other
    farthest: int  # row of the one that lies farthest

    @property
    def uneven(self) -> bool:
        """Whether the density differs from place to place."""
        return self.sparse > UNEVEN * self.dense

    def __str__(self) -> str:
        spread = f"{self.middle:.3g}, {'uneven' if self.uneven else 'even'} ({self.dense:.3g} to {self.sparse:.3g})"
        noise = max(self.noise, NOTHING * self.middle)
        share = f"{noise / self.middle:.2g} of it, {100 * noise / self.radius:.2g} % of the radius"
        faint = self.noise < FAINT * self.middle
        return f"spacing {spread}; " + (f"no noise to speak of (below {share})" if faint else f"noise about {share}")

    def warnings(self) -> list[str]:
        """What is wrong with the cloud, a line each; nothing as a rule."""
        found = []
        if self.flipped:
            found.append(
                f"at least {self.flipped:.0%} of the normals look to the other side than those beside them, in whole "
                "parts; normals=estimate makes others"
            )
        elif self.contradicting > CONTRADICTING:
            found.append(
                f"{self.contradicting:.0%} of neighboring normals contradict each other; normals=estimate makes others"
            )
        if self.far:
            found.append(
                f"{self.far} of the points lie far from all others (number {self.farthest + 1} farthest); if they are "
                "errors, remove them"
            )
        return found


def describe_cloud(points: np.ndarray, normals: np.ndarray | None = None) -> CloudStatistics:
    """Spacing and noise of a cloud (n, 3), n >= 16; normals (n, 3) tell the sides of thin walls apart."""
    k = min(NEIGHBORS, len(points) - 1)
    far = PointTree(points).nearest(points[:: -(-len(points) // PLACES)], k + 1)[0][:, k]
    dense, middle, sparse = (float(value) for value in np.quantile(far * np.sqrt(np.pi / k), (0.1, 0.5, 0.9)))
    units = None if normals is None else normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    noise = noise_level(points, units)
    center = (points.min(0) + points.max(0)) / 2
    radius = float(np.linalg.norm(points - center, axis=1).max())
    against, flipped = (0.0, 0.0) if units is None else (contradicting(points, units), flipped_share(points, units))
    return CloudStatistics(dense, middle, sparse, noise, radius, against, flipped, *far_points(points))


def contradicting(points: np.ndarray, normals: np.ndarray) -> float:
    """Share of pairs of neighbors (at most 4000 places, 6 each) whose unit normals (n, 3) contradict each other.

    Normals of a pair contradict where they differ by more than 120 degrees though the pair lies along the surface of
    both. Two sides of a thin wall do so too, but there normals look away from each other, where wrong signs look
    towards each other as often: so twice those that look towards each other are counted, and no more than all.
    """
    here = np.arange(len(points))[:: -(-len(points) // PLACES)]
    near = PointTree(points).nearest(points[here], min(7, len(points)))[1][:, 1:]
    step = points[near] - points[here, None]
    length = np.linalg.norm(step, axis=2)
    first, second = normals[here, None], normals[near]
    rise = np.maximum(np.abs((first * step).sum(2)), np.abs((second * step).sum(2)))
    counted = (rise < 0.5 * length) & np.isfinite(first[..., 0]) & np.isfinite(second[..., 0])
    against = counted & ((first * second).sum(2) < -0.5)
    apart = ((second - first) * step).sum(2) / np.maximum(length, 1e-300)
    towards, even = against & (apart < -1e-6), against & (np.abs(apart) <= 1e-6)
    return float(min(2 * towards.sum() + even.sum(), against.sum()) / max(counted.sum(), 1))


def far_points(points: np.ndarray) -> tuple[int, int]:
    """How many points lie farther from their fourth neighbor than 99 % of them reach, and the row of the farthest."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    reach = float(np.quantile(distance, 0.99))
    rows = np.flatnonzero(distance > (1 + FAR) * reach)
    if not len(rows):
        return 0, int(distance.argmax())
    alone = PointTree(points).nearest(points[rows], min(5, len(points)))[0][:, -1] > FAR * reach
    rows = rows[alone]
    return len(rows), int(rows[distance[rows].argmax()]) if len(rows) else int(distance.argmax())
