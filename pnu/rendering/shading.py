"""From what is visible to colors: two lights, sky light, occlusion by neighbors, a soft gloss."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.rendering.colors import linear_light, srgb

# ShapeView coordinates: x right, y up, z to the viewer. (direction to the light, strength)
LIGHTS = (((-0.55, 0.60, 0.58), 0.80), ((0.90, 0.05, 0.43), 0.12))
SKY, GROUND = 0.30, 0.10  # light from above and below that reaches an open surface
GLOSS, SHARPNESS = 0.10, 24.0
OCCLUSION = 0.9  # how dark a closed-in corner gets, 0 to switch off
REACH = (0.012, 0.028, 0.06)  # where neighbors are looked at, in picture sides
DIRECTIONS = 8

Image = NDArray[np.float32]


class PixelSurface(NamedTuple):
    """What each pixel shows. Where `covered` is False the rest means nothing."""

    covered: NDArray[np.bool_]  # (h, w)
    depth: Image  # (h, w) towards the viewer, in pixels
    normal: Image  # (h, w, 3) unit, view coordinates, towards the viewer
    color: Image  # (h, w, 3) sRGB in 0..1


def shifted_image(image: Image, rows: int, columns: int, fill: float) -> Image:
    """result[r, c] = image[r + rows, c + columns], `fill` beyond the border."""
    result = np.full_like(image, fill)
    h, w = image.shape
    rows, columns = np.clip(rows, -h, h), np.clip(columns, -w, w)
    to = np.s_[max(-rows, 0) : h - max(rows, 0), max(-columns, 0) : w - max(columns, 0)]
    of = np.s_[max(rows, 0) : h + min(rows, 0), max(columns, 0) : w + min(columns, 0)]
    result[to] = image[of]
    return result


def openness(surface: PixelSurface, side: float) -> Image:
    """Share of the sky over each pixel that nearby surface leaves free, `(h, w)` in 0..1: horizons in a few directions.

    side: of the whole picture, in pixels.
    """
    far = -1e6
    depth = np.where(surface.covered, surface.depth, np.float32(far))
    blocked = np.zeros_like(depth)
    reach = REACH[-1] * side
    for i in range(DIRECTIONS):
        turn = 2 * np.pi * (i + 0.5) / DIRECTIONS
        horizon = np.zeros_like(depth)
        for part in REACH:
            columns, rows = (round(part * side * f(turn)) for f in (np.cos, np.sin))
            rise = shifted_image(depth, rows, columns, far) - depth
            distance = np.sqrt(np.float32(rows**2 + columns**2) + rise**2)
            n = surface.normal
            sine = (columns * n[..., 0] - rows * n[..., 1] + rise * n[..., 2]) / distance
            sine *= np.clip(2 - distance / (1.5 * reach), 0, 1)  # what stands far in front casts no shadow
            np.maximum(horizon, sine - 0.08, out=horizon)
        blocked += horizon**2
    blocked /= DIRECTIONS
    return 1 - blocked


def shade(surface: PixelSurface, side: float) -> Image:
    """Colors `(h, w, 3)`, linear light in 0..1."""
    n = surface.normal
    light = np.zeros(n.shape[:2], np.float32)
    gloss = np.zeros_like(light)
    for direction, strength in LIGHTS:
        towards = np.asarray(direction, np.float32) / np.float32(np.linalg.norm(direction))
        light += strength * np.clip(n @ towards, 0, 1)
        half = towards + np.array([0, 0, 1], np.float32)
        gloss += strength * np.clip(n @ (half / np.linalg.norm(half)), 0, 1) ** SHARPNESS
    free = 1 - OCCLUSION * (1 - openness(surface, side)) if OCCLUSION else np.ones_like(light)
    light = light * (0.4 + 0.6 * free) + free * (GROUND + (SKY - GROUND) * (0.5 + 0.5 * n[..., 1]))
    return linear_light(surface.color) * light[..., None] + (GLOSS * gloss * free)[..., None]


def averaged_pixels(linear: Image, covered: NDArray[np.bool_], supersample: int) -> NDArray[np.uint8]:
    """Average supersample x supersample pixels over white, as 8-bit sRGB."""
    linear = np.where(covered[..., None], linear, 1).clip(0, 1)
    h, w = covered.shape[0] // supersample, covered.shape[1] // supersample
    mean = linear.reshape(h, supersample, w, supersample, 3).mean((1, 3))
    rgb: np.ndarray = np.rint(255 * srgb(mean))
    return rgb.astype(np.uint8)
