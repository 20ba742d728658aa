"""Pictures without a screen: clouds and surfaces drawn by NumPy alone, no graphics library, no display, no GPU."""

from pnu.rendering.camera import Camera, in_one_place, look_at, turntable
from pnu.rendering.figure import ColorBar, figure, save_animation, save_png, webp
from pnu.rendering.render import render_cloud, render_mesh

__all__ = [
    "Camera",
    "ColorBar",
    "figure",
    "in_one_place",
    "look_at",
    "render_cloud",
    "render_mesh",
    "save_animation",
    "save_png",
    "turntable",
    "webp",
]
