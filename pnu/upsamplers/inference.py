"""A model made ready for use: found by its name, read, on its device, in eval mode, without gradients."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pnu.cleaning import Character
from pnu.networks import checkpoints
from pnu.networks.compiled_surface import CompiledSurface, read_compiled
from pnu.runtime import denormals
from pnu.runtime.threads import torch_if_loaded
from pnu.upsamplers.selection import CLASSICAL, classical

if TYPE_CHECKING:
    import torch
    from torch import nn

WITHOUT_NORMALS: dict[Character, str] = {
    "clean": "surface_estimated", "scanned": "surface_scans", "noisy": "surface_noisy",
}  # fmt: skip
DRIVERS = ("/dev/nvidiactl", "/dev/dxg", "/dev/kfd")  # where one of them is, torch may find a GPU


def weights_source(
    model: str | PathLike[str], normals: np.ndarray | None, character: Character = "clean"
) -> str | PathLike[str]:
    """What `checkpoints.load` takes, for a cloud with these normals: "surface" means one of four, "newest" a run."""
    if model == "surface" and normals is None:
        return WITHOUT_NORMALS[character]
    return checkpoints.resolve(model)


class LoadedWeights:
    """The network of a run folder, of a file of weights or of shipped ones, read when first needed, and kept.

    Args:
        source: what `upsample` takes as `model`, as text or a path.

    Raises:
        ValueError: "newest", and no run has finished.
    """

    def __init__(self, source: str | PathLike[str]) -> None:
        self.source = checkpoints.resolve(source)
        self.read: dict[tuple[str, bool], Any] = {}

    def network(self, normals: np.ndarray | None = None, character: Character = "clean", device: str = "auto") -> Any:
        """That for a cloud with these normals, see `weights_source`.

        On the CPU it is one of compiled kernels, for which torch is not imported, where they know it.
        """
        meant, on_cpu = str(weights_source(self.source, normals, character)), is_cpu(device)
        if (meant, on_cpu) not in self.read:
            self.read[meant, on_cpu] = (
                classical(meant)
                if meant in CLASSICAL
                else (read_compiled(meant) if on_cpu else None) or checkpoints.load(meant)
            )
        return self.read[meant, on_cpu]


def is_cpu(device: str) -> bool:
    """Whether a device, as torch names it or "auto", is the CPU, found out without importing torch."""
    if device != "auto":
        return device == "cpu"
    torch = torch_if_loaded()
    if torch is not None:
        return not torch.cuda.is_available()
    windows = Path(os.environ.get("SYSTEMROOT", "C:/Windows")) / "System32" / "nvcuda.dll"
    drivers = (windows,) if sys.platform == "win32" else map(Path, DRIVERS)
    return not any(path.exists() for path in drivers)


def modules_of(model: object) -> list[nn.Module]:
    """All modules of a network of torch; of anything else, none."""
    torch = torch_if_loaded()
    return list(model.modules()) if torch is not None and isinstance(model, torch.nn.Module) else []


@contextmanager
def inferring(model: object) -> Iterator[None]:
    """A network made fast and in eval mode, without gradients; all as it was in the end."""
    if isinstance(model, CompiledSurface):
        yield
        return
    import torch

    from pnu.fast import accelerated

    with torch.no_grad(), denormals.as_zero(), evaluating(model), accelerated(modules_of(model)), ExitStack() as stack:
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        yield


@contextmanager
def evaluating(model: object) -> Iterator[None]:
    """A network in eval mode, each of its modules in its own mode again in the end."""
    training = [module for module in modules_of(model) if module.training]
    for module in training:
        module.training = False
    try:
        yield
    finally:
        for module in training:
            module.training = True


def on_device(model: Any, given: bool, device: str) -> tuple[Any, torch.device | str]:
    """The network on a device, and which; one that is given and lies elsewhere is copied, not moved."""
    if isinstance(model, CompiledSurface):
        return model, "cpu"
    import torch

    tensors = [tensor for module in modules_of(model) for tensor in (*module.parameters(False), *module.buffers(False))]
    if device != "auto":
        try:
            torch.empty(0, device=device)
        except (RuntimeError, AssertionError):
            raise ValueError(f"device={device}: is not here; expected auto, cpu, or cuda where there is one") from None
        target = torch.device(device)
    elif given:
        target = tensors[0].device if tensors else torch.device("cpu")
    else:
        target = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if all(tensor.device == target for tensor in tensors):
        return model, target
    return (copy.deepcopy(model) if given else model).to(target), target
