"""What every upsampler has in common."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from pnu.runtime.parts import Parts
from pnu.runtime.progress import Progress, silent
from pnu.runtime.workers import Workers
from pnu.upsamplers.density import Density


@dataclass(frozen=True)
class Context:
    """How an upsampler runs. Generator, density and keep have an influence on what comes out, nothing else."""

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
    density: Density = "auto"
    """Of what comes out: even, follow the cloud's, or auto: even where no place loses points by it."""
    keep: bool = False
    """Whether the points of the cloud are to be among those that come out, unmoved."""


@runtime_checkable
class Upsampler(Protocol):
    """Turns a cloud into a denser one."""

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6), points and unit normals -> (count, 6), or (count, 3) without normals.

        Both in the unit sphere, where `pnu.upsample` brings clouds, in float64; the normals that come out may have any
        length. An upsampler with an attribute `parallel` that is true gives work to `context.workers`,
        one with `follows` minds `context.density` and `context.keep`.
        """
        ...
