"""Points moved to weighed means of the predictions around them, see `pnu.upsamplers.agreement`."""

import numpy as np

from pnu.kernels.boxes import Floats, Ints
from pnu.kernels.compilation import kernel

TINY = np.finfo(np.float64).tiny


@kernel(
    "void(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], int64[:, ::1], int64, int64, "
    "float64[:, :])"
)
def move_to_means(
    points: Floats, normals: Floats, places: Floats, sides: Floats, around: Ints, rounds: int, first: int, out: Floats
) -> None:
    """Points first + i and their unit normals after so many rounds among the predictions `around` (n, k) them, whose
    places and unit normals are given: out (m, 6)."""
    k = around.shape[1]
    close = np.empty(k)
    for i in range(len(out)):
        here = first + i
        x, y, z = points[here]
        nx, ny, nz = normals[here]
        for _ in range(rounds):
            most = TINY
            for j in range(k):
                p = around[here, j]
                dx, dy, dz = places[p, 0] - x, places[p, 1] - y, places[p, 2] - z
                close[j] = dx * dx + dy * dy + dz * dz
                most = max(most, close[j])
            sx = sy = sz = 0.0
            for j in range(k):
                p = around[here, j]
                close[j] = np.exp(-2 * close[j] / most)
                cosine = max(sides[p, 0] * nx + sides[p, 1] * ny + sides[p, 2] * nz, 0.0)
                weight = close[j] * cosine**4
                sx, sy, sz = sx + weight * sides[p, 0], sy + weight * sides[p, 1], sz + weight * sides[p, 2]
            length = np.sqrt(sx * sx + sy * sy + sz * sz)
            nx = ny = nz = 0.0
            if length > 0:
                nx, ny, nz = sx / length, sy / length, sz / length
            total = move = 0.0
            for j in range(k):
                p = around[here, j]
                cosine = max(sides[p, 0] * nx + sides[p, 1] * ny + sides[p, 2] * nz, 0.0)
                weight = close[j] * cosine**4
                total += weight
                move += weight * ((places[p, 0] - x) * nx + (places[p, 1] - y) * ny + (places[p, 2] - z) * nz)
            if total > 0:
                move /= total
                x, y, z = x + move * nx, y + move * ny, z + move * nz
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
        out[i, 3], out[i, 4], out[i, 5] = nx, ny, nz
