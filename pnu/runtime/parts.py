"""Finished parts of a long computation, in files: after an interruption it goes on from them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu.io import atomic_path

Array = NDArray[Any]


class Parts:
    """Arrays by name, each in a file of a folder that is there whole or not at all; without a folder none is kept."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder

    def within(self, name: str) -> "Parts":
        """Others, in a folder of theirs, whose names may be the same."""
        return Parts(None if self.folder is None else self.folder / name)

    def get(self, name: str, compute: Callable[[], Array]) -> Array:
        """The array that `compute` gives, now or earlier under this name."""
        if self.folder is None:
            return compute()
        path = self.folder / f"{name}.npy"
        if path.is_file():
            found: Array = np.load(path, allow_pickle=False)
            return found
        values = compute()
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            np.save(temporary, values)
        return values
