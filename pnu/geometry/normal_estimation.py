"""Normals of a bare cloud: plane fits, one consistent side for all, and fits again within each sheet of the surface."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu import kernels
from pnu.geometry.orientation import CHUNK, ROWS, SOME_NOISE, NeighborCloud, agreeing_normals, field, signs
from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import map_on_threads, thread_count

Array = NDArray[Any]  # float64 or float32
Index = NDArray[np.int64]
f32 = np.float32
FIELDS, NOISY_FIELDS = (1, 3), (3, 5)  # before each fit; they smooth, but see across walls thinner than the spacing
MUCH = 0.25  # spacings of noise from which on there are more of them


def estimate_normals(points: Array, k: int = 16, *, orient: bool = True) -> Array:
    """Unit normals of a cloud (n, 3) -> (n, 3).

    Without `orient`: least squares plane of the k nearest points (PCA), sign arbitrary. With it: outward on closed
    shapes, one side on open ones (`orient_normals`), then fitted again to the neighbors on the same sheet only, which
    halves the error at edges and thin walls. ValueError if k is not in 3..n.
    """
    if not 3 <= k <= len(points):
        raise ValueError(f"k: expected 3 to {len(points)} neighbors (the number of points), found {k}")
    planes: Array = _plane_normals(points, PointTree(points).nearest(points, k, threads=thread_count())[1])
    if orient:
        planes = _refined(NeighborCloud.of(points), planes)
    return planes.astype(points.dtype)


def complete_normals(points: Array, normals: Array | None, k: int = 16) -> Array:
    """Normals (n, 3) of points (n, 3): those given; where None or NaN, estimated."""
    missing = np.ones(len(points), bool) if normals is None else np.isnan(normals).any(1)
    if normals is not None and not missing.any():
        return normals
    estimated = estimate_normals(points, k)
    if normals is None:
        return estimated
    completed = normals.copy()
    completed[missing] = flip_to_reference(estimated[missing], points[missing], points[~missing], normals[~missing])
    return completed


def orient_normals(points: Array, normals: Array) -> Array:
    """The same normals (n, 3) of points (n, 3), each with the sign that makes them agree.

    Outward on closed shapes, whatever their number; the same side all over on an open sheet. Deterministic; beyond 4096
    points the global step sees an even subset, so that time stays linear.
    """
    lines = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    sign = signs(NeighborCloud.of(points), lines.astype(f32)).astype(normals.dtype)
    return np.where(sign[:, None] < 0, -normals, normals)


def refit_normals(points: Array, normals: Array) -> Array:
    """What `estimate_normals` makes of points (n, 3) once it knows their sides, those of normals (n, 3)."""
    return _refined(NeighborCloud.of(points), normals, oriented=True).astype(points.dtype)


def flip_to_reference(normals: Array, points: Array, ref_points: Array, ref_normals: Array) -> Array:
    """Normals (n, 3) at points (n, 3), each turned to the side of the nearest reference point's normal."""
    near = PointTree(ref_points).nearest(points, 1, threads=thread_count())[1][:, 0]
    side = (normals * ref_normals[near]).sum(-1, keepdims=True)
    return np.where(side < 0, -normals, normals)


def _plane_normals(points: Array, idx: Index) -> NDArray[np.float64]:
    """Direction of least variance of points[idx], (n, 3); idx (n, k)."""
    if not kernels.ready():
        return _weighted_planes(points, idx, lambda rows: np.ones((*idx[rows].shape, 1)))
    from pnu.kernels.planes import plane_normals

    normals, xyz, idx = np.empty((len(idx), 3)), np.ascontiguousarray(points, np.float64), np.ascontiguousarray(idx)
    map_on_threads(lambda part: plane_normals(xyz, idx, part.start, normals[part]), parts_of(len(idx)))
    return normals


def _weighted_planes(points: Array, idx: Index, weights: Callable[[slice], Array]) -> NDArray[np.float64]:
    """`_plane_normals` by weights (m, k, 1) of some rows."""
    normals = np.empty((len(idx), 3))
    for start in range(0, len(idx), ROWS):
        rows = slice(start, start + ROWS)
        near, share = points[idx[rows]].astype(np.float64), weights(rows).astype(np.float64)
        near -= (share * near).sum(1, keepdims=True) / share.sum(1, keepdims=True)
        normals[rows] = np.linalg.eigh(near.swapaxes(1, 2) @ (share * near))[1][:, :, 0]
    return normals


def _refined(cloud: NeighborCloud, lines: Array, *, oriented: bool = False) -> Array:
    """Oriented normals from lines (n, 3). Each turn of fields and fit leaves cleaner lines for the next."""
    normals = lines.astype(f32)
    if not oriented:
        normals = agreeing_normals(cloud, normals)
    for turn, (few, more) in enumerate(zip(FIELDS, NOISY_FIELDS, strict=True)):
        noise = cloud.noise(normals)
        seen = noise if turn else SOME_NOISE  # rough normals show more of it than there is
        for _ in range(more if noise >= MUCH else few):
            normals = field(cloud, normals, seen)
        normals = _sheet_normals(cloud, normals, seen)
    return normals


def _sheet_normals(cloud: NeighborCloud, normals: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    """Plane fits to the neighbors that face the same way and lie near the tangent plane, signs kept."""
    k = min(round(32 * min(1 + 3 * noise, 1.5)), cloud.idx.shape[1])
    shape = np.array([4 / (1 + 6 * noise), 0.5 + 3 * noise])
    if not kernels.ready():
        lines = _weighted_planes(cloud.points, cloud.idx[:, :k], partial(sheet_weights, cloud, normals, k, shape))
        cosine = (lines * normals).sum(1, keepdims=True)
        # a fit across the given normal has found something else than its sheet
        return np.where(np.abs(cosine) < 0.3, normals, lines * np.sign(cosine)).astype(f32)
    from pnu.kernels.planes import sheet_normals

    xyz, given, idx = (np.ascontiguousarray(v) for v in (cloud.points.astype(float), normals.astype(float), cloud.idx))
    found = np.empty_like(given)
    map_on_threads(lambda part: sheet_normals(xyz, given, idx, k, shape, part.start, found[part]), parts_of(len(given)))
    return found.astype(f32)


def sheet_weights(
    cloud: NeighborCloud, normals: NDArray[np.float32], k: int, shape: NDArray[np.float64], rows: slice
) -> NDArray[np.float32]:
    """Weights (m, k, 1) of the k neighbors of some points: of those on the same sheet, by distance from the point, from
    both tangent planes, and angle between normals, with sharpness and width (2,)."""
    idx, normal, (sharpness, wide) = cloud.idx[rows, :k], normals[rows, None], shape.astype(f32)
    offset = cloud.points[idx] - cloud.points[rows, None]
    distance = np.linalg.norm(offset, axis=-1)
    reach = np.maximum(distance[:, -1:], f32(1e-9)) / f32(1.5)
    rise = np.abs((offset * normal).sum(-1)) + np.abs((offset * normals[idx]).sum(-1))
    facing = np.maximum((normal * normals[idx]).sum(-1), f32(0)) ** sharpness
    weight = facing * np.exp(-((distance / reach) ** 2) - (rise / (wide * reach)) ** 2)
    weight[:, 0] = 1
    return np.asarray(weight[..., None])


def parts_of(n: int) -> list[slice]:
    """Rows of n points that a thread treats at once."""
    return [slice(first, min(first + CHUNK, n)) for first in range(0, n, CHUNK)]
