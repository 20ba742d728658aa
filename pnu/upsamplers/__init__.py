"""Upsamplers: a cloud, a count and a context go in, a cloud comes out. One file each.

patches     the paper's procedure, for networks of patches
surface     seeds, spheres, learned projection, even spacing, rejection, for networks that project
apss, poisson, midpoint, lop, wlop, ear, l0     without a network
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pnu.upsamplers.context import Context, Upsampler
    from pnu.upsamplers.ear import EAR
    from pnu.upsamplers.l0 import L0
    from pnu.upsamplers.lop import LOP
    from pnu.upsamplers.midpoints import Midpoint
    from pnu.upsamplers.patches import Patches
    from pnu.upsamplers.point_set_surface import APSS
    from pnu.upsamplers.poisson_samples import PoissonSurface
    from pnu.upsamplers.selection import CLASSICAL, classical, dense_patches, upsampler_of
    from pnu.upsamplers.surface_projection import SurfaceProjection
    from pnu.upsamplers.wlop import WLOP

__all__ = [
    "APSS",
    "CLASSICAL",
    "EAR",
    "L0",
    "LOP",
    "WLOP",
    "Context",
    "Midpoint",
    "Patches",
    "PoissonSurface",
    "SurfaceProjection",
    "Upsampler",
    "classical",
    "dense_patches",
    "upsampler_of",
]

HOMES = {
    "APSS": "point_set_surface", "CLASSICAL": "selection", "EAR": "ear", "L0": "l0", "LOP": "lop", "WLOP": "wlop",
    "Context": "context", "Midpoint": "midpoints", "Patches": "patches", "PoissonSurface": "poisson_samples",
    "SurfaceProjection": "surface_projection", "Upsampler": "context", "classical": "selection",
    "dense_patches": "selection", "upsampler_of": "selection",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what is asked for on first use: most of it wants torch, which takes seconds, and `surface` does not."""
    if name in HOMES:
        return getattr(importlib.import_module(f"{__name__}.{HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
