"""Colors and other attributes of a cloud, carried over to points between its own."""

import numpy as np

from pnu.geometry.point_tree import PointTree

NEIGHBORS = 6
SAME_SIDE = 0.2  # cosine between normals below which a neighbor counts as another sheet's
KINDS, OFTEN = 32, 8  # different values at most, each so often on average, that tell kinds apart and are no amounts


def carry(dense: np.ndarray, sparse: np.ndarray, values: np.ndarray, *, kinds: bool = False) -> np.ndarray:
    """Values at new points on the same surface, from those at known points, never across a sheet to its other side.

    dense (m, 6) and sparse (n, 6), points and unit normals; values (n,) or (n, c) -> (m,) or (m, c), same dtype.
    Mean of the nearest 6 with weights 1 / d^2 times the cosine between the normals, of those that face the same way;
    where none does, the nearest. Whole numbers are rounded. What tells kinds apart, as classes, numbers of scans and
    truth values do, has no mean: it is the kind of the greatest weight. That is what has few different values, or with
    `kinds` any.
    """
    k = min(2 * NEIGHBORS, len(sparse))
    dist, idx = PointTree(sparse[:, :3]).nearest(dense[:, :3], k)
    cosine = (dense[:, None, 3:] * sparse[idx, 3:6]).sum(-1)
    alike = cosine > SAME_SIDE
    alike &= alike.cumsum(1) <= NEIGHBORS
    floor = 1e-12 * max(float(np.square(dist[:, -1]).mean()), np.finfo(float).tiny)
    weight = np.where(alike, cosine, 0) / (dist**2 + floor)
    lost = ~alike.any(1)
    weight[lost, 0] = 1
    weight /= weight.sum(1, keepdims=True)
    if (number := _kinds(values, kinds)) is not None:
        return np.asarray(values[idx[np.arange(len(dense)), _heaviest(weight, number[idx])]])
    mean: np.ndarray = np.einsum("mk,mk...->m...", weight, values[idx].astype(np.float64))
    if np.issubdtype(values.dtype, np.integer):
        mean = mean.round()
    return mean.astype(values.dtype)


def _kinds(values: np.ndarray, known: bool) -> np.ndarray | None:
    """Numbers (n,) of the different values (n,) or rows (n, c), where these are kinds; None: they are amounts."""
    amounts = np.issubdtype(values.dtype, np.number) and not np.issubdtype(values.dtype, np.complexfloating)
    if amounts and values.ndim > 1 and not known:
        return None
    different, number = np.unique(values, axis=0, return_inverse=True)
    if amounts and not known and len(different) > min(KINDS, len(values) / OFTEN):
        return None
    return np.asarray(number.reshape(-1))


def _heaviest(weight: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """Of neighbors with weights and kinds (m, k) the number of the first whose kind has the greatest weight, (m,)."""
    votes = [(weight * (kinds == kind[:, None])).sum(1) for kind in kinds.T]
    return np.asarray(np.stack(votes, 1).argmax(1))
