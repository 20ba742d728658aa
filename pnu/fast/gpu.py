"""Where Triton kernels run."""

from importlib import import_module
from types import ModuleType

import torch
from torch import Tensor


def kernels(name: str, x: Tensor) -> ModuleType | None:
    """`pnu.fast.<name>` where it can compute with x: on a GPU, with Triton, and not in float64."""
    if x.device.type != "cuda" or x.dtype == torch.float64:
        return None
    try:
        return import_module(f"pnu.fast.{name}")
    except ImportError:
        return None
