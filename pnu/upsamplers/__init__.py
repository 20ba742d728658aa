"""Upsamplers: a cloud, a count and a context go in, a cloud comes out. One file each.

patches     the paper's procedure, for networks of patches
surface     seeds, spheres, learned projection, even spacing, rejection, for networks that project
apss, poisson, midpoint, lop, wlop, ear, l0     without a network
"""

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
