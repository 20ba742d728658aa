"""What a cloud is like, before anything is made of it: spacing, evenness, noise."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnu.ops.noise import noise_level

NEIGHBOURS = 8
PLACES = 4000
UNEVEN = 2.0  # random points of an even density stay below
FAINT = 0.05  # noise in spacings that does not stand out from curvature


class Survey(NamedTuple):
    """Lengths in the unit of the cloud."""

    dense: float  # spacing where a tenth of the points lie closer: what as many points have if evenly spread
    middle: float
    sparse: float  # where a tenth of them lie farther apart
    noise: float  # standard deviation across the surface, an upper bound
    radius: float  # largest distance from the middle of the box

    @property
    def uneven(self) -> bool:
        return self.sparse > UNEVEN * self.dense

    def __str__(self) -> str:
        spread = f"{self.middle:.3g}, {'uneven' if self.uneven else 'even'} ({self.dense:.3g} to {self.sparse:.3g})"
        share = f"{self.noise / self.middle:.2g} of it, {100 * self.noise / self.radius:.2g} % of the radius"
        faint = self.noise < FAINT * self.middle
        return f"spacing {spread}; " + (f"no noise to speak of (below {share})" if faint else f"noise about {share}")


def survey(points: NDArray, normals: NDArray | None = None) -> Survey:
    """Spacing and noise of a cloud (n, 3), n >= 16; normals (n, 3) tell the sides of thin walls apart."""
    k = min(NEIGHBOURS, len(points) - 1)
    far = cKDTree(points).query(points[:: -(-len(points) // PLACES)], k=[k + 1])[0]
    dense, middle, sparse = (float(value) for value in np.quantile(far * np.sqrt(np.pi / k), (0.1, 0.5, 0.9)))
    units = None if normals is None else normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    noise = noise_level(torch.from_numpy(points), None if units is None else torch.from_numpy(units))
    center = (points.min(0) + points.max(0)) / 2
    return Survey(dense, middle, sparse, noise, float(np.linalg.norm(points - center, axis=1).max()))
