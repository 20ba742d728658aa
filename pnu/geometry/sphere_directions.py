"""Evenly spread directions."""

import numpy as np


def sphere_directions(count: int, turn: float = 0.0) -> np.ndarray:
    """A spiral of golden angles down the unit sphere, its z axis first: (count, 3); turned about that axis."""
    i = np.arange(count) + 0.5
    angle, z = np.pi * (1 + np.sqrt(5)) * i + turn, 1 - 2 * i / count
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
