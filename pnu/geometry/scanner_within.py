"""From where among its own points a cloud was scanned, told by how it thins out.

The rays of a scanner part evenly to all sides, so a surface gets cos(slant) / distance^2 points an area, and none where
something stands before it. In a room, on a site, in a street that tells where the scanner stood, and with that which
side of things was seen. Clouds that were made even, or pieced together from many places, do not tell it.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.normal_sides import hidden
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import local_spacing
from pnu.runtime.threads import thread_count

Floats = NDArray[np.float64]

FEWEST, LOOKED = 1000, 1024  # points that tell, and that are looked at
NEIGHBORS = 24  # whose area is a density
UNEVEN = 0.3  # mean deviation of the density's logarithm below which it tells nothing
GRID, DENSEST, AWAY = 6, 40, (0.03, 0.1, 0.3)  # places that are tried: along each axis; radii before the densest points
TRIED, STARTS, STEPS = 16, 3, 80  # of those, looked at with what is hidden from them, then moved, so often
STEP = 0.1  # radii by which the search begins to move a place
LIKELY, EXPLAINED = 0.25, 0.42  # of the deviation that a place explains, for a start and for a scanner
CENTRAL = 0.08  # radii from the middle, within which things lie whose points were made along rays from there
AS_WELL = 0.05  # by so much less its mirror image may explain, which then may be the scanner too
LYING = 0.9  # cosine between a point's line and the one that most have, from which on it lies on a ground
LEAST = 0.05  # cosine of a slant, below which a scanner sees nothing


def scanner_within(points: Floats, lines: Floats) -> Floats | None:
    """The place (3,) amid points (n, 3) with unit lines (n, 3) from which they were scanned; None: there is none.

    Sought (Nelder and Mead 1965) where the density that a scanner there would leave is the most like that of the
    cloud, and at the origin first. About a hundredth of the extent it may be off in a room, more in the open; of
    several scanners it is one, or a place between them.
    """
    if len(points) < FEWEST:
        return None
    looked = farthest_points_large(points, min(LOOKED, len(points)))
    middle = points[looked].mean(0)
    radius = float(np.linalg.norm(points[looked] - middle, axis=1).max())
    if not radius > 0:
        return None
    far = PointTree(points).nearest(points[looked], NEIGHBORS + 1, threads=thread_count())[0][:, -1]
    view = _View((points[looked] - middle) / radius, lines[looked], -2 * np.log(np.maximum(far, 1e-9 * radius)))
    if view.deviation < UNEVEN:
        return None
    origin = -middle / radius
    best, most = origin, view.explained_with_hidden(origin) if view.holds(origin) else 0.0
    if most < EXPLAINED:
        best, most = _likeliest(view)
    if most < EXPLAINED or not view.holds(best) or np.linalg.norm(best) < CENTRAL:
        return None
    if best is not origin and view.explained_with_hidden(view.mirrored(best)) > most - AS_WELL:
        return None  # ground alone, seen from above or from below
    return np.asarray(middle + radius * best)


def _likeliest(view: _View) -> tuple[Floats, float]:
    """The place (3,) that explains the most, and how much."""
    places = view.places()
    plain = view.explained(view.densities(places))
    if plain.max() < LIKELY:
        return places[0], 0.0
    some = places[np.argsort(-plain, kind="stable")[:TRIED]]
    first = np.array([view.explained_with_hidden(place) for place in some])
    from scipy.optimize import minimize  # takes a moment to load

    best, most = some[0], 0.0
    for start in some[np.argsort(-first, kind="stable")[:STARTS]]:
        simplex = start + STEP * np.vstack([np.zeros(3), np.eye(3)])
        options = {"initial_simplex": simplex, "maxfev": STEPS, "xatol": 1e-3, "fatol": 1e-3}
        found = minimize(lambda place: -view.explained_with_hidden(place), start, method="Nelder-Mead", options=options)
        if -found.fun > most:
            best, most = found.x, -float(found.fun)
    return best, most


class _View:
    """An even part of a cloud in its unit sphere, with the logarithm of the cloud's density there."""

    def __init__(self, points: Floats, lines: Floats, density: Floats) -> None:
        self.points, self.lines, self.density = points, lines, density
        self.spacing = local_spacing(points)
        self.deviation = float(np.abs(density - np.median(density)).mean())

    def places(self) -> Floats:
        """Some amid the points, (m, 3): on a grid, and before the densest of them."""
        axes = [np.linspace(low, high, GRID + 2)[1:-1] for low, high in zip(*self.box(), strict=True)]
        densest = np.argsort(-self.density, kind="stable")[:DENSEST]
        before = [self.points[densest] + way * self.lines[densest] for way in (*AWAY, *(-way for way in AWAY))]
        return np.concatenate([np.array(list(product(*axes))), *before])

    def box(self) -> tuple[Floats, Floats]:
        """Its least and its greatest corner."""
        return self.points.min(0), self.points.max(0)

    def holds(self, place: Floats) -> bool:
        """Whether a place is within the cloud, or above it by no more than its extent."""
        low, high = self.box()
        return bool((place > low - 0.5 * (high - low).max()).all() and (place < high + 0.5 * (high - low).max()).all())

    def mirrored(self, place: Floats) -> Floats:
        """The place (3,) on the other side of the plane on which most points lie, if there is such a one."""
        axis = np.linalg.eigh(self.lines.T @ self.lines)[1][:, -1]
        across = np.abs(self.lines @ axis) > LYING
        level = np.median((self.points @ axis)[across]) if across.any() else 0.0
        return np.asarray(place - 2 * (place @ axis - level) * axis)

    def densities(self, places: Floats) -> Floats:
        """That scanners at places (m, 3) would leave if nothing stood before anything, to a factor: (m, n)."""
        way = places[:, None] - self.points
        distance = np.maximum(np.linalg.norm(way, axis=2), 1e-6)
        slant = np.abs((way * self.lines).sum(2)) / distance
        return np.asarray(np.where(slant > LEAST, slant, 0) / distance**2)

    def explained(self, densities: Floats) -> Floats:
        """Share of the deviation that densities (m, n) explain, less by the share of what gets none: (m,)."""
        there = densities > 0
        rest = np.where(there, self.density - np.log(np.where(there, densities, 1)), np.nan)
        share, some = np.full(len(rest), -np.inf), there.any(1)
        left = np.abs(rest[some] - np.nanmedian(rest[some], axis=1, keepdims=True))
        share[some] = there[some].mean(1) * (1 - np.nanmean(left, axis=1) / self.deviation)
        return share

    def explained_with_hidden(self, place: Floats) -> float:
        """The same of one place (3,), from which some points hide others."""
        densities = self.densities(place[None])
        densities[0, hidden(self.points, self.lines, place, self.spacing)] = 0
        return float(self.explained(densities)[0])
