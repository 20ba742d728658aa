"""Planes fitted to groups of points, by principal components."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class FittedPlanes(NamedTuple):
    """A plane for each of m groups of points."""

    middle: Floats  # (m, 3)
    size: Floats  # (m, 3): standard deviations along the axes, ascending
    axes: Floats  # (m, 3, 3): unit vectors as columns, the first the normal

    @classmethod
    def of(cls, groups: Floats) -> "FittedPlanes":
        """Those of points (m, k, 3)."""
        middle = groups.mean(1)
        centered = groups - middle[:, None]
        variance, axes = np.linalg.eigh(centered.transpose(0, 2, 1) @ centered / groups.shape[1])
        return cls(middle, np.sqrt(np.maximum(variance, 0)), axes)
