"""Finished parts of a long computation, in files: after an interruption it goes on from them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pnu.io import atomic_path

Keep = Callable[[str, Callable[[], Tensor]], Tensor]
"""keep(name, compute): the tensor that `compute` gives, now or earlier under this name."""


def forget(name: str, compute: Callable[[], Tensor]) -> Tensor:
    """Keeps nothing."""
    return compute()


class Parts:
    """Keeps tensors in a folder, each in a file that is there whole or not at all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def __call__(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        path = self.folder / f"{name}.npy"
        if path.is_file():
            return torch.from_numpy(np.load(path, allow_pickle=False))
        values = compute()
        with atomic_path(path) as temporary:
            np.save(temporary, values.cpu().numpy())
        return values
