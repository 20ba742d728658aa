"""Surfaces from points with normals, and how far they lie from the true ones."""

from pnu.surfaces.errors import SurfaceErrors, check_frame, surface_errors
from pnu.surfaces.poisson import Surface, interpolate, octree_depth, reconstruct, trim

__all__ = [
    "Surface",
    "SurfaceErrors",
    "check_frame",
    "interpolate",
    "octree_depth",
    "reconstruct",
    "surface_errors",
    "trim",
]
