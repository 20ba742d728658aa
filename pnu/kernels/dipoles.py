"""Distances and fields of dipoles at points, each from all others or from its neighbors: what
`pnu.geometry.orientation` asks of matrices of all pairs, from differences of places and without matrices between."""

import numpy as np
from numpy.typing import NDArray

from pnu.kernels.boxes import Ints
from pnu.kernels.compilation import kernel

Singles = NDArray[np.float32]
f32 = np.float32
X, Y, Z, LINE_X, LINE_Y, LINE_Z, WIDTH_SQ, SCALE = range(8)
PER_TURN = f32(1 / (4 * np.pi))


def as_sources(points: Singles, lines: Singles, widths: Singles, scale: Singles) -> Singles:
    """Points and lines (n, 3), their dipoles' widths (n,) and factors (n,), as the kernels take them: (8, n)."""
    rows = [*points.T, *lines.T, widths * widths / 2, scale]
    return np.ascontiguousarray(np.stack(rows), np.float32)


@kernel("void(float32[:, ::1], int64, float32[:, ::1])")
def inverse_cube_rows(sources: Singles, first: int, out: Singles) -> None:
    """out[i, j]: 1 / (4 pi r^3), r the distance of source j from source first + i, times both factors; no lines."""
    for i in range(len(out)):
        x, y, z = sources[X, first + i], sources[Y, first + i], sources[Z, first + i]
        width_sq, scale = sources[WIDTH_SQ, first + i], sources[SCALE, first + i] * PER_TURN
        for j in range(sources.shape[1]):
            dx, dy, dz = sources[X, j] - x, sources[Y, j] - y, sources[Z, j] - z
            inverse_sq = f32(1) / max(dx * dx + dy * dy + dz * dz, sources[WIDTH_SQ, j] + width_sq)
            out[i, j] = inverse_sq * np.sqrt(inverse_sq) * (sources[SCALE, j] * scale)


@kernel("void(float32[:, ::1], int64, float32[:, ::1])")
def dipole_rows(sources: Singles, first: int, out: Singles) -> None:
    """out[i, j]: field of the dipole at source j, along the line of source first + i, times both factors.

    Of a source at itself 0."""
    three = f32(3)
    for i in range(len(out)):
        x, y, z = sources[X, first + i], sources[Y, first + i], sources[Z, first + i]
        a, b, c = sources[LINE_X, first + i], sources[LINE_Y, first + i], sources[LINE_Z, first + i]
        width_sq, scale = sources[WIDTH_SQ, first + i], sources[SCALE, first + i]
        for j in range(sources.shape[1]):
            dx, dy, dz = sources[X, j] - x, sources[Y, j] - y, sources[Z, j] - z
            inverse_sq = f32(1) / max(dx * dx + dy * dy + dz * dz, sources[WIDTH_SQ, j] + width_sq)
            there = dx * sources[LINE_X, j] + dy * sources[LINE_Y, j] + dz * sources[LINE_Z, j]
            here = dx * a + dy * b + dz * c
            alike = a * sources[LINE_X, j] + b * sources[LINE_Y, j] + c * sources[LINE_Z, j]
            strength = inverse_sq * np.sqrt(inverse_sq) * (sources[SCALE, j] * scale)
            out[i, j] = (alike - three * there * here * inverse_sq) * strength
        out[i, first + i] = 0


@kernel("void(float32[:, ::1], float32[:, ::1], float32[:, ::1])")
def rows_times(rows: Singles, columns: Singles, out: Singles) -> None:
    """out[i, c]: row i of (r, n) times column c, which is a row of columns (c, n).

    NumPy's product, called from several threads, has each wait for threads of its own."""
    for i in range(len(rows)):
        for c in range(len(columns)):
            total = f32(0)
            for j in range(rows.shape[1]):
                total += rows[i, j] * columns[c, j]
            out[i, c] = total


@kernel("void(float32[:, ::1], int64[:, ::1], int64, float32[:, ::1])")
def neighbor_field(sources: Singles, idx: Ints, first: int, out: Singles) -> None:
    """Unit vectors (m, 3) along the field at sources first + i of their neighbors' dipoles, idx (n, k): itself is the
    first of them and left out. sources (n, 8): `as_sources` transposed."""
    three = f32(3)
    for i in range(len(out)):
        point = sources[first + i]
        x = y = z = f32(0)
        for j in range(1, idx.shape[1]):
            other = sources[idx[first + i, j]]
            dx, dy, dz = other[X] - point[X], other[Y] - point[Y], other[Z] - point[Z]
            inverse_sq = f32(1) / max(dx * dx + dy * dy + dz * dz, other[WIDTH_SQ] + point[WIDTH_SQ])
            along = three * (other[LINE_X] * dx + other[LINE_Y] * dy + other[LINE_Z] * dz) * inverse_sq
            strength = other[SCALE] * inverse_sq * np.sqrt(inverse_sq)
            x += strength * (other[LINE_X] - along * dx)
            y += strength * (other[LINE_Y] - along * dy)
            z += strength * (other[LINE_Z] - along * dz)
        scale = f32(1) / max(np.sqrt(x * x + y * y + z * z), f32(1e-12))
        out[i, 0], out[i, 1], out[i, 2] = x * scale, y * scale, z * scale
