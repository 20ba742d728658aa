"""Run folders: find one, and read the network that it holds.

    outputs/<date>/<time>_<name>/config.yaml             resolved config; its group `model` is what `models.build` takes
                                 checkpoints/best.ckpt   and last.ckpt: "state_dict" with the network under "model."
                                 run.json                status, versions, git revision, wall time ...

Checkpoints are read with `weights_only=True`: tensors and plain types, never code.
"""

import json
import pickle
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor, nn

from pnu import models

PREFIX = "model."


def load(source: str | PathLike[str]) -> nn.Module:
    """The trained network of a run folder, on the CPU, in eval mode.

    Raises:
        ValueError: no run folder, or its config or checkpoint are not those of a network of ours.
    """
    folder = Path(source)
    if not folder.is_dir():
        raise ValueError(f"run: expected a run folder, such as outputs/<date>/<time>_<name>, found no folder {folder}")
    network = models.build(model_config(folder))
    path = checkpoint_path(folder)
    state = read(path).get("state_dict")
    if not isinstance(state, Mapping):
        raise ValueError(f"{path}: expected a checkpoint with a 'state_dict', found none")
    fill(network, {key.removeprefix(PREFIX): v for key, v in state.items() if key.startswith(PREFIX)}, path)
    return network.eval()


def model_config(folder: Path) -> dict[str, Any]:
    """The group `model` of a run folder's config.yaml."""
    path = folder / "config.yaml"
    if not path.is_file():
        raise ValueError(f"run: expected a run folder with a config.yaml, found none in {folder}")
    try:
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected YAML, found {' '.join(str(error).split())}") from error
    if not isinstance(config, dict) or not isinstance(config.get("model"), dict):
        raise ValueError(f"{path}: expected a group 'model' with the network's _target_ and arguments, found none")
    return config["model"]


def checkpoint_path(folder: Path) -> Path:
    """checkpoints/best.ckpt of a run folder, or last.ckpt while there is no best."""
    for name in ("best.ckpt", "last.ckpt"):
        if (path := folder / "checkpoints" / name).is_file():
            return path
    raise ValueError(f"{folder}: expected checkpoints/best.ckpt or checkpoints/last.ckpt, found neither")


def read(path: str | PathLike[str]) -> dict[str, Any]:
    """A checkpoint's dict, read as tensors and plain types; ValueError if it is anything else."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError) as error:
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        raise ValueError(f"{path}: expected a checkpoint of tensors and plain types, found {reason}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a checkpoint with a dict, found {type(content).__name__}")
    return content


def fill(network: nn.Module, state: Mapping[str, Tensor], source: str | PathLike[str]) -> None:
    """Load a state into a network; ValueError with the first difference if it is another network's."""
    own = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in state.items()}
    for name in [*own, *found]:
        if own.get(name) != found.get(name):
            ours, theirs = own.get(name, "nothing"), found.get(name, "nothing")
            raise ValueError(
                f"{source}: expected the state of {type(network).__name__} as in config.yaml, "
                f"found another one's: {name} is {theirs} instead of {ours}"
            )
    network.load_state_dict(dict(state))


def newest_run(root: str | PathLike[str] = "outputs") -> Path | None:
    """The run below `root` that finished last, or None."""
    finished = []
    for path in Path(root).rglob("run.json"):
        try:
            status = json.loads(path.read_text(encoding="utf-8")).get("status")
        except (OSError, ValueError, AttributeError):
            continue
        if status == "finished" and any((path.parent / "checkpoints").glob("*.ckpt")):
            finished.append((path.stat().st_mtime_ns, path.parent))
    return max(finished)[1] if finished else None
