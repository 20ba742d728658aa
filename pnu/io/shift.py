"""Coordinates too far from the origin for single precision: written less a shift that the file names."""

import re
from typing import NamedTuple

import numpy as np

ENOUGH = 1e-6  # of the extent: what single precision may move a point by


class Shifted(NamedTuple):
    """points (n, 3) float32; `text` says what they were shifted by, empty for nothing."""

    points: np.ndarray
    text: str

    @property
    def notes(self) -> tuple[str, ...]:
        """The line on a shift; none where there was none."""
        return (f"coordinates are in single precision, less a shift that the file names: {self.text}",) * bool(
            self.text
        )


def single_is_enough(points: np.ndarray) -> bool:
    """Whether float32 keeps points to a millionth of their extent."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = np.abs(points.astype(np.float32) - points).max(initial=0)
    return bool(moved <= ENOUGH * np.ptp(points, axis=0).max(initial=0))


def shifted(points: np.ndarray) -> Shifted:
    """Points (n, 3) in single precision, about a round place near their middle where they have no digits left else."""
    if single_is_enough(points):
        return Shifted(points.astype(np.float32), "")
    middle = (points.min(0) + points.max(0)) / 2
    extent = np.ptp(points, axis=0).max() or np.abs(middle).max()
    shift = np.round(middle, -int(np.floor(np.log10(extent))))
    text = "shift " + " ".join(f"{value:.15g}" for value in shift)
    known = read_shift(text)
    return Shifted((points - known).astype(np.float32), text)


def read_shift(header: str) -> np.ndarray | None:
    """What is to be added to the coordinates, (3,); None where a header names no shift."""
    found = re.search(r"\bshift((?: [-+.e\d]+){3})", header)
    try:
        shift = np.array(found[1].split(), np.float64) if found else None
    except ValueError:
        return None
    return shift if shift is not None and np.isfinite(shift).all() else None
