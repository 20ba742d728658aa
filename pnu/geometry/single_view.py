"""Whether all of a cloud was seen from one side, as by one depth camera, told by the points alone.

Along the way to a camera nothing lies behind anything else: its points are one for each of its pixels. Along any other
way the front and the back of what bends fall together. So of many directions that one is the camera's along which no
two points lie behind each other, if there is such a one; around closed shapes there is none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.normal_sides import voted_signs
from pnu.geometry.spacing import spacing

Floats = NDArray[np.float64]

FEWEST, MOST = 200, 2048  # points that tell, and that are looked at
DIRECTIONS = 300  # of a half of the sphere
CELL, BEHIND = 0.5, 3.0  # spacings across in which two points are on one ray, and along, from which one is behind
CLEAR, SHARE = 0.01, 0.2  # of the points, and of the usual share, that may lie behind others
ALIKE = 0.002  # directions that differ by less see the same


def single_view(points: Floats) -> Floats | None:
    """Unit direction (3,) along which no point of a cloud (n, 3) lies behind another, either way; None: there is none.

    None too where that tells nothing: along most directions, as on a plane, or of fewer than 200 points.
    """
    if len(points) < FEWEST:
        return None
    if len(points) > MOST:
        points = points[farthest_points_large(points, MOST)]
    apart, directions = spacing(points), _directions()
    behind = np.array([_share_behind(points, direction, apart) for direction in directions])
    if behind.min() > min(CLEAR, SHARE * float(np.median(behind))):
        return None
    clear = directions[behind <= behind.min() + ALIKE]
    middle: Floats = np.linalg.eigh(clear.T @ clear)[1][:, -1]
    return middle


def seen_from_one_side(points: Floats, normals: Floats) -> Floats | None:
    """Oriented normals (n, 3) of points (n, 3), all on the side of most along a `single_view`; None: there is none."""
    view = single_view(points)
    if view is None:
        return None
    along = normals @ view
    along = along if along.sum() >= 0 else -along
    return normals * voted_signs(points, normals, along)[:, None]


def _directions() -> Floats:
    """Evenly spread over a half of the sphere, (DIRECTIONS, 3)."""
    i = np.arange(DIRECTIONS) + 0.5
    angle, z = np.pi * (1 + np.sqrt(5)) * i, i / DIRECTIONS
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def _share_behind(points: Floats, direction: Floats, apart: float) -> float:
    """Share of points (n, 3) behind another on the same ray along a direction (3,), where points lie so far apart."""
    aside = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    aside /= np.linalg.norm(aside)
    column, row, depth = np.stack([aside, np.cross(direction, aside), direction]) @ points.T / apart
    ray = np.floor(column / CELL) * 2.0**26 + np.floor(row / CELL)
    order = np.argsort(ray)
    return float(((np.diff(ray[order]) == 0) & (np.abs(np.diff(depth[order])) > BEHIND)).mean())
