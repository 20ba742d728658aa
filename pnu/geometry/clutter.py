"""Clutter: points strewn all around a surface, so many that they are each other's neighbors.

Among themselves they look like a sparse cloud of their own, which what looks at neighbors takes for measured. But they
lie far apart beside the points of the surface, as nearest-neighbor clutter removal has it (Byers and Raftery 1998);
they fill space where those of a sparse place lie in a sheet; and the surface lies amid them everywhere, as it does not
among its own sparse places, nor a ground among its trees.
"""

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.fitted_planes import FittedPlanes
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spatial_blocks import some_rows
from pnu.runtime.threads import thread_count

Floats = NDArray[np.float64]
NEIGHBORS = 32  # that lie in a sheet or fill space
APART = 8  # the neighbor whose distance tells how far apart points lie
DENSE = 0.1  # share of the points, the closest ones, that are surely of a surface
FARTHER = 2.2  # times as far apart as those: points of clutter
FILLED = 0.4  # thickness of a neighborhood over its length from which on it fills space
FEWEST = 256  # points of a cloud in which a clutter is told,
MANY = 0.05  # and share of them that makes one; fewer are found one by one
AMID = 0.9, 1.6  # so many of the others have some of it within so many of its distances
STILL = 0.005  # what it hid is looked for as long as so many are found,
ROUNDS = 4  # or so often
SOME = 1000  # points that a first look takes
ROWS = 2**16  # points at once: bounds the memory


def clutter_points(points: Floats) -> NDArray[np.bool_]:
    """Which of points (n, 3) are of a clutter, (n,): none where that is less than a twentieth of them, or n below 256.

    Neither the order of rows, nor place, rotation and size have an influence. What lies within a few spacings of the
    surface is not told from it.
    """
    found, enough = np.zeros(len(points), bool), MANY
    if len(points) < FEWEST:
        return found
    if _strewn(points, some_rows(points, SOME))[0].mean() < MANY:
        return found
    for _ in range(ROUNDS):
        rows = np.flatnonzero(~found)
        if len(rows) <= NEIGHBORS:
            break
        strewn, apart = _strewn(points[rows], np.arange(len(rows)))
        if strewn.mean() < enough or strewn.all():
            break
        if not found.any():
            to_strewn = PointTree(points[strewn]).nearest(points[~strewn], 1, threads=thread_count())[0]
            if np.quantile(to_strewn, AMID[0]) > AMID[1] * np.median(apart[strewn]):
                break
        found[rows[strewn]], enough = True, STILL
    return found


def _strewn(points: Floats, rows: NDArray[np.int64]) -> tuple[NDArray[np.bool_], Floats]:
    """Whether points (m,) of those given (n, 3) lie far apart and fill space, and how far apart, (m,)."""
    tree, apart, filled = PointTree(points), np.empty(len(rows)), np.empty(len(rows), bool)
    for first in range(0, len(rows), ROWS):
        part = slice(first, first + ROWS)
        distance, near = tree.nearest(points[rows[part]], NEIGHBORS, threads=thread_count())
        size = FittedPlanes.of(points[near]).size
        apart[part], filled[part] = distance[:, APART], size[:, 0] > FILLED * size[:, 2]
    return (apart > FARTHER * np.quantile(apart, DENSE)) & filled, apart
