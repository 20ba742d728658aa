"""Planes fitted to the neighbors of each point: normals, and what `pnu.geometry.outlier_features` tells of them."""

from typing import Any

import numpy as np

from pnu.kernels.boxes import Floats, Ints
from pnu.kernels.compilation import kernel

SWEEPS = 12  # of Jacobi's method; five are enough as a rule
ACROSS = 0.3  # cosine with the given normal below which a fit has found something else than its sheet
PLANE, FELLOW = 6, 5  # features of a plane, and of a point among its fellows


@kernel(inner=True)
def _turn(a: Floats, axes: Floats, p: int, q: int) -> None:
    """Jacobi's rotation, which makes a[p, q] of a symmetric matrix (3, 3) zero."""
    if a[p, q] == 0:
        return
    theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
    t = 1 / (abs(theta) + np.sqrt(theta * theta + 1))
    t = t if theta >= 0 else -t
    c = 1 / np.sqrt(t * t + 1)
    s = t * c
    a[p, p] -= t * a[p, q]
    a[q, q] += t * a[p, q]
    a[p, q] = a[q, p] = 0
    r = 3 - p - q
    a[r, p], a[r, q] = c * a[r, p] - s * a[r, q], s * a[r, p] + c * a[r, q]
    a[p, r], a[q, r] = a[r, p], a[r, q]
    for i in range(3):
        axes[i, p], axes[i, q] = c * axes[i, p] - s * axes[i, q], s * axes[i, p] + c * axes[i, q]


@kernel(inner=True)
def _eigen(a: Floats, axes: Floats) -> Any:
    """Eigenvalues of a symmetric matrix (3, 3), ascending, and the column of `axes` (3, 3) that belongs to the least.
    Overwrites the matrix."""
    axes[:] = 0
    axes[0, 0] = axes[1, 1] = axes[2, 2] = 1
    size = a[0, 0] * a[0, 0] + a[1, 1] * a[1, 1] + a[2, 2] * a[2, 2]
    for _ in range(SWEEPS):
        off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
        if off <= 1e-36 * size:
            break
        _turn(a, axes, 0, 1)
        _turn(a, axes, 0, 2)
        _turn(a, axes, 1, 2)
    x, y, z = a[0, 0], a[1, 1], a[2, 2]
    column = 0 if x <= y and x <= z else (1 if y <= z else 2)
    low, high = min(min(x, y), z), max(max(x, y), z)
    return low, max(min(x, y), min(max(x, y), z)), high, column


@kernel(inner=True)
def _least(points: Floats, near: Ints, i: int, k: int, weights: Floats, a: Floats, axes: Floats) -> int:
    """Column of `axes` (3, 3) along which the first k neighbors near[i], by their weights (k,), vary least."""
    total = mx = my = mz = 0.0
    for j in range(k):
        p, w = near[i, j], weights[j]
        total += w
        mx, my, mz = mx + w * points[p, 0], my + w * points[p, 1], mz + w * points[p, 2]
    mx, my, mz = mx / total, my / total, mz / total
    a[:] = 0
    for j in range(k):
        p, w = near[i, j], weights[j]
        dx, dy, dz = points[p, 0] - mx, points[p, 1] - my, points[p, 2] - mz
        a[0, 0], a[0, 1], a[0, 2] = a[0, 0] + w * dx * dx, a[0, 1] + w * dx * dy, a[0, 2] + w * dx * dz
        a[1, 1], a[1, 2], a[2, 2] = a[1, 1] + w * dy * dy, a[1, 2] + w * dy * dz, a[2, 2] + w * dz * dz
    a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
    _, _, _, column = _eigen(a, axes)
    return column


@kernel("void(float64[:, ::1], int64[:, ::1], int64, float64[:, :])")
def plane_normals(points: Floats, near: Ints, first: int, out: Floats) -> None:
    """Normals (m, 3) of planes fitted to the neighbors, near (n, k), of points first + i."""
    a, axes, weights = np.empty((3, 3)), np.empty((3, 3)), np.ones(near.shape[1])
    for i in range(len(out)):
        column = _least(points, near, first + i, near.shape[1], weights, a, axes)
        for c in range(3):
            out[i, c] = axes[c, column]


@kernel("void(float64[:, ::1], float64[:, ::1], int64[:, ::1], int64, float64[::1], int64, float64[:, :])")
def sheet_normals(points: Floats, normals: Floats, near: Ints, k: int, shape: Floats, first: int, out: Floats) -> None:
    """`pnu.geometry.normal_estimation.sheet_weights`, sharpness and width in `shape`, and the planes fitted by them to
    the first k neighbors of points first + i: normals (m, 3) to the side of those given."""
    a, axes, weights = np.empty((3, 3)), np.empty((3, 3)), np.empty(k)
    for i in range(len(out)):
        here = first + i
        x, y, z = points[here]
        nx, ny, nz = normals[here]
        far = near[here, k - 1]
        fx, fy, fz = points[far, 0] - x, points[far, 1] - y, points[far, 2] - z
        reach = max(np.sqrt(fx * fx + fy * fy + fz * fz), 1e-9) / 1.5
        weights[0] = 1
        for j in range(1, k):
            p = near[here, j]
            dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
            ox, oy, oz = normals[p, 0], normals[p, 1], normals[p, 2]
            rise = abs(dx * nx + dy * ny + dz * nz) + abs(dx * ox + dy * oy + dz * oz)
            facing = max(nx * ox + ny * oy + nz * oz, 0.0) ** shape[0]
            rise /= shape[1] * reach
            weights[j] = facing * np.exp(-(dx * dx + dy * dy + dz * dz) / (reach * reach) - rise * rise)
        column = _least(points, near, here, k, weights, a, axes)
        cosine = axes[0, column] * nx + axes[1, column] * ny + axes[2, column] * nz
        for c in range(3):
            if abs(cosine) < ACROSS:
                out[i, c] = normals[here, c]
            else:
                out[i, c] = axes[c, column] if cosine > 0 else -axes[c, column]


@kernel("void(float64[:, ::1], int64[:, ::1], float64[::1], int64[::1], int64, int64, float64[:, :], float64[:, :])")
def plane_features(
    points: Floats, near: Ints, unit: Floats, counts: Ints, kept: int, first: int, out: Floats, normals: Floats
) -> None:
    """Of planes fitted to the first `counts` neighbors, near (n, k), of points first + i: the point's height over each
    and its way to their middle in units (n,), logarithms of their sizes, and the height in sizes, out (m, PLANE x
    counts); normals (m, 3) of plane number `kept`."""
    a, axes = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(out)):
        x, y, z = points[first + i]
        u = unit[first + i]
        for number in range(len(counts)):
            m = counts[number]
            mx = my = mz = 0.0
            for j in range(m):
                p = near[first + i, j]
                mx, my, mz = mx + points[p, 0], my + points[p, 1], mz + points[p, 2]
            mx, my, mz = mx / m, my / m, mz / m
            xx = xy = xz = yy = yz = zz = 0.0
            for j in range(m):
                p = near[first + i, j]
                dx, dy, dz = points[p, 0] - mx, points[p, 1] - my, points[p, 2] - mz
                xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
                yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
            a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2] = xx / m, xy / m, xz / m, yy / m, yz / m, zz / m
            a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
            low, middle, high, column = _eigen(a, axes)
            dx, dy, dz = x - mx, y - my, z - mz
            height = abs(dx * axes[0, column] + dy * axes[1, column] + dz * axes[2, column])
            thickness = np.sqrt(max(low, 0.0))
            features = out[i, PLANE * number : PLANE * (number + 1)]
            features[0], features[1] = height / u, np.sqrt(dx * dx + dy * dy + dz * dz) / u
            features[2] = np.log(thickness / u + 1e-3)
            features[3] = np.log(np.sqrt(max(middle, 0.0)) / u + 1e-3)
            features[4] = np.log(np.sqrt(max(high, 0.0)) / u + 1e-3)
            features[5] = height / (thickness + 0.05 * u)
            if number == kept:
                for c in range(3):
                    normals[i, c] = axes[c, column]


@kernel(inner=True)
def _quantile(ascending: Floats, share: float) -> float:
    """As NumPy interpolates it."""
    at = share * (len(ascending) - 1)
    low = int(at)
    high = min(low + 1, len(ascending) - 1)
    return ascending[low] + (ascending[high] - ascending[low]) * (at - low)


@kernel("void(float64[:, ::1], float64[:, ::1], int64[:, ::1], float64[::1], int64[::1], int64, float64[:, :])")
def fellow_features(
    points: Floats, normals: Floats, near: Ints, unit: Floats, counts: Ints, first: int, out: Floats
) -> None:
    """Of the first `counts` neighbors of points first + i: median and first quartile of the point's heights over their
    planes, in units (n,), mean cosine of their normals with the point's, and the larger eigenvalues of their normals'
    second moment, out (m, FELLOW x counts)."""
    a, axes, heights = np.empty((3, 3)), np.empty((3, 3)), np.empty(near.shape[1])
    for i in range(len(out)):
        here = first + i
        for number in range(len(counts)):
            m = counts[number]
            a[:] = 0
            alike = 0.0
            for j in range(m):
                p = near[here, j]
                nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
                dx, dy, dz = (
                    points[here, 0] - points[p, 0],
                    points[here, 1] - points[p, 1],
                    points[here, 2] - points[p, 2],
                )
                height = abs(dx * nx + dy * ny + dz * nz) / unit[here]
                at = j
                while at and heights[at - 1] > height:
                    heights[at] = heights[at - 1]
                    at -= 1
                heights[at] = height
                alike += abs(nx * normals[here, 0] + ny * normals[here, 1] + nz * normals[here, 2])
                a[0, 0], a[0, 1], a[0, 2] = a[0, 0] + nx * nx, a[0, 1] + nx * ny, a[0, 2] + nx * nz
                a[1, 1], a[1, 2], a[2, 2] = a[1, 1] + ny * ny, a[1, 2] + ny * nz, a[2, 2] + nz * nz
            a /= m
            a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
            _, middle, high, _ = _eigen(a, axes)
            features = out[i, FELLOW * number : FELLOW * (number + 1)]
            features[0], features[1] = _quantile(heights[:m], 0.5), _quantile(heights[:m], 0.25)
            features[2], features[3], features[4] = alike / m, high, middle


@kernel("void(float64[::1], int64[:, ::1], int64, float64[::1], int64, float64[:, :])")
def neighbor_quantiles(values: Floats, near: Ints, count: int, shares: Floats, first: int, out: Floats) -> None:
    """Quantiles out (m, shares) of the values (n,) at the first `count` neighbors of points first + i."""
    ascending = np.empty(count)
    for i in range(len(out)):
        for j in range(count):
            value = values[near[first + i, j]]
            at = j
            while at and ascending[at - 1] > value:
                ascending[at] = ascending[at - 1]
                at -= 1
            ascending[at] = value
        for s in range(len(shares)):
            out[i, s] = _quantile(ascending, shares[s])
