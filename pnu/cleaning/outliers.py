"""Stray points: those that measure nothing, found by small trained networks and taken out.

Where points are strewn all around, so many that they have each other for neighbors, these go first. One network then
looks at how a point lies among its neighbors in space. What it leaves doubtful a second one holds against the surface
that all others sample, near and far: where a cloud thins out its last points are no strays. Where one camera saw all
points, another looks at how the depth of each fits to that of the pixels around it, which tells points torn off at
edges from surfaces seen at a slant.
"""

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.clutter import clutter_points
from pnu.geometry.connected_parts import connected_parts
from pnu.geometry.doubt_features import doubt_features
from pnu.geometry.outlier_features import outlier_features
from pnu.geometry.pixel_features import pixel_features
from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import thread_count

WEIGHTS = Path(__file__).parent  # all trained by pnu.training.outlier_training
DOUBTFUL = -1.0  # logarithm of the odds from which on a point is looked at again, beside those that are not,
SURE = 6.0  # and from which on it is then taken for stray,
LIKELY = 0.5  # or this where there are many: a share of
MANY = 0.0035  # of the points; tips of clean clouds, and noise of 1 % of the radius, stay below
TORN = 3.5  # in the picture of a camera
ROUNDS = 3  # a stray point hides another,
SINGLE = 3  # but so few of them none
PIECE = 12  # points below which a piece that stands apart is stray,
SPECK = 4  # and in the picture of a camera, of whose edges it may be all that is seen
APART = 6.0  # usual spacings between a piece and all others
EVEN = 0.45  # breadth of the middle 80 % of nearest distances over their median, below which points keep a distance
FITS = (0.6, 1.6)  # nearest distances over those around, of points that fit into such an order
FEWEST = 64  # points of a cloud in which strays can be told
ROWS = 2**12  # points of which a detector keeps the intermediate results at a time


@cache
def detector_weights(name: str) -> dict[str, NDArray[np.float32]]:
    """Those of a `pnu.networks.outlier_detector.OutlierDetector` of pnu: "outliers", "doubtful" or "torn"."""
    from safetensors.numpy import load_file

    return load_file(WEIGHTS / f"{name}.safetensors")


def stray_odds(features: NDArray[np.float32], name: str = "outliers") -> NDArray[np.float32]:
    """Logarithm of the odds that each point is stray, (n,), of features as a detector wants them."""
    weights, odds = detector_weights(name), np.empty(len(features), np.float32)
    for first in range(0, len(features), ROWS):
        part = slice(first, first + ROWS)
        values = (features[part] - weights["mean"]) / weights["deviation"]
        for layer in (0, 2, 4):
            values = values @ weights[f"layers.{layer}.weight"].T
            values += weights[f"layers.{layer}.bias"]
            if layer < 4:
                np.maximum(values, 0, out=values)
        odds[part] = values[:, 0]
    return odds


def stray_points(points: NDArray[np.float64], camera: NDArray[np.float64] | None = None) -> NDArray[np.bool_]:
    """Which of the points (n, 3) are stray, (n,): what the detector finds, then small pieces.

    Rows may be in any order; place, rotation and size have no influence. Clouds of fewer than 64 points have none.
    camera: the place (3,) from which all were seen, one a pixel (`pnu.geometry.single_view.camera_place`).
    """
    stays = np.ones(len(points), bool)
    if len(points) >= FEWEST:
        stays = _in_space(points) if camera is None else stray_odds(pixel_features(points, camera), "torn") <= TORN
    rows = np.flatnonzero(stays)
    if len(rows) >= FEWEST:
        stays[rows[small_pieces(points[rows], PIECE if camera is None else SPECK)]] = False
    return ~stays


def _in_space(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (n, 3) stay, (n,)."""
    stays, enough = ~clutter_points(points), SURE
    for _ in range(ROUNDS):
        rows = np.flatnonzero(stays)
        if len(rows) < FEWEST:
            break
        odds = _settled_odds(points[rows])
        if (odds > LIKELY).mean() > MANY:
            enough = LIKELY
        stray = odds > enough
        if stray.any():
            stray &= ~fit_in_order(points[rows])
        stays[rows[stray]] = False
        if stray.sum() <= SINGLE:
            break
    return stays


def _settled_odds(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """As `stray_odds`, (n,), of points (n, 3) at a first look, and of the doubtful ones at a second."""
    odds = stray_odds(outlier_features(points))
    doubtful = odds > DOUBTFUL
    if doubtful.any() and (~doubtful).sum() >= FEWEST:
        features = doubt_features(points[doubtful], points[~doubtful], odds[doubtful])
        odds[doubtful] = stray_odds(features, "doubtful")
    return odds


def fit_in_order(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of evenly spread points (n, 3) have their nearest one as far away as others around, (n,); else none.

    On tips and rods the points of such a cloud stand alone, but in order; what measures nothing would lie anyhow.
    """
    distance, near = PointTree(points).nearest(points, 9, threads=thread_count())
    apart = distance[:, 1]
    narrow, usual, wide = np.quantile(apart, (0.1, 0.5, 0.9))
    if wide - narrow >= EVEN * usual:
        return np.zeros(len(points), bool)
    share = apart / np.maximum(np.median(apart[near[:, 1:]], 1), 1e-300)
    fits: NDArray[np.bool_] = (share > FITS[0]) & (share < FITS[1])
    return fits


def small_pieces(points: NDArray[np.float64], fewest: int = PIECE) -> NDArray[np.bool_]:
    """Which of the points (n, 3) belong to a piece of fewer than `fewest` that stands apart from all others, (n,)."""
    k = min(PIECE, len(points) - 1)
    distance, near = PointTree(points).among_themselves(k + 1, threads=thread_count())
    reach = APART * np.median(distance[near, min(5, k - 1)], 1)
    linked = distance <= np.maximum(reach[:, None], reach[near])
    first = np.broadcast_to(np.arange(len(points))[:, None], near.shape)[linked]
    piece = connected_parts(first, near[linked], len(points))
    small: NDArray[np.bool_] = (np.bincount(piece) < fewest)[piece]
    return small
