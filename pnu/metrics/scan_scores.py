"""How good a cloud made from a scan is, where the true mesh is known, and which part of it the scan has seen."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pnu.geometry.kd_tree import kd_tree
from pnu.metrics.declared import P2F, Flipped, Metric, NormalUnsignedDeg, Shown
from pnu.metrics.functional import Pair

STRAY = 0.03  # distance from the true surface beyond which a point is stray

LEGEND = (
    "accuracy: mean distance of the points to the true mesh; p95: its 95th percentile; stray: % farther than 0.03; "
    "complete: mean distance of points of the surface that was seen to the next point; gap: the largest; all lengths "
    "x 1e3, in the unit sphere; normal: mean unsigned error in degrees; flipped: % that look inward."
)
COLUMNS = ("accuracy", "p95", "stray", "complete", "gap", "normal", "flipped")


def scan_scores(
    cloud: NDArray[np.float64], seen: NDArray[np.float64], closest: NDArray[np.float64], true: NDArray[np.float64]
) -> dict[str, float]:
    """Scores of a cloud (m, 6), see `LEGEND`.

    seen: points (s, 3) of the true surface where the scan has points. closest, true: the point of the true mesh closest
    to each of the cloud, and the unit normal there, (m, 3) each.
    """
    distance = np.linalg.norm(cloud[:, :3] - closest, axis=1)
    back = kd_tree(cloud[:, :3]).query(seen)[0]
    length = np.linalg.norm(cloud[:, 3:], axis=1) * np.linalg.norm(true, axis=1)
    cosine = np.clip((cloud[:, 3:] * true).sum(1) / np.maximum(length, 1e-300), -1, 1)
    scores: dict[str, Any] = {
        "accuracy": 1e3 * distance.mean(),
        "p95": 1e3 * np.quantile(distance, 0.95),
        "stray": 100 * (distance > STRAY).mean(),
        "complete": 1e3 * back.mean(),
        "gap": 1e3 * back.max(),
        "normal": np.degrees(np.arccos(np.abs(cosine))).mean(),
        "flipped": 100 * (cosine < 0).mean(),
    }
    return {name: float(value) for name, value in scores.items()}


class P2F95(Metric):
    """95th percentile of the distances to the true mesh."""

    shown = Shown("p2f_95", "P2F x 1e3, 95th percentile", "P2F 95", 1e3, "length")
    needs = ("mesh",)
    patches = False

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,)."""
        return pair.prediction.new_tensor(np.quantile(pair.on_mesh[0], 0.95, axis=1))


class Stray(Metric):
    """Share of the points farther than 0.03 from the true mesh."""

    shown = Shown("stray", f"stray, farther than {STRAY} (%)", "stray", 100.0, "share", ".2f")
    words = f"stray: % of the points farther than {STRAY} from the true mesh"
    needs = ("mesh",)
    patches = False

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,)."""
        return pair.prediction.new_tensor((pair.on_mesh[0] > STRAY).mean(1))


class Completeness(Metric):
    """Mean distance of the true points to the next point."""

    shown = Shown("completeness", "completeness x 1e3", "complete", 1e3, "length", ".2f")
    words = (
        "complete: mean distance of points of the truth (what a scan has seen of it) to the next point; gap: largest"
    )
    patches = False

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,)."""
        return pair.back.dist_sq.sqrt().mean(1)


class Gap(Metric):
    """Largest distance of a true point to the next point."""

    shown = Shown("gap", "largest gap x 1e3", "gap", 1e3, "length", ".1f")
    patches = False

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,)."""
        return pair.back.dist_sq.sqrt().amax(1)


SCAN_METRICS: tuple[Metric, ...] = (P2F95(), Stray(), Completeness(), Gap())
"""What is measured of clouds made from scans alone, beside `SHARED`."""

SHARED = (P2F, NormalUnsignedDeg, Flipped)
"""What is measured of them as of all clouds; P2F is their accuracy."""
