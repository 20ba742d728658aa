"""How matrices lie for products: panels of PANEL columns, one after another, each row by row."""

import os

import numpy as np
from llvmlite import binding
from numpy.typing import NDArray


def _lanes() -> int:
    features = binding.get_host_cpu_features()
    return int(os.environ.get("PNU_LANES") or (16 if features.get("avx512f") else 8))


LANES = _lanes()  # float32 that the processor computes with at once
VECTORS = 4 if LANES == 16 else 2  # beside each other: 32 registers, or 16
PANEL = VECTORS * LANES
NARROW = 2 * LANES  # a panel of networks no wider than that


def panel_of(width: int) -> int:
    """Columns of the panels of a network."""
    return NARROW if width <= NARROW else PANEL


def padded(width: int) -> int:
    """Columns that as many fill up to whole panels."""
    return -(-width // panel_of(width)) * panel_of(width)


def pack(matrix: NDArray[np.float32], columns: int) -> NDArray[np.float32]:
    """A matrix (depth, width) as flat panels; its width is a multiple of `columns`."""
    depth, width = matrix.shape
    panels = matrix.reshape(depth, width // columns, columns).transpose(1, 0, 2)
    return np.ascontiguousarray(panels, np.float32).ravel()
