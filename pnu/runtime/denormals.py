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
    import torch

    before = are_zero()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
