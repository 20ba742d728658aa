"""Points that push their neighbors apart: the step of `pnu.geometry.even_spacing`."""

import numpy as np

from pnu.kernels.boxes import Floats, Ints
from pnu.kernels.compilation import kernel

FACING = -0.2  # as in `pnu.geometry.even_spacing`
LONGEST = 0.3


@kernel("void(float64[:, ::1], float64[:, ::1], int64[:, ::1], float64[::1], int64, float64[:, ::1])", exact=True)
def push_apart(points: Floats, normals: Floats, near: Ints, reach: Floats, first: int, out: Floats) -> None:
    """Where points first + i of (m, 3) go when their neighbors near (r, k) push them in their tangent planes, each
    within its reach (r,): out (len(out), 3)."""
    for i in range(len(out)):
        here = first + i
        x, y, z = points[here]
        a, b, c = normals[here]
        far = reach[here]
        px = py = pz = 0.0
        for j in range(near.shape[1]):
            other = near[here, j]
            dx, dy, dz = x - points[other, 0], y - points[other, 1], z - points[other, 2]
            apart = np.sqrt(dx * dx + dy * dy + dz * dz)
            if apart >= far or a * normals[other, 0] + b * normals[other, 1] + c * normals[other, 2] <= FACING:
                continue
            force = (1 - apart / far) / max(apart, 1e-9 * far)
            px += force * dx
            py += force * dy
            pz += force * dz
        px, py, pz = 0.5 * far * px, 0.5 * far * py, 0.5 * far * pz
        along = px * a + py * b + pz * c
        px, py, pz = px - along * a, py - along * b, pz - along * c
        longest = LONGEST * far
        scale = longest / max(np.sqrt(px * px + py * py + pz * pz), longest)
        out[i, 0], out[i, 1], out[i, 2] = x + scale * px, y + scale * py, z + scale * pz
