"""Surfaces from points with normals, and how far they lie from the true ones."""

from pnu.reconstruction.hole_filling import fill_holes
from pnu.reconstruction.screened_poisson import (
    ReconstructedSurface,
    cut_off,
    interpolated_values,
    octree_depth,
    reconstruct,
    trim,
)
from pnu.reconstruction.surface_errors import SurfaceErrors, check_frame, surface_errors

__all__ = [
    "ReconstructedSurface",
    "SurfaceErrors",
    "check_frame",
    "cut_off",
    "fill_holes",
    "interpolated_values",
    "octree_depth",
    "reconstruct",
    "surface_errors",
    "trim",
]
