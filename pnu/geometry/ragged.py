"""Lists of different lengths, one after another, worked on a part at a time."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

CHUNK = 1 << 21  # entries at a time: bounds the memory


def expand_counts(count: Index) -> tuple[Index, Index]:
    """`count[i]` entries for each i: (owner, 0-based number within the owner)."""
    owner = np.repeat(np.arange(len(count)), count)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)


def chunks(count: Index) -> list[slice]:
    """Consecutive slices of the owners, each with about CHUNK entries in all (or one owner)."""
    edges = np.searchsorted(np.cumsum(count), np.arange(CHUNK, count.sum() + CHUNK, CHUNK), side="left") + 1
    edges = np.unique(np.concatenate([[0], np.minimum(edges, len(count))]))
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]
