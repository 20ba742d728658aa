"""From triangles and splats to pixels: what is visible where, in NumPy alone.

Coordinates in pixels: x right, y down, z (depth) towards the viewer; pixel (row, column) has its middle at
(column + 1/2, row + 1/2).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.ragged import chunks, expand_counts

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Fragments(NamedTuple):
    """The front-most primitive of each covered pixel: `pixel[i]` (flat index) shows `primitive[i]`."""

    pixel: Index
    primitive: Index


class DepthBuffer:
    """Keeps, for each of `count` pixels, the primitive nearest to the viewer; of equal ones, the highest number.

    Depths lie in `low`..`high`; a 16-millionth of that range is told apart.
    """

    def __init__(self, count: int, low: float, high: float) -> None:
        self.key = np.full(count, -1, np.int64)
        self.low, self.steps = low, 2**24 / ((high - low) or 1.0)

    def add(self, pixel: Index, depth: Array, primitive: Index) -> None:
        """Primitives (k,) at pixels (k,), in depths (k,)."""
        steps = ((depth - self.low) * self.steps).astype(np.int64)
        np.maximum.at(self.key, pixel, (steps << 32) | primitive)

    def fragments(self) -> Fragments:
        """The pixels that show anything, and what."""
        pixel = np.flatnonzero(self.key >= 0)
        return Fragments(pixel, self.key[pixel] & 0xFFFFFFFF)


def triangles(corners: Array, height: int, width: int) -> Fragments:
    """Visible triangles; corners `(f, 3, 3)`.

    A pixel belongs to a triangle where its middle lies inside (half-open: neighbors leave no gap and share none).
    """
    lowest, highest = corners[:, :, 2].min(1), corners[:, :, 2].max(1)
    buffer = DepthBuffer(height * width, lowest.min(initial=0), highest.max(initial=0))
    start, slope = plane(corners)
    first = np.clip(np.ceil(corners[:, :, 1].min(1) - 0.5), 0, height).astype(np.int64)
    last = np.clip(np.ceil(corners[:, :, 1].max(1) - 0.5), 0, height).astype(np.int64)
    for part in chunks(last - first):
        face, step = expand_counts((last - first)[part])
        face += part.start
        row = first[face] + step
        left, right = spans(corners[face], row + 0.5)
        left = np.clip(np.ceil(left - 0.5), 0, width).astype(np.int64)
        length = np.maximum(np.clip(np.ceil(right - 0.5), 0, width).astype(np.int64) - left, 0)
        for inner in chunks(length):
            span, step = expand_counts(length[inner])
            span += inner.start
            column, line, of = left[span] + step, row[span], face[span]
            z = start[of] + slope[of, 0] * (column + 0.5) + slope[of, 1] * (line + 0.5)
            buffer.add(line * width + column, np.clip(z, lowest[of], highest[of]), of)
    return buffer.fragments()


def plane(corners: Array) -> tuple[Array, Array]:
    """Planes z = start + slope . (x, y) of triangles `(f, 3, 3)`: start `(f,)`, slope `(f, 2)`, 0 if seen edge-on."""
    (ax, ay, az), (bx, by, bz) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = ax * by - ay * bx
    flat = np.abs(area) < 1e-12
    slope = np.stack([az * by - bz * ay, bz * ax - az * bx], 1) / np.where(flat, 1, area)[:, None]
    slope[flat] = 0
    return corners[:, 0, 2] - (slope * corners[:, 0, :2]).sum(1), slope


def spans(corners: Array, y: Array) -> tuple[Array, Array]:
    """Where horizontal lines y `(s,)` enter and leave triangles `(s, 3, >= 2)`; inf and -inf if they miss."""
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for i in range(3):
        ax, ay, bx, by = corners[:, i, 0], corners[:, i, 1], corners[:, i - 2, 0], corners[:, i - 2, 1]
        crosses = (ay <= y) != (by <= y)
        x = ax + (y - ay) / np.where(crosses, by - ay, 1) * (bx - ax)
        left = np.where(crosses, np.minimum(left, x), left)
        right = np.where(crosses, np.maximum(right, x), right)
    return left, right


def barycentric(corners: Array, point: Array) -> Array:
    """Weights `(m, 3)` of the corners `(m, 3, >= 2)` at points `(m, 2)`; thirds for triangles seen edge-on."""
    a, b, p = (v[:, :2] - corners[:, 0, :2] for v in (corners[:, 1], corners[:, 2], point))
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    flat = np.abs(area) < 1e-12
    second = (p[:, 0] * b[:, 1] - p[:, 1] * b[:, 0]) / np.where(flat, 1, area)
    third = (a[:, 0] * p[:, 1] - a[:, 1] * p[:, 0]) / np.where(flat, 1, area)
    weight: Array = np.clip(np.stack([1 - second - third, second, third], 1), 0, 1)
    weight[flat] = 1
    weight /= weight.sum(1, keepdims=True)
    return weight


def balls(center: Array, radius: float, height: int, width: int) -> Fragments:
    """Visible balls; center `(n, 3)`."""
    buffer = DepthBuffer(height * width, center[:, 2].min(initial=0), center[:, 2].max(initial=0) + radius)
    first = np.ceil(center[:, :2] - radius - 0.5).astype(np.int64)
    side = int(np.ceil(2 * radius)) + 1
    for part in chunks(np.full(len(center), side * side)):
        owner, step = expand_counts(np.full(part.stop - part.start, side * side))
        owner += part.start
        column, row = first[owner, 0] + step % side, first[owner, 1] + step // side
        rise_sq = radius**2 - (column + 0.5 - center[owner, 0]) ** 2 - (row + 0.5 - center[owner, 1]) ** 2
        inside = (rise_sq > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        z = center[owner[inside], 2] + np.sqrt(rise_sq[inside])
        buffer.add((row * width + column)[inside], z, owner[inside])
    return buffer.fragments()
