"""From where a cloud was seen, told by its points alone: by a camera at some place, or all from one side.

A camera's points lie one a pixel: seen from its place, in even rows and columns, and from no other place. Along the way
to it nothing lies behind anything else; along any other way the front and the back of what bends fall together. So of
many directions that one is the camera's along which no two points lie behind each other, if there is such a one; around
closed shapes there is none.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.normal_sides import voted_signs
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import spacing
from pnu.geometry.sphere_directions import sphere_directions
from pnu.runtime.threads import thread_count

Floats = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST, MOST = 200, 2048  # points that tell, and that are looked at
DIRECTIONS = 300  # of a half of the sphere,
AT_ONCE = 50  # looked along at once
CELL, BEHIND = 0.5, 3.0  # spacings across in which two points are on one ray, and along, from which one is behind
CLEAR, SHARE = 0.02, 0.2  # of the points, and of the usual share, that may lie behind others
ALIKE = 0.002  # directions that differ by less see the same
NEAREST, FARTHEST = 1.05, 10.0  # radii of a cloud from its middle to a camera that saw it from outside
BLOCK = 4096  # points in which pixels are looked for:
SAME, SQUARE = 1.1, 1.35  # angles to the second and the fourth neighbor, over the nearest's, that are hardly wider,
PAIRS, FOURS = 0.85, 0.7  # and the shares of the points that have them
STEEP, FLAT = 0.95, 0.25  # of land: cosine of the way it was seen with z; height over its extent
GLANCE = 512, 80  # points and directions of a first look for a camera somewhere,
HIDDEN = 0.075  # share of points behind others above which there is none
CLOSE = 0.06  # so much more than the least may be behind others in ways that are tried
TRIED, STARTS = 30, 3  # ways that are tried, both of their ends, and those of them the search starts from,
ALONG = 0.9  # which make angles with each other whose cosines are smaller
AWAY, STEP = (1.6, 2.8), 0.35  # radii to a camera at first, and by which the search begins to move it
WATCHED = 256  # points whose neighbors' angles are compared,
WIDEST = 0.5  # logarithm by which one counts at most
CANDIDATES = 24  # neighbors among which the nearest are, as the place moves over
NEARBY = 0.15  # at first
UNLIKELY = 0.28  # mean logarithm by which they differ above which a way is none to a camera,
HARDLY_UNEVEN, UNEVEN = 0.11, 0.07  # and a place none, by some of the points, and by all


def is_camera(place: Floats, points: Floats) -> bool:
    """Whether points (n, 3) lie one a pixel as seen from a place (3,) outside of them: in even rows and columns."""
    if len(points) < FEWEST:
        return False
    middle = points.mean(0)
    from_middle = np.linalg.norm(points - middle, axis=1)
    away, radius = float(np.linalg.norm(place - middle)), float(from_middle.max())
    if not NEAREST * radius < away < FARTHEST * radius:
        return False
    if len(points) > BLOCK:
        center = points[from_middle.argmin()]
        points = points[np.argpartition(((points - center) ** 2).sum(1), BLOCK)[:BLOCK]]
    rays = points - place
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angles = PointTree(rays).nearest(rays, 5, threads=thread_count())[0][:, 1:]
    pairs, fours = ((angles[:, k] < most * angles[:, 0]).mean() for k, most in ((1, SAME), (3, SQUARE)))
    return bool(pairs > PAIRS and fours > FOURS)


def single_view(points: Floats) -> Floats | None:
    """Unit direction (3,) along which no point of a cloud (n, 3) lies behind another, either way; None: there is none.

    None too where that tells nothing: along most directions, as on a plane, or of fewer than 200 points.
    """
    if len(points) < FEWEST:
        return None
    if len(points) > MOST:
        points = points[farthest_points_large(points, MOST)]
    apart, directions = spacing(points), sphere_directions(2 * DIRECTIONS)[:DIRECTIONS]
    behind = _shares_behind(points, directions, apart)
    if behind.min() > min(CLEAR, SHARE * float(np.median(behind))):
        return None
    clear = directions[behind <= behind.min() + ALIKE]
    return np.asarray(np.linalg.eigh(clear.T @ clear)[1][:, -1])


def camera_place(points: Floats) -> Floats | None:
    """The place (3,) from which a camera saw all points (n, 3), one a pixel; None: there is no such place.

    It is sought (Nelder and Mead 1965) where the angles between rays to neighboring points are the most alike, from
    directions along which hardly a point lies behind another. Points that float behind edges do not matter, and neither
    does the order of the points. Some hundredths of the distance it may be off, along the way to it most.
    """
    if len(points) < FEWEST:
        return None
    if is_camera(np.zeros(3), points):
        return np.zeros(3)
    return _camera_of(np.ascontiguousarray(points[np.lexsort(points.T)], np.float64).tobytes())


@lru_cache(maxsize=2)  # several stages ask for that of the same points
def _camera_of(data: bytes) -> Floats | None:
    points = np.frombuffer(data).reshape(-1, 3)
    middle = points.mean(0)
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    if not radius > 0:
        return None
    unit = (points - middle) / radius
    count, tried = GLANCE
    some = unit if len(unit) <= count else unit[farthest_points_large(unit, count)]
    directions = sphere_directions(2 * tried)[:tried]
    behind = _shares_behind(some, directions, spacing(some))
    if behind.min() > HIDDEN:
        return None
    ways = directions[behind <= behind.min() + CLOSE]
    if len(ways) > TRIED:
        ways = ways[farthest_points_large(ways, TRIED)]
    starts = np.concatenate([side * away * ways for side in (1, -1) for away in AWAY])
    block = unit if len(unit) <= MOST else unit[np.argpartition((unit**2).sum(1), MOST)[:MOST]]

    def in_block(place: Floats) -> float:
        return _unevenness(_angles(place, block)[0])

    first = np.array([in_block(start) for start in starts])
    if first.min() > UNLIKELY:
        return None
    for start in _apart(starts[np.argsort(first, kind="stable")], STARTS):
        place = _moved(in_block, start, STEP)
        if in_block(place) < HARDLY_UNEVEN:
            place = _moved(partial(_among, near=_angles(place, unit, CANDIDATES)[1], points=unit), place, NEARBY)
            if _unevenness(_angles(place, unit)[0]) < UNEVEN:
                away = float(np.linalg.norm(place))
                return middle + radius * place if NEAREST < away < FARTHEST else None
    return None


def _moved(unevenness: Callable[[Floats], float], start: Floats, step: float) -> Floats:
    """The place (3,) near a start where that is least (Nelder and Mead 1965)."""
    from scipy.optimize import minimize  # takes a moment to load

    simplex = start + step * np.vstack([np.zeros(3), np.eye(3)])
    options = {"initial_simplex": simplex, "maxfev": 150, "xatol": 1e-3, "fatol": 1e-3}
    return np.asarray(minimize(unevenness, start, method="Nelder-Mead", options=options).x)


def _angles(place: Floats, points: Floats, k: int = 4) -> tuple[Floats, Index]:
    """Of some of the points (n, 3), as seen from a place (3,): angles to the k nearest, themselves the first, (m, k),
    and their rows, (m, k)."""
    rays = points - place
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    watched = np.linspace(0, len(points) - 1, min(WATCHED, len(points))).astype(int)
    return PointTree(rays).nearest(rays[watched], min(k, len(points)))


def _among(place: Floats, near: Index, points: Floats) -> float:
    """The unevenness of points in the first column of rows (m, k) among those of the other columns."""
    rays = points[near] - place
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-300)
    return _unevenness(np.sort(np.linalg.norm(rays - rays[:, :1], axis=2), axis=1)[:, :4])


def _unevenness(angles: Floats) -> float:
    """Mean absolute logarithm of the angles to the second and third neighbor (m, 4) over the usual one."""
    logarithms = np.log(np.maximum(angles[:, 2:], 1e-12))
    return float(np.minimum(np.abs(logarithms - np.median(logarithms)), WIDEST).mean())


def _apart(places: Floats, count: int) -> list[Floats]:
    """The first of the places (m, 3), and of those after it that lie in other directions: so many at most."""
    found: list[Floats] = []
    for place in places:
        length = np.linalg.norm(place)
        if all(place @ other < ALONG * length * np.linalg.norm(other) for other in found):
            found.append(place)
        if len(found) == count:
            break
    return found


class OneSide(NamedTuple):
    """Normals of what was seen from one side, and whether that was from above."""

    normals: Floats  # (n, 3)
    above: bool


def seen_from_one_side(points: Floats, normals: Floats) -> OneSide | None:
    """Oriented normals (n, 3) of points (n, 3), all on one side along a `single_view`; None: there is none.

    Land, which is flat beside its extent and seen along z, looks up; else it is the side of most of the given ones.
    """
    view = single_view(points)
    if view is None:
        return None
    extent = np.quantile(points, 0.99, axis=0) - np.quantile(points, 0.01, axis=0)
    land = bool(abs(view[2]) > STEEP and extent[2] < FLAT * extent[:2].min())
    along = normals @ view
    turned = view[2] < 0 if land else along.sum() < 0
    signs = voted_signs(points, normals, -along if turned else along)
    return OneSide(normals * signs[:, None], land)


def _shares_behind(points: Floats, directions: Floats, apart: float) -> Floats:
    """Share of points (n, 3) behind another on the same ray along each direction (m, 3), where points lie so far apart:
    (m,)."""
    aside = np.cross(directions, np.eye(3)[np.abs(directions).argmin(1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    axes = np.stack([aside, np.cross(directions, aside), directions], 1) / apart
    found = np.empty(len(directions))
    for first in range(0, len(directions), AT_ONCE):
        column, row, depth = np.moveaxis(axes[first : first + AT_ONCE] @ points.T, 1, 0)
        ray = np.floor(column / CELL) * 2.0**26 + np.floor(row / CELL)
        order = np.argsort(ray, axis=1)
        same = np.diff(np.take_along_axis(ray, order, 1), axis=1) == 0
        beyond = np.abs(np.diff(np.take_along_axis(depth, order, 1), axis=1)) > BEHIND
        found[first : first + AT_ONCE] = (same & beyond).mean(1)
    return found
