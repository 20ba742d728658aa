"""How many points each point of a cloud is to become: evenly over the surface, or after the cloud's own density."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.point_tree import PointTree

Density = Literal["auto", "even", "follow"]
DENSITIES = ("auto", "even", "follow")
NEIGHBORS = 8  # whose distance tells the area that a point stands for,
AROUND = 16  # and among whose points the usual one is taken
THINNED = 0.5  # of its points an even density may leave a place; a random cloud's places keep more,
SOME = 0.01  # where that share of the points has to put up with less
STEP = 2**0.5  # between the spacings of two groups


def point_areas(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Area of the surface that each of the points (n, 3) stands for, (n,), in their unit squared."""
    k, around = min(NEIGHBORS, len(points) - 1), min(AROUND, len(points))
    distance, near = PointTree(points).nearest(points, max(k + 1, around))
    areas: NDArray[np.float64] = np.pi / k * np.median(distance[:, k][near[:, :around]] ** 2, 1)
    areas[:] = np.maximum(areas, 1e-12 * areas.max())
    return areas


def point_counts(points: NDArray[np.float64], count: int, density: Density) -> NDArray[np.float64] | None:
    """Points that each of the points (n, 3) is to become, (n,), `count` in all; None: evenly, wherever they are.

    follow: each becomes as many. auto: evenly, unless that leaves places with fewer points than they had: there each
    becomes the square root of what it would become on the mean, and the others share the rest evenly.
    """
    n = len(points)
    if density == "follow":
        return np.full(n, count / n)
    if density == "even":
        return None
    areas = point_areas(points)
    even = count * areas / areas.sum()
    if count < n or (even < THINNED).mean() < SOME:
        return None
    counts: NDArray[np.float64] = even_above_floor(areas, count)
    return counts


def even_above_floor(areas: NDArray[np.float64], count: float) -> NDArray[np.float64]:
    """Points for each of the areas (n,), `count` in all: sqrt(count / n) at least, else in proportion to the area."""
    counts = count * areas / areas.sum()
    floor = np.sqrt(count / len(areas))
    for _ in range(60):  # as water fills what lies below its level
        low = counts <= floor
        level = (count - floor * low.sum()) / max(areas[~low].sum(), 1e-300)
        filled = np.maximum(np.where(low, floor, level * areas), floor)
        if (filled == counts).all():
            break
        counts = filled
    found: NDArray[np.float64] = counts * (count / counts.sum())
    return found


def groups_of_like_spacing(
    points: NDArray[np.float64], counts: NDArray[np.float64], count: int, least: int = 32, widest: float | None = None
) -> list[tuple[NDArray[np.int64], int]]:
    """Rows of points (n, 3) whose new points are to lie about as far apart, and how many these are, `count` in all.

    Groups differ by a factor of 1.4 in spacing; one of fewer than `least` points joins the next. The
    groups begin at the spacing `widest`, by default the largest there is.
    """
    spacing = np.sqrt(point_areas(points) / counts)
    step = np.round(np.log(spacing / (widest or spacing.max())) / np.log(STEP)).astype(int)
    groups: list[list[NDArray[np.int64]]] = []
    for value in np.unique(step):
        rows = np.flatnonzero(step == value)
        if groups and sum(map(len, groups[-1])) < least:
            groups[-1].append(rows)
        else:
            groups.append([rows])
    if len(groups) > 1 and sum(map(len, groups[-1])) < least:
        groups[-2:] = [groups[-2] + groups[-1]]
    joined = [np.sort(np.concatenate(group)) for group in groups]
    ends = np.round(np.cumsum([counts[rows].sum() for rows in joined])).astype(int)
    ends[-1] = count
    return [(rows, int(number)) for rows, number in zip(joined, np.diff(ends, prepend=0), strict=True)]


def count_of_spacing(points: NDArray[np.float64], spacing: float) -> int:
    """How many points have that spacing, in the unit of the points (n, 3), if evenly spread over their surface."""
    return round(float(point_areas(points).sum()) / spacing**2)
