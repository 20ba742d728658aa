"""What every upsampler has in common."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

from pnu.runtime.parts import Parts
from pnu.runtime.progress import Progress, silent
from pnu.runtime.workers import Workers
from pnu.upsamplers.density import Density

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Merge = Literal["farthest", "agreed"]


@dataclass(frozen=True)
class Context:
    """How an upsampler runs. What comes out depends on seed, density, keep, smooth and merge, on nothing else."""

    device: torch.device | str = "cpu"
    """Where the network lies, and the cloud."""
    batch_size: int | None = None
    """Patches or points at once, which bounds the memory; None: by the device."""
    seed: int = 0
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
    smooth: bool = False
    """Whether points were found too noisy for that, and are to be smoothed even where refined normals show less."""
    merge: Merge = "farthest"
    """Of the predictions of patches that overlap, see `pnu.upsamplers.patches`."""

    @cached_property
    def generator(self) -> torch.Generator:
        """Draws all that is drawn, from the seed on."""
        import torch

        return torch.Generator().manual_seed(self.seed)


@runtime_checkable
class Upsampler(Protocol):
    """Turns a cloud into a denser one."""

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6), points and unit normals -> (count, 6), or (count, 3) without normals.

        Both in the unit sphere, where `pnu.upsample` brings clouds, in float64; the normals that come out may have any
        length. An upsampler with an attribute `parallel` that is true gives work to `context.workers`,
        one with `follows` minds `context.density`, one with `keeps` `context.keep`, one with `merges` `context.merge`.
        """
        ...
