"""`pnu.geometry.local_frames` for LANES queries at once, one in each lane, so that nothing is summed across lanes.

Buffers are flat: rows of LANES float32. Row r of neighbor i among rows of so many for each neighbor is i * rows + r.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu.kernels.boxes import Floats, Ints
from pnu.kernels.compilation import by_numba, kernel
from pnu.kernels.panels import LANES

if by_numba():  # kept machine code has them inside
    from pnu.kernels.vectors import full, fused, largest, load_vector, root, store_vector, where

Buffer = NDArray[np.float32]
f32 = np.float32
TINY = f32(np.finfo(np.float32).tiny)
NEAR = 6  # rows for each neighbor: offset from the query 0:3, normal 3:6
FEATURES = 11  # as in `pnu.geometry.local_frames`
WORK = 7  # rows for each neighbor while frames are made:
DISTANCE_SQ, SEEN, WEIGHT, TURN, PLACE = 0, 1, 2, 3, 5  # the last two have two rows, along two tangents
FRAME = 14  # rows for each query: the step to its foot 0:3, axes x, y and z,
X_AXIS, Y_AXIS, Z_AXIS, SPACING, HEIGHT = 3, 6, 9, 12, 13
REACH, FLAT = f32(1.5), f32(0.03)  # as in `pnu.geometry.local_frames`


@kernel(inner=True)
def gather_block(cloud: Floats, query: Floats, idx: Ints, start: int, near: Buffer, hint: Buffer) -> None:
    """The queries (m, 6) from `start` on with their neighbors idx (m, k) of a cloud (n, 6); the last fills up lanes."""
    k = idx.shape[1]
    for lane in range(LANES):
        q = min(start + lane, len(query) - 1)
        for c in range(3):
            hint[c * LANES + lane] = f32(query[q, 3 + c])
        for i in range(k):
            point = cloud[idx[q, i]]
            for c in range(3):
                near[(i * NEAR + c) * LANES + lane] = f32(point[c] - query[q, c])
                near[(i * NEAR + 3 + c) * LANES + lane] = f32(point[3 + c])


@kernel(inner=True)
def gather_messages(cloud: Floats, idx: Ints, start: int, features: Buffer) -> None:
    """What a cloud (n, 6 + c) has beside points and normals, of the neighbors idx (m, k) of queries from `start` on:
    into the rows of `features` that follow FEATURES."""
    k = idx.shape[1]
    rows = len(features) // (k * LANES)
    for lane in range(LANES):
        q = min(start + lane, len(idx) - 1)
        for i in range(k):
            for c in range(min(rows - FEATURES, cloud.shape[1] - 6)):
                features[(i * rows + FEATURES + c) * LANES + lane] = f32(cloud[idx[q, i], 6 + c])


@kernel(inner=True)
def _row(buffer: Buffer, i: int) -> Any:
    return load_vector(buffer, i * LANES)


@kernel(inner=True)
def _triple(buffer: Buffer, i: int) -> Any:
    return load_vector(buffer, i * LANES), load_vector(buffer, (i + 1) * LANES), load_vector(buffer, (i + 2) * LANES)


@kernel(inner=True)
def _put(buffer: Buffer, i: int, value: Any) -> None:
    store_vector(buffer, i * LANES, value)


@kernel(inner=True)
def _put_triple(buffer: Buffer, i: int, x: Any, y: Any, z: Any) -> None:
    _put(buffer, i, x)
    _put(buffer, i + 1, y)
    _put(buffer, i + 2, z)


@kernel(inner=True)
def _dot(a: Any, b: Any, c: Any, x: Any, y: Any, z: Any) -> Any:
    return fused(a, x, fused(b, y, c * z))


@kernel(inner=True)
def _surroundings(near: Buffer, hint: Buffer, k: int, work: Buffer) -> Any:
    """Cosines and weights, which sum up to one, into `work`; the mean distance."""
    one = full(f32(1))
    hx, hy, hz = _triple(hint, 0)
    far, sum_ = full(TINY), full(f32(0))
    for i in range(k):
        x, y, z = _triple(near, i * NEAR)
        a, b, c = _triple(near, i * NEAR + 3)
        distance_sq = _dot(x, y, z, x, y, z)
        far, sum_ = largest(far, distance_sq), sum_ + root(distance_sq)
        _put(work, i * WORK + DISTANCE_SQ, distance_sq)
        _put(work, i * WORK + SEEN, _dot(a, b, c, hx, hy, hz))
    shrink, half, least = one / (far * full(f32(1.1))), full(f32(0.5)), full(f32(2e-3))
    weights = full(f32(0))
    for i in range(k):
        weight = one - _row(work, i * WORK + DISTANCE_SQ) * shrink
        weight = weight * weight
        alike = largest(one + _row(work, i * WORK + SEEN), least) * half
        weight = weight * weight * alike * alike
        weights = weights + weight
        _put(work, i * WORK + WEIGHT, weight)
    scale = one / largest(weights, full(TINY))
    for i in range(k):
        _put(work, i * WORK + WEIGHT, _row(work, i * WORK + WEIGHT) * scale)
    return largest(sum_ / full(f32(k)), full(TINY))


@kernel(inner=True)
def _sphere(near: Buffer, hint: Buffer, k: int, work: Buffer, per_spacing: Any, frame: Buffer) -> None:
    """Step in spacings to the algebraic sphere that fits the neighbors, and the normal there, into `frame`."""
    zero, one, two, half = full(f32(0)), full(f32(1)), full(f32(2)), full(f32(0.5))
    px = py = pz = nx = ny = nz = pp = pn = zero
    for i in range(k):
        w = _row(work, i * WORK + WEIGHT)
        x, y, z = _triple(near, i * NEAR)
        x, y, z = x * per_spacing, y * per_spacing, z * per_spacing
        a, b, c = _triple(near, i * NEAR + 3)
        px, py, pz = fused(w, x, px), fused(w, y, py), fused(w, z, pz)
        nx, ny, nz = fused(w, a, nx), fused(w, b, ny), fused(w, c, nz)
        pp, pn = fused(w, _dot(x, y, z, x, y, z), pp), fused(w, _dot(x, y, z, a, b, c), pn)
    covariance, variance = pn - _dot(px, py, pz, nx, ny, nz), pp - _dot(px, py, pz, px, py, pz)
    flat = full(f32(1e-12)) * pp
    uq = where(variance, flat, zero, half * covariance / where(variance, flat, one, variance))
    ux, uy, uz = nx - two * uq * px, ny - two * uq * py, nz - two * uq * pz
    u0 = zero - _dot(ux, uy, uz, px, py, pz) - uq * pp
    length_sq = _dot(ux, uy, uz, ux, uy, uz)
    length = root(length_sq)
    discriminant = root(largest(length_sq - full(f32(4)) * uq * u0, zero))
    reach = where(length, zero, zero, (zero - two) * u0 / largest(length + discriminant, full(TINY)))
    reach = reach / largest(length, full(f32(1e-12)))
    sx, sy, sz = reach * ux, reach * uy, reach * uz
    zx, zy, zz = fused(two * uq, sx, ux), fused(two * uq, sy, uy), fused(two * uq, sz, uz)
    length = root(_dot(zx, zy, zz, zx, zy, zz))
    scale = one / largest(length, full(f32(1e-12)))
    fits = length * scale  # 1, or less where the gradient vanishes
    hx, hy, hz = _triple(hint, 0)
    zx, zy, zz = where(fits, half, hx, zx * scale), where(fits, half, hy, zy * scale), where(fits, half, hz, zz * scale)
    shorter = full(REACH) / largest(root(_dot(sx, sy, sz, sx, sy, sz)), full(REACH))
    _put_triple(frame, 0, sx * shorter, sy * shorter, sz * shorter)
    _put_triple(frame, Z_AXIS, zx, zy, zz)


@kernel(inner=True)
def _tangents(zx: Any, zy: Any, zz: Any) -> Any:
    """Two unit vectors that complete a unit vector to a right-handed frame (`tangent_basis`)."""
    zero, one, two = full(f32(0)), full(f32(1)), full(f32(2))
    x, y, z = largest(zx, zero - zx), largest(zy, zero - zy), largest(zz, zero - zz)
    axis = where(x, y, where(x, z, zero, two), where(y, z, one, two))  # the smallest component
    ux = where(axis, zero, zero, where(axis, one, zero - zz, zy))
    uy = where(axis, zero, zz, where(axis, one, zero, zero - zx))
    uz = where(axis, zero, zero - zy, where(axis, one, zx, zero))
    scale = one / largest(root(_dot(ux, uy, uz, ux, uy, uz)), full(f32(1e-12)))
    ux, uy, uz = ux * scale, uy * scale, uz * scale
    return ux, uy, uz, zy * uz - zz * uy, zz * ux - zx * uz, zx * uy - zy * ux


@kernel(inner=True)
def _half_turn(difference: Any, twice: Any) -> Any:
    """Cosine and sine of atan2(twice, difference) / 2."""
    zero, one, half, tiny = full(f32(0)), full(f32(1)), full(f32(0.5)), full(TINY)
    length = root(fused(difference, difference, twice * twice))
    cos = where(length, tiny, one, difference / largest(length, tiny))
    sin = where(length, tiny, zero, twice / largest(length, tiny))
    great = root(half + half * largest(cos, zero - cos))
    small = half * sin / great
    sign = where(zero, sin, one, zero - one)
    return where(zero, cos, great, small * sign), where(zero, cos, small, great * sign)


@kernel(inner=True)
def make_frames(
    near: Buffer, hint: Buffer, k: int, sphere: bool, work: Buffer, frame: Buffer, features: Buffer
) -> None:
    """Neighbors `near` (k x NEAR rows) and rough normals `hint` (3 rows) -> `frame` (FRAME rows), `features` (the first
    FEATURES of its rows for each neighbor); `work` (k x WORK rows) is for what lies between. See `local_frames`."""
    zero, one = full(f32(0)), full(f32(1))
    rows = len(features) // (k * LANES)
    spacing = _surroundings(near, hint, k, work)
    per_spacing = one / spacing
    if sphere:
        _sphere(near, hint, k, work, per_spacing, frame)
    else:
        hx, hy, hz = _triple(hint, 0)
        _put_triple(frame, 0, zero, zero, zero)
        _put_triple(frame, Z_AXIS, hx, hy, hz)
    sx, sy, sz = _triple(frame, 0)
    zx, zy, zz = _triple(frame, Z_AXIS)
    ux, uy, uz, vx, vy, vz = _tangents(zx, zy, zz)
    uu = uv = vv = zero
    for i in range(k):
        w = _row(work, i * WORK + WEIGHT)
        x, y, z = _triple(near, i * NEAR)
        x, y, z = x * per_spacing - sx, y * per_spacing - sy, z * per_spacing - sz
        a, b, c = _triple(near, i * NEAR + 3)
        turn_u, turn_v = _dot(a, b, c, ux, uy, uz), _dot(a, b, c, vx, vy, vz)
        place_u, place_v = _dot(x, y, z, ux, uy, uz), _dot(x, y, z, vx, vy, vz)
        _put(work, i * WORK + TURN, turn_u)
        _put(work, i * WORK + TURN + 1, turn_v)
        _put(work, i * WORK + PLACE, place_u)
        _put(work, i * WORK + PLACE + 1, place_v)
        _put(features, i * rows + 2, _dot(x, y, z, zx, zy, zz))
        _put(features, i * rows + 5, _dot(a, b, c, zx, zy, zz))
        flat = full(FLAT) * w
        uu = fused(w * turn_u, turn_u, fused(flat * place_u, place_u, uu))
        uv = fused(w * turn_u, turn_v, fused(flat * place_u, place_v, uv))
        vv = fused(w * turn_v, turn_v, fused(flat * place_v, place_v, vv))
    cos, sin = _half_turn(uu - vv, full(f32(2)) * uv)
    first = second = zero  # third moments along both axes
    for i in range(k):
        w = _row(work, i * WORK + WEIGHT)
        u, v = _row(work, i * WORK + PLACE), _row(work, i * WORK + PLACE + 1)
        x, y = fused(cos, u, sin * v), cos * v - sin * u
        first, second = fused(w * x, x * x, first), fused(w * y, y * y, second)
    first, second = where(zero, first, one, zero - one), where(zero, second, one, zero - one)
    x_cos, x_sin, y_cos, y_sin = first * cos, first * sin, second * cos, second * sin
    for i in range(k):
        turn_u, turn_v = _row(work, i * WORK + TURN), _row(work, i * WORK + TURN + 1)
        place_u, place_v = _row(work, i * WORK + PLACE), _row(work, i * WORK + PLACE + 1)
        x, y = x_cos * place_u + x_sin * place_v, y_cos * place_v - y_sin * place_u
        a, b = x_cos * turn_u + x_sin * turn_v, y_cos * turn_v - y_sin * turn_u
        z, c = _row(features, i * rows + 2), _row(features, i * rows + 5)
        height = _dot(x, y, z, a, b, c)
        _put_triple(features, i * rows, x, y, z)
        _put_triple(features, i * rows + 3, a, b, c)
        _put(features, i * rows + 6, root(_dot(x, y, z, x, y, z)))
        _put(features, i * rows + 7, full(f32(0.5)) * (height + z))
        _put(features, i * rows + 8, height)
        _put(features, i * rows + 9, _row(work, i * WORK + SEEN))
        _put(features, i * rows + 10, _row(work, i * WORK + WEIGHT) * full(f32(k)))
    _put_triple(frame, X_AXIS, x_cos * ux + x_sin * vx, x_cos * uy + x_sin * vy, x_cos * uz + x_sin * vz)
    _put_triple(frame, Y_AXIS, y_cos * vx - y_sin * ux, y_cos * vy - y_sin * uy, y_cos * vz - y_sin * uz)
    _put(frame, HEIGHT, zero - _dot(sx, sy, sz, zx, zy, zz))
    _put_triple(frame, 0, sx * spacing, sy * spacing, sz * spacing)
    _put(frame, SPACING, spacing)


@kernel("void(float64[:, ::1], float64[:, ::1], int64[:, ::1], float64[:, :])")
def project_to_spheres(query: Floats, cloud: Floats, idx: Ints, result: Floats) -> None:
    """Queries (m, 6) on the spheres that fit their neighbors idx (m, k), of a cloud (n, 6): result (m, 6), points and
    normals. The same as `pnu.geometry.local_frames.feet`."""
    k = idx.shape[1]
    near, hint, work = np.empty(k * NEAR * LANES, f32), np.empty(3 * LANES, f32), np.empty(k * WORK * LANES, f32)
    frame = np.empty(FRAME * LANES, f32)
    for start in range(0, len(query), LANES):
        gather_block(cloud, query, idx, start, near, hint)
        spacing = _surroundings(near, hint, k, work)
        _sphere(near, hint, k, work, full(f32(1)) / spacing, frame)
        _put(frame, SPACING, spacing)
        for lane in range(min(LANES, len(query) - start)):
            for c in range(3):
                step = frame[c * LANES + lane] * frame[SPACING * LANES + lane]
                result[start + lane, c] = query[start + lane, c] + step
                result[start + lane, 3 + c] = frame[(Z_AXIS + c) * LANES + lane]
