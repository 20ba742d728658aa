"""Numbers below 1e-38, which are stored without a leading one, taken for zero.

Weights that a training leaves behind shrink to such numbers, and processors of Intel take some hundred times as long
for each product of them: a step of such a network takes up to ten times as long, and what comes out is the same.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


def are_zero() -> bool:
    """Whether this thread takes them for zero."""
    return float(np.float32(1e-38) * np.float32(1e-2)) == 0.0


@contextmanager
def as_zero() -> Iterator[None]:
    """Take them for zero in this thread, and in those that `pnu.runtime.threads` works on; as it was in the end."""
    with _set(True):
        yield


@contextmanager
def as_numbers() -> Iterator[None]:
    """Take them for what they are in this thread; as it was in the end."""
    if not are_zero():
        yield
        return
    with _set(False):
        yield


@contextmanager
def _set(zero: bool) -> Iterator[None]:
    import torch

    before = are_zero()
    torch.set_flush_denormal(zero)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
