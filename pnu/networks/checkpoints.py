"""Run folders: find one, and read the network that it holds.

    outputs/<date>/<time>_<name>/config.yaml             resolved config; its `model` is for `networks.build_network`
                                 checkpoints/best.ckpt   and last.ckpt: "state_dict" with the network under "model."
                                 run.json                status, versions, git revision, wall time ...

Checkpoints are read with `weights_only=True`: tensors and plain types, never code.
"""

from __future__ import annotations

import datetime
import io
import json
import shutil
import uuid
import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from pnu import networks, weights
from pnu.io import atomic_path, write_json

if TYPE_CHECKING:
    from torch import Tensor, nn

PREFIX = "model."
NEWEST = "newest"  # instead of a run folder


def load(source: str | PathLike[str], allow: Sequence[str] = ()) -> nn.Module:
    """The trained network of a run folder, of a file of weights, or of that shipped name, on the CPU, in eval mode.

    "newest" is the run that finished last under outputs/. Generators and settings of torch are left alone, and have no
    influence.

    Args:
        source: run folder, file of weights, name of shipped weights, or "newest".
        allow: packages of your own whose networks may be built too; they run their code. A run's own config has no say.

    Raises:
        ValueError: no run folder, or its config or checkpoint are not those of a network of ours.

    Example:
        >>> import pnu
        >>> network = pnu.load("surface")
        >>> network.ratio, network.training
        (4, False)
    """
    source = resolve(source)
    if (file := weights.find(source)) is not None:
        model, points, tensors = weights.read(file)
        network = _unfilled(model, allow)
        if points is not None:
            network.patch_size = points  # type: ignore[assignment]
        fill(network, tensors, file)
        return network.eval()
    folder = Path(source)
    if not folder.is_dir():
        if str(source) in weights.RIVALS:
            raise ValueError(
                f"run={source}: these weights do not come with the package; take pnu/weights/{source}{weights.SUFFIX}"
                f" from the repository and give run={source}{weights.SUFFIX}"
            )
        raise ValueError(
            f"run={folder}: expected a run folder, such as outputs/<date>/<time>_<name>, or a name of shipped weights"
            f" ({', '.join(weights.shipped_names())}), found no folder"
        )
    config = run_config(folder)
    network = _unfilled(config["model"], allow)
    points = config["data"].get("input_points") if isinstance(config.get("data"), dict) else None
    if isinstance(points, int):
        network.patch_size = points  # type: ignore[assignment]  # radii are fractions of a patch: what it was trained on
    path = checkpoint_path(folder)
    state = read_checkpoint(path).get("state_dict")
    if not isinstance(state, Mapping):
        raise ValueError(f"{path}: expected a checkpoint with a 'state_dict', found none")
    fill(network, {key.removeprefix(PREFIX): v for key, v in state.items() if key.startswith(PREFIX)}, path)
    return network.eval()


def resolve(source: str | PathLike[str]) -> str | PathLike[str]:
    """The source, or the newest finished run where it is "newest"; ValueError if there is none."""
    if source != NEWEST:
        return source
    if (run := newest_run()) is None:
        raise ValueError("run=newest: no finished run under outputs/; train one with `make train`, or give run=FOLDER")
    return run


def _unfilled(config: Mapping[str, Any], allow: Sequence[str]) -> nn.Module:
    """The network of a config, to be filled, in float32; what it draws at first leaves no trace in the generator."""
    import torch

    with torch.device("cpu"), torch.random.fork_rng(devices=[]):
        return networks.build_network(config, allow).float()


def run_config(folder: Path) -> dict[str, Any]:
    """A run folder's config.yaml, whose group `model` is a dict."""
    path = folder / "config.yaml"
    if not path.is_file():
        raise ValueError(f"run={folder}: expected a run folder with config.yaml, found none")
    try:
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: is not YAML ({' '.join(str(error).split())}); restore or remove it") from error
    if not isinstance(config, dict) or not isinstance(config.get("model"), dict):
        raise ValueError(f"{path}: expected a group 'model' with the network's _target_ and arguments, found none")
    return config


def checkpoint_path(folder: Path) -> Path:
    """checkpoints/best.ckpt of a run folder, or last.ckpt while there is no best."""
    for name in ("best.ckpt", "last.ckpt"):
        if (path := folder / "checkpoints" / name).is_file():
            return path
    raise ValueError(f"run={folder}: expected checkpoints/best.ckpt or checkpoints/last.ckpt, found neither")


def read_checkpoint(path: str | PathLike[str]) -> dict[str, Any]:
    """A checkpoint's dict, read as tensors, plain types and NumPy scalars; ValueError if it holds anything else."""
    import torch

    scalar = np.float64(0).__reduce__()[0]  # what a pickled NumPy scalar calls
    numbers: list[Any] = [(scalar, "numpy.core.multiarray.scalar"), scalar, np.dtype]
    try:
        with (
            warnings.catch_warnings(action="ignore", category=UserWarning),
            torch.serialization.safe_globals([*numbers, *{type(np.dtype(kind)) for kind in "fdilq"}]),
        ):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # the unpickler raises anything on a broken file
        raise ValueError(
            f"{path}: expected a checkpoint of tensors and plain types, found a broken file or one with other objects"
        ) from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a checkpoint with a dict, found {type(content).__name__}")
    return content


def write_checkpoint(path: str | PathLike[str], content: Mapping[str, Any]) -> None:
    """Write a checkpoint, whole or not at all."""
    import torch

    buffer = io.BytesIO()  # where torch itself writes to a full disk, its error does not say so
    torch.save(dict(content), buffer)
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as file, buffer.getbuffer() as raw:
        file.write(raw)


def fill(network: nn.Module, state: Mapping[str, Tensor], source: str | PathLike[str]) -> None:
    """Load a state into a network; ValueError with the first difference if it is another network's."""
    own = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in state.items()}
    for name in [*own, *found]:
        if own.get(name) != found.get(name):
            is_, should = found.get(name, "missing"), own.get(name, "unknown")
            expected = f"expected the state of {type(network).__name__} with the arguments of its config"
            raise ValueError(f"{source}: {expected}, found another network's: {name} is {is_}, not {should}")
    network.load_state_dict(dict(state))


def start_from(network: nn.Module, other: nn.Module, source: str | PathLike[str]) -> None:
    """`fill` with the state of another network, for a training that goes on from it.

    Parts that the network says are optional, by the beginning of their names, stay new where the other has none, and
    are left out where only the other has them. So is what weights have beyond the other's, where it says that their
    width may differ.
    """
    state, own = other.state_dict(), network.state_dict()
    for name in getattr(network, "widths", ()):
        its, mine = state.get(name), own[name]
        if its is not None and its.dim() == mine.dim() and its.shape != mine.shape:
            both = tuple(slice(min(sizes)) for sizes in zip(its.shape, mine.shape, strict=True))
            if its[both].shape in (its.shape, mine.shape):
                state[name] = mine.clone()
                state[name][both] = its[both]
    for part in getattr(network, "optional", ()):
        new = {name: value for name, value in own.items() if name.startswith(part)}
        if not new or not any(name.startswith(part) for name in state):
            state = {name: value for name, value in state.items() if not name.startswith(part)} | new
    fill(network, state, source)


def save(folder: Path, network: nn.Module, config: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Make a finished run folder of a network that was not trained here; it appears whole or not at all.

    Args:
        folder: must not exist; its parent must.
        network: of the class and arguments in `config`.
        config: group `model` of the run's config.yaml.
        record: what run.json says beside status and ratio.
    """
    temporary = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:12]}")
    try:
        (temporary / "checkpoints").mkdir(parents=True)
        (temporary / "config.yaml").write_text(yaml.safe_dump({"model": dict(config)}), encoding="utf-8")
        state = {PREFIX + name: value for name, value in network.state_dict().items()}
        write_checkpoint(temporary / "checkpoints" / "best.ckpt", {"state_dict": state})
        write_json(temporary / "run.json", {"status": "finished", "ratio": network.ratio, **record})
        temporary.rename(folder)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def newest_run(root: str | PathLike[str] = "outputs") -> Path | None:
    """The run below `root` that ended last of those that finished, or None."""
    finished = []
    for path in Path(root).rglob("run.json"):
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        whole = (path.parent / "config.yaml").is_file() and any((path.parent / "checkpoints").glob("*.ckpt"))
        if whole and isinstance(record, dict) and record.get("status") == "finished":
            finished.append((_ended(record, path), str(path.parent), path.parent))
    return max(finished)[2] if finished else None


def _ended(record: Mapping[str, Any], path: Path) -> float:
    """When a run ended, in seconds since 1970: as its record says, or else when that was written."""
    try:
        return datetime.datetime.fromisoformat(str(record.get("ended"))).timestamp()
    except ValueError:
        return path.stat().st_mtime
