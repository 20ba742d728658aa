"""Where a cloud ends: the rims of holes and of open surfaces."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pnu.geometry.kd_tree import kd_tree

NEIGHBORS = 24
GAP = 0.75 * np.pi  # angle without neighbors, seen from a point on a rim; 24 random ones leave it once in 2000
FLAT = 0.1  # variance across the plane of the neighbors, in the smaller one along it: more is the lip of a thin wall
REACH = 4.0  # spacings between points of one rim
FEWEST = 12  # points of a rim
MOST = 30_000  # points that are looked at


class OpenRim(NamedTuple):
    """The points around one hole, or along one border."""

    rows: NDArray[np.int64]  # (k,) of the cloud
    radius: float  # largest distance from their middle


def open_rims(points: NDArray[np.float64]) -> list[OpenRim]:
    """The rims of a cloud (n, 3), the widest first; of more than 30000 points every k-th is looked at.

    A point is on a rim where its 24 nearest, seen along the normal of their plane, leave an angle of 135 degrees free.

    Source: the angle criterion of Bendels, Schnabel and Klein, Detecting holes in point set surfaces, 2006.
    """
    step = -(-len(points) // MOST)
    some = points[::step]
    if len(some) <= NEIGHBORS:
        return []
    tree = kd_tree(some)
    distance, near = tree.query(some, k=NEIGHBORS + 1)
    around = some[near[:, 1:]] - some[:, None]
    centered = around - around.mean(1, keepdims=True)
    variances, axes = np.linalg.eigh(centered.transpose(0, 2, 1) @ centered)  # of the plane the last two
    angles = np.sort(np.arctan2((around @ axes[:, :, 2:])[..., 0], (around @ axes[:, :, 1:2])[..., 0]), axis=1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi)
    rows = np.flatnonzero((gaps.max(1) > GAP) & (variances[:, 0] < FLAT * variances[:, 1]))
    if len(rows) < FEWEST:
        return []
    spacing = float(np.median(distance[:, -1])) * np.sqrt(np.pi / NEIGHBORS)
    pairs = kd_tree(some[rows]).query_pairs(REACH * spacing, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), bool), pairs.T), (len(rows), len(rows)))
    piece = connected_components(links, directed=False)[1]
    found = []
    for number in np.flatnonzero(np.bincount(piece) >= FEWEST):
        own = rows[piece == number]
        middle = (some[own].min(0) + some[own].max(0)) / 2
        found.append(OpenRim(step * own, float(np.linalg.norm(some[own] - middle, axis=1).max())))
    return sorted(found, key=lambda rim: -rim.radius)
