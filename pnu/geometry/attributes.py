"""Colors and other attributes of a cloud, carried over to points between its own."""

import numpy as np

from pnu.geometry.point_tree import PointTree

NEIGHBORS = 6
SAME_SIDE = 0.2  # cosine between normals below which a neighbor counts as another sheet's


def carry(dense: np.ndarray, sparse: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values at new points on the same surface, from those at known points, never across a sheet to its other side.

    dense (m, 6) and sparse (n, 6), points and unit normals; values (n,) or (n, c) -> (m,) or (m, c), same dtype.
    Mean of the nearest 6 with weights 1 / d^2 times the cosine between the normals, of those that face the same way;
    where none does, the nearest. Whole numbers are rounded, other types (text, truth values) taken from the nearest.
    """
    k = min(2 * NEIGHBORS, len(sparse))
    dist, idx = PointTree(sparse[:, :3]).nearest(dense[:, :3], k)
    cosine = (dense[:, None, 3:] * sparse[idx, 3:6]).sum(-1)
    alike = cosine > SAME_SIDE
    if not (np.issubdtype(values.dtype, np.number) and not np.issubdtype(values.dtype, np.complexfloating)):
        nearest: np.ndarray = values[idx[np.arange(len(dense)), alike.argmax(1)]]  # the first where none is alike
        return nearest
    alike &= alike.cumsum(1) <= NEIGHBORS
    floor = 1e-12 * max(float(np.square(dist[:, -1]).mean()), np.finfo(float).tiny)
    weight = np.where(alike, cosine, 0) / (dist**2 + floor)
    lost = ~alike.any(1)
    weight[lost, 0] = 1
    weight /= weight.sum(1, keepdims=True)
    mean: np.ndarray = np.einsum("mk,mk...->m...", weight, values[idx].astype(np.float64))
    if np.issubdtype(values.dtype, np.integer):
        mean = mean.round()
    return mean.astype(values.dtype)
