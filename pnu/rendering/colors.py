"""Colors of numbers and normals, as 8-bit sRGB."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Colors = NDArray[np.uint8]

# Red is zero, blue is high: the paper's figures of reconstruction errors.
ERROR = np.array(
    [[204, 12, 12], [240, 150, 20], [226, 226, 40], [60, 184, 66], [30, 160, 200], [24, 50, 190]], np.float64
)

# OKLab (Ottosson 2020) -> cube roots of cone responses -> linear sRGB
LMS = np.array([[1, 0.3963377774, 0.2158037573], [1, -0.1055613458, -0.0638541728], [1, -0.0894841775, -1.2914855480]])
RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light in 0..1 to sRGB's transfer curve, any shape; values outside are clipped."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_light(encoded: np.ndarray) -> np.ndarray:
    """The inverse of `srgb`."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _perceptual(t: Array) -> Array:
    """From dark violet over green to light yellow: OKLab lightness grows evenly, so equal steps look equal."""
    lightness, hue = 0.30 + 0.65 * t, np.radians(300 - 195 * t)
    chroma = 0.13 + 0.035 * t - 0.06 * np.sin(np.pi * t)
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], -1)
    return srgb((lab @ LMS.T) ** 3 @ RGB.T)


def _error(t: Array) -> Array:
    anchors = np.linspace(0, 1, len(ERROR))
    return np.stack([np.interp(t, anchors, channel) for channel in ERROR.T], -1) / 255


COLORMAPS = {"error": _error, "perceptual": _perceptual}


def value_colors(values: np.ndarray, limits: tuple[float, float], colormap: str = "error") -> Colors:
    """Colors `(..., 3)` of numbers `(...)`; what lies outside `limits` gets the color of the nearer end.

    `colormap` is "error" (red = low, over green, blue = high, as the paper) or "perceptual" (dark = low, light = high,
    in even steps of lightness). NaN is gray.
    """
    if colormap not in COLORMAPS:
        raise ValueError(f"colormap={colormap!r}: expected one of {', '.join(COLORMAPS)}")
    low, high = limits
    if not (np.isfinite([low, high]).all() and high > low):
        raise ValueError(f"color limits {low}, {high}: expected two finite numbers, the second larger")
    known = np.isfinite(values)
    t = np.clip((np.where(known, values, low) - low) / (high - low), 0, 1)
    rgb: np.ndarray = np.rint(255 * np.where(known[..., None], COLORMAPS[colormap](t), 0.6))
    return rgb.astype(np.uint8)


def typical_limit(errors: np.ndarray) -> float:
    """The end of a color scale that starts at 0: what 98 % of the errors stay below."""
    return float(np.quantile(errors, 0.98)) or float(errors.max()) or 1e-12


def normal_colors(normals: np.ndarray) -> Colors:
    """Colors `(n, 3)` of unit normals `(n, 3)`: x, y, z from -1..1 to red, green, blue from 0..255."""
    rgb: np.ndarray = np.rint(127.5 * (np.clip(normals, -1, 1) + 1))
    return rgb.astype(np.uint8)
