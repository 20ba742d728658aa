"""Pictures without a screen: clouds and surfaces drawn by NumPy alone, no graphics library, no display, no GPU."""

from pnu.pictures.camera import Camera, in_one_place, look_at
from pnu.pictures.figure import ColorBar, figure, save_png
from pnu.pictures.render import render_cloud, render_mesh

__all__ = ["Camera", "ColorBar", "figure", "in_one_place", "look_at", "render_cloud", "render_mesh", "save_png"]
