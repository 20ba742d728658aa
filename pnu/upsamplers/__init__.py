"""Upsamplers: a cloud, a count and a context go in, a cloud comes out. One file each.

patches     the paper's procedure, for networks of patches
surface     seeds, spheres, learned projection, even spacing, rejection, for networks that project
apss, poisson, midpoint     without a network
"""

from pnu.upsamplers.context import Context, Upsampler
from pnu.upsamplers.midpoints import Midpoint
from pnu.upsamplers.patches import Patches
from pnu.upsamplers.point_set_surface import APSS
from pnu.upsamplers.poisson_samples import PoissonSurface
from pnu.upsamplers.selection import CLASSICAL, classical, dense_patches, upsampler_of
from pnu.upsamplers.surface_projection import SurfaceProjection

__all__ = [
    "APSS",
    "CLASSICAL",
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
