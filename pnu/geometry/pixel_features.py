"""What tells a torn point in the picture of a camera: how its depth fits to that of the pixels around it, in numbers.

Inverse depth is linear over the picture where a surface is plane, at whatever slant it was seen. A point that was torn
off at an edge lies on no line with the pixels on both sides of it, nor with two in a row on one side. All numbers are
free of place, rotation, size and density.
"""

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import thread_count

AROUND = 12  # pixels around a point,
BESIDE = 8  # of which so many are held against its depth
SAME = 0.3  # pixels within which two points are on one ray
RAYS = 4  # of the nearest pixels, that may be
ACROSS, AHEAD = -0.5, 0.5  # cosines from which on two pixels lie on opposite sides, and one beyond another
NEITHER = 20.0  # what a line through pixels that do not lie so counts more
LIMIT = 6.0  # of all features
PIXEL_FEATURES = 2 + 4 * BESIDE
ROWS = 2**14  # points at once: bounds the memory
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def pixel_features(points: Floats, camera: Floats) -> NDArray[np.float32]:
    """Features (n, 34) of points (n, 3), n > 12, that a camera at a place (3,) saw, about one a pixel."""
    rays = points - camera
    depth = np.linalg.norm(rays, axis=1)
    rays = rays / depth[:, None]
    angle, near = _others(*PointTree(rays).nearest(rays, AROUND + 1, threads=thread_count()))
    pixel = np.median(angle[:, 1])
    parts = [slice(first, first + ROWS) for first in range(0, len(points), ROWS)]
    return np.concatenate([_features(rays, depth, angle, near, pixel, part) for part in parts])


def _others(angle: Floats, near: Indices) -> tuple[Floats, Indices]:
    """Without each point itself, which is the first unless another lies on its ray."""
    own = near == np.arange(len(near))[:, None]
    own[~own.any(1), -1] = True
    shape = len(near), near.shape[1] - 1
    return angle[~own].reshape(shape), near[~own].reshape(shape)


def _features(
    rays: Floats, depth: Floats, angle: Floats, near: Indices, pixel: float, part: slice
) -> NDArray[np.float32]:
    ray, own, all_around, width = rays[part], depth[part], near[part], angle[part]
    around, unit = all_around[:, :BESIDE], pixel * own[:, None]
    on_ray = np.where(width[:, :RAYS] < SAME * pixel, (own[:, None] - depth[all_around[:, :RAYS]]) / unit, 0)
    inverse = 1 / depth
    way = _directions(rays[all_around] - ray[:, None])
    # lines through a pixel and the one that lies the most opposite to it
    cosine = way[:, :BESIDE] @ way.swapaxes(1, 2)
    opposite = cosine.argmin(2)
    near_side, far_side = width[:, :BESIDE], np.take_along_axis(width, opposite, 1)
    there, beyond = inverse[around], inverse[np.take_along_axis(all_around, opposite, 1)]
    between = (there * far_side + beyond * near_side) / np.maximum(near_side + far_side, 1e-12)
    across = np.take_along_axis(cosine, opposite[..., None], 2)[..., 0] > ACROSS
    # and through a pixel and the one that lies behind it as seen from here
    on = _directions(rays[near[around]] - rays[around][:, :, None])
    cosine = np.einsum("nbc,nbkc->nbk", way[:, :BESIDE], on)
    behind = cosine.argmax(2)[..., None]
    apart = np.take_along_axis(angle[around], behind, 2)[..., 0]
    slope = (there - inverse[np.take_along_axis(near[around], behind, 2)[..., 0]]) / np.maximum(apart, 1e-12)
    ahead = np.take_along_axis(cosine, behind, 2)[..., 0] < AHEAD

    def off(line: Floats, none: NDArray[np.bool_]) -> Floats:
        """How far the point is from lines through other pixels, in pixels, ascending; far where there are none."""
        return np.sort(np.arcsinh(np.abs(line - inverse[part, None]) * own[:, None] / pixel + NEITHER * none), 1)

    columns = [
        np.arcsinh(np.column_stack([on_ray.max(1), on_ray.min(1)])),
        np.sort(np.arcsinh((depth[around] - own[:, None]) / unit), 1),
        np.log(np.maximum(near_side / pixel, 1e-3)),
        off(between, across),
        off(there + slope * near_side, ahead),
    ]
    features: NDArray[np.float32] = np.clip(np.hstack(columns), -LIMIT, LIMIT).astype(np.float32)
    return features


def _directions(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
