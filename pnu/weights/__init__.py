"""Weights that come with pnu, as safetensors: tensors and text, never code. The card beside each tells its origin."""

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

FOLDER = Path(__file__).parent
SUFFIX = ".safetensors"
TINY = 1e-20  # of weights: what a training has left behind
RIVALS = ("ecnet", "pnu_residual", "pugan", "pugeo", "punet")  # in the repository alone: 16 MB that no wheel carries


class Weights(NamedTuple):
    """A trained network."""

    model: dict[str, Any]  # what `networks.build_network` takes
    patch_size: int | None  # points of the patches that it was trained on; None: the network's default
    state: dict[str, Any]  # tensors, or arrays


def shipped_names() -> list[str]:
    """Names of the weights that come with pnu."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def find(source: str | PathLike[str]) -> Path | None:
    """The file of weights that `source` means: a shipped name, or a path of such a file; None if neither."""
    if str(source) in shipped_names():
        return FOLDER / f"{source}{SUFFIX}"
    path = Path(source)
    return path if path.suffix == SUFFIX and path.is_file() else None


def read(path: str | PathLike[str], kind: Literal["pt", "numpy"] = "pt") -> Weights:
    """The network that a file holds, as tensors or as arrays, which need no torch.

    Raises:
        ValueError: the file is broken, or not one that `write` made.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, kind) as file:
            metadata = file.metadata() or {}
            config, patch_size = (json.loads(metadata.get(name, "null")) for name in ("model", "patch_size"))
            state = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected weights as safetensors, found {' '.join(str(error).split())}") from error
    if not isinstance(config, dict):
        raise ValueError(
            f"{path}: expected weights written by `pnu export`, found no network's config in their metadata"
        )
    if patch_size is not None and not (type(patch_size) is int and patch_size > 0):
        raise ValueError(f"{path}: expected a whole number of points as patch_size in the metadata, found {patch_size}")
    return Weights(config, patch_size, state)


def write(
    path: str | PathLike[str], model: Mapping[str, Any], state: Mapping[str, "Tensor"], patch_size: int | None = None
) -> None:
    """Write a network, atomically; weights below 1e-20, which only cost time (`pnu.runtime.denormals`), as zero."""
    from safetensors.torch import save

    from pnu.io import atomic_path

    with atomic_path(Path(path)) as temporary:
        metadata = {"model": json.dumps(dict(model)), "patch_size": json.dumps(patch_size)}
        content = save({k: _without_tiny(v).contiguous() for k, v in state.items()}, metadata)
        temporary.write_bytes(content)


def _without_tiny(values: "Tensor") -> "Tensor":
    return values.masked_fill(values.abs() < TINY, 0) if values.is_floating_point() else values
