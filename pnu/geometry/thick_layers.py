"""Clouds whose points lie in a layer thicker than their spacing, as of noisy sensors that measure often: averaged.

Neighborhoods of such a cloud are balls within the layer and tell nothing of the surface. So the noise is measured in
neighborhoods that grow until they are wide beside it, and points are replaced by means that lie apart by as much.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.anisotropy import averaged
from pnu.geometry.farthest_sampling import farthest_apart, farthest_points_large, single_precision
from pnu.geometry.noise_level import QUIET, height_residuals, noise_level
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import spacing
from pnu.runtime.threads import thread_count

FEWEST = 10_000  # points of a cloud that tell a layer from walls that they do not resolve,
LEFT = 8000  # and means at least, for the network to smooth
LOUD = 0.6  # spacings of noise, as small neighborhoods show it, from which on wider ones are looked at:
WINDOWS = ((48, 1000), (96, 1000), (192, 600), (384, 400), (768, 200), (1536, 150), (3072, 100))  # neighbors, places
WITHIN = 4  # so many of the largest have to lie in the cloud
WIDE = 0.215  # noise over the radius of a neighborhood that is wide beside it
INNER, GATHERED = 0.7, 2.3  # share of that radius; fourth moment of the heights within: 3 of noise, 1 to 2 of two walls
APART = 2.0  # noise, as measured, between means,
LONELY = 0.5  # of the usual points, that one has to stand for at least: fewer are of the fringe;
NEAR = 1.5  # noise, radius of the ball that each is then the mean of, with at least
FEW, MOST = 8, 400  # points, and at most; looked at are
PLACES = 500  # of them


class LayerMeans(NamedTuple):
    """Points in place of a thick layer."""

    points: NDArray[np.float64]  # (m, 3)
    rows: NDArray[np.int64]  # (m,) of points that they stand for
    noise: float  # standard deviation of the points across the surface


def layer_noise(points: NDArray[np.float64], fewest: int = FEWEST) -> float | None:
    """Noise of points (n, 3) that lie in a layer thicker than their spacing; None: they do not, or are few.

    Good to about a fifth from 1 to 4 spacings. Walls that lie as close are no such layer: their points gather at both
    sides. Neither is what fills space.
    """
    if len(points) < fewest or noise_level(points) < LOUD * spacing(points):
        return None
    places, tree = farthest_points_large(points, WINDOWS[0][1]), PointTree(points)
    for k, some in WINDOWS:
        if WITHIN * k > len(points):
            break
        distance, idx = tree.nearest(points[places[:some]], k, threads=thread_count())
        height = height_residuals(points[idx], np.ones_like(distance))
        level = np.sqrt((height * height).sum(1) / (k - 6))
        noise = float(np.quantile(level, QUIET))
        if noise < WIDE * float(np.median(distance[:, -1])):
            quiet = level.argsort()[: max(10, some // 5)]
            inner = (distance[quiet] < INNER * distance[quiet, -1:]).astype(np.float64)
            square, fourth = ((inner * height[quiet] ** power).sum(1) / inner.sum(1) for power in (2, 4))
            return noise if float(np.median(fourth / np.maximum(square, 1e-300) ** 2)) > GATHERED else None
    return None


def layer_means(points: NDArray[np.float64], noise: float, least: int = LEFT) -> LayerMeans:
    """Means of the points (n, 3) of a layer of so much noise, in any order, about as far apart as it is thick, if that
    leaves as many as `least`."""
    order = np.lexsort(points.T)
    points = points[order]
    chosen, _ = farthest_apart(single_precision(points), len(points), least=APART * noise)
    if len(chosen) < min(least, len(points)):
        chosen = farthest_points_large(points, min(least, len(points)))
    rows = np.sort(chosen)
    stand_for = np.bincount(PointTree(points[rows]).nearest(points, 1)[1][:, 0], minlength=len(rows))
    rows = rows[stand_for >= LONELY * np.median(stand_for)]
    means, tree = averaged(points, rows), PointTree(points)
    around = tree.nearest(means[:: -(-len(means) // PLACES)], min(MOST, len(points)), threads=thread_count())[0]
    k = max(FEW, int(np.median((around < NEAR * noise).sum(1))))  # cells are thinner than the layer, balls as thick
    means = points[tree.nearest(means, k, threads=thread_count())[1]].mean(1)
    return LayerMeans(means, order[rows], noise)
