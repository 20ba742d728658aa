"""Which upsampler a model or a name means."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pnu.upsamplers.context import Context, Upsampler
from pnu.upsamplers.surface_projection import SurfaceProjection

if TYPE_CHECKING:
    from torch import Tensor

CLASSICAL = {
    "apss": ("point_set_surface", "APSS"),
    "poisson": ("poisson_samples", "PoissonSurface"),
    "midpoint": ("midpoints", "Midpoint"),
    "lop": ("lop", "LOP"),
    "wlop": ("wlop", "WLOP"),
    "ear": ("ear", "EAR"),
    "l0": ("l0", "L0"),
}
"""Upsamplers without training, by name: file of this folder, and class in it."""


def classical(name: str) -> Upsampler:
    """An upsampler without training by its name in `CLASSICAL`."""
    if name not in CLASSICAL:
        raise ValueError(f"method={name}: expected one of {', '.join(CLASSICAL)}")
    file, cls = CLASSICAL[name]
    found: Upsampler = getattr(importlib.import_module(f"pnu.upsamplers.{file}"), cls)()
    return found


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
    if is_projection(model):
        return SurfaceProjection(model)
    from pnu.upsamplers.patches import Patches

    return Patches(model, patch_size)


def is_projection(network: Any) -> bool:
    """Whether a network projects points, and takes no patches."""
    return getattr(network, "procedure", "patches") == "surface"


def dense_patches(network: Any, patches: Tensor) -> Tensor:
    """What comes out for patches in the network's frame: (B, n, 6) -> (B, ratio n, 6), or (B, ratio n, 3)."""
    if not is_projection(network):
        dense: Tensor = network(patches)
        return dense
    import torch

    upsampler, count = SurfaceProjection(network), network.ratio * patches.shape[1]
    context = Context(device=patches.device)
    with torch.no_grad():
        return torch.stack([upsampler.upsample_cloud(cloud, count, context) for cloud in patches])
