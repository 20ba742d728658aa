"""From where a cloud was seen, told by its points alone: by a camera at the origin, or all from one side.

A camera's points lie one a pixel: seen from its place, in even rows and columns. Along the way to it nothing lies
behind anything else; along any other way the front and the back of what bends fall together. So of many directions that
one is the camera's along which no two points lie behind each other, if there is such a one; around closed shapes there
is none.
"""

from __future__ import annotations

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

FEWEST, MOST = 200, 2048  # points that tell, and that are looked at
DIRECTIONS = 300  # of a half of the sphere
CELL, BEHIND = 0.5, 3.0  # spacings across in which two points are on one ray, and along, from which one is behind
CLEAR, SHARE = 0.02, 0.2  # of the points, and of the usual share, that may lie behind others
ALIKE = 0.002  # directions that differ by less see the same
NEAREST, FARTHEST = 1.2, 10.0  # radii of a cloud from its middle to a camera that saw it from outside
BLOCK = 4096  # points in which pixels are looked for:
SAME, SQUARE = 1.1, 1.35  # angles to the second and the fourth neighbor, over the nearest's, that are hardly wider,
PAIRS, FOURS = 0.85, 0.7  # and the shares of the points that have them
STEEP, FLAT = 0.95, 0.25  # of land: cosine of the way it was seen with z; height over its extent


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
    behind = np.array([_share_behind(points, direction, apart) for direction in directions])
    if behind.min() > min(CLEAR, SHARE * float(np.median(behind))):
        return None
    clear = directions[behind <= behind.min() + ALIKE]
    return np.asarray(np.linalg.eigh(clear.T @ clear)[1][:, -1])


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


def _share_behind(points: Floats, direction: Floats, apart: float) -> float:
    """Share of points (n, 3) behind another on the same ray along a direction (3,), where points lie so far apart."""
    aside = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    aside /= np.linalg.norm(aside)
    column, row, depth = np.stack([aside, np.cross(direction, aside), direction]) @ points.T / apart
    ray = np.floor(column / CELL) * 2.0**26 + np.floor(row / CELL)
    order = np.argsort(ray)
    return float(((np.diff(ray[order]) == 0) & (np.abs(np.diff(depth[order])) > BEHIND)).mean())
