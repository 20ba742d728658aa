"""Weights that come with pnu, as safetensors: tensors and text, never code. The card beside each tells its origin."""

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from torch import Tensor

FOLDER = Path(__file__).parent
SUFFIX = ".safetensors"


def names() -> list[str]:
    """Names of the weights that come with pnu."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def find(source: str | PathLike[str]) -> Path | None:
    """The file of weights that `source` means: a shipped name, or a path of such a file; None if neither."""
    if str(source) in names():
        return FOLDER / f"{source}{SUFFIX}"
    path = Path(source)
    return path if path.suffix == SUFFIX and path.is_file() else None


def read(path: str | PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The network's config (what `models.build` takes) and its state.

    Raises:
        ValueError: the file is broken, or not one that `write` made.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            config = json.loads((file.metadata() or {}).get("model", "null"))
            state = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected weights as safetensors, found {' '.join(str(error).split())}") from error
    if not isinstance(config, dict):
        raise ValueError(f"{path}: expected weights written by pnu.export, found no network's config in their metadata")
    return config, state


def write(path: str | PathLike[str], config: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Write a network's config and state, atomically."""
    from safetensors.torch import save

    from pnu.io import atomic_path

    with atomic_path(Path(path)) as temporary:
        content = save({k: v.contiguous() for k, v in state.items()}, {"model": json.dumps(dict(config))})
        temporary.write_bytes(content)
