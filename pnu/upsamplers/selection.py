"""Which upsampler a model or a name means."""

from typing import Any

import torch
from torch import Tensor

from pnu.upsamplers.context import Context, Upsampler
from pnu.upsamplers.ear import EAR
from pnu.upsamplers.l0 import L0
from pnu.upsamplers.lop import LOP
from pnu.upsamplers.midpoints import Midpoint
from pnu.upsamplers.patches import Patches
from pnu.upsamplers.point_set_surface import APSS
from pnu.upsamplers.poisson_samples import PoissonSurface
from pnu.upsamplers.surface_projection import SurfaceProjection
from pnu.upsamplers.wlop import WLOP

CLASSICAL: dict[str, type[Upsampler]] = {
    "apss": APSS,
    "poisson": PoissonSurface,
    "midpoint": Midpoint,
    "lop": LOP,
    "wlop": WLOP,
    "ear": EAR,
    "l0": L0,
}
"""Upsamplers without training, by name."""


def classical(name: str) -> Upsampler:
    """An upsampler without training by its name in `CLASSICAL`."""
    if name not in CLASSICAL:
        raise ValueError(f"method={name}: expected one of {', '.join(CLASSICAL)}")
    return CLASSICAL[name]()


def upsampler_of(model: Any, patch_size: int | None = None) -> Upsampler:
    """The upsampler that works with a model.

    One that has `upsample_cloud` is an upsampler itself. A network says by its attribute `procedure` which one is made
    for it: "surface" for networks that project points; without it "patches", of `patch_size` points if not None.
    """
    if getattr(model, "task", "upsampling") != "upsampling":
        raise ValueError(
            f"model: {type(model).__name__} estimates normals and makes no points; take one that upsamples"
        )
    if hasattr(model, "upsample_cloud"):
        itself: Upsampler = model
        return itself
    return SurfaceProjection(model) if is_projection(model) else Patches(model, patch_size)


def is_projection(network: Any) -> bool:
    """Whether a network projects points, and takes no patches."""
    return getattr(network, "procedure", "patches") == "surface"


def dense_patches(network: Any, patches: Tensor) -> Tensor:
    """What comes out for patches in the network's frame: (B, n, 6) -> (B, ratio n, 6), or (B, ratio n, 3)."""
    if not is_projection(network):
        dense: Tensor = network(patches)
        return dense
    upsampler, count = SurfaceProjection(network), network.ratio * patches.shape[1]
    context = Context(device=patches.device)
    with torch.no_grad():
        return torch.stack([upsampler.upsample_cloud(cloud, count, context) for cloud in patches])
