"""Loops over points compiled for this machine's processor with numba: arrays in, arrays out, no torch.

`ready` is the one switch. Whoever asks it has another way that gives the same numbers, and takes that where numba is
missing, `PNU_FAST=0` is set, or the kernels are not compiled yet (`pnu.kernels.compilation`).

| file | what |
|---|---|
| `compilation` | where compiled code is kept, and how it comes there |
| `code_writing`, `code_loading` | machine code that is kept, and called without numba |
| `vectors`, `tiles`, `panels` | several float32 at once, matrix products made of them, and how matrices lie for them |
| `boxes` | a cloud in the order of a tree of boxes, on which the next two search |
| `neighbors`, `greedy_sampling` | the k nearest points, and farthest point sampling |
| `dipoles` | winding numbers and fields, from which orientation comes |
| `planes` | fits to neighborhoods, and what tells stray points by them |
| `pushes` | the step by which points push their neighbors apart |
| `frames`, `projector` | the surface model: local frames and spheres; the network on them |
"""

import os

from pnu.kernels.compilation import complete


def ready() -> bool:
    """Whether compiled kernels answer here and now; importing them takes a fraction of a second then."""
    return os.environ.get("PNU_FAST") != "0" and complete()
