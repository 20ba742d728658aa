"""What every upsampler has in common."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from pnu.runtime.parts import Parts
from pnu.runtime.progress import Progress, silent
from pnu.runtime.workers import Workers


@dataclass(frozen=True)
class Context:
    """How an upsampler runs. Only the generator has an influence on what comes out."""

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    """Where the network lies, and the cloud."""
    batch_size: int | None = None
    """Patches or points at once, which bounds the memory; None: by the device."""
    generator: torch.Generator = field(default_factory=lambda: torch.Generator().manual_seed(0))
    """Of all that is drawn."""
    progress: Progress = silent
    """Called as progress(stage, done, total)."""
    parts: Parts = field(default_factory=Parts)
    """Takes finished parts of a long computation, and has those of an earlier start."""
    workers: Workers | None = None
    """Who share the work of the network; None: this process does it."""


@runtime_checkable
class Upsampler(Protocol):
    """Turns a cloud into a denser one."""

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6), points and unit normals -> (count, 6), or (count, 3) without normals.

        Both in the unit sphere, where `pnu.upsample` brings clouds, in float64; the normals that come out may have any
        length. An upsampler with an attribute `parallel` that is true gives work to `context.workers`.
        """
        ...
