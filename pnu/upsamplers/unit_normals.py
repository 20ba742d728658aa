"""What comes out of networks, made sure of: finite points, and unit normals for all of them."""

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.normal_estimation import estimate_normals, flip_to_reference
from pnu.geometry.point_tree import PointTree
from pnu.runtime.threads import thread_count

ZERO = 1e-6  # predicted normals shorter than this have no direction
Floats = NDArray[np.float64]


def with_unit_normals(dense: Floats, sparse: Floats) -> Floats:
    """Predictions (m, 3) or (m, 6) with unit normals, (m, 6); `sparse` (n, 6 or more) is the cloud they were made from.

    A predicted normal without direction becomes that of the nearest input point. Where none are predicted they are
    estimated from the predicted points, with the side of the nearest input normal. `ValueError` where a point is not
    finite.
    """
    check_finite(dense)
    points = dense[:, :3]
    if dense.shape[1] == 3:
        normals = estimate_normals(points, orient=False)
        normals = flip_to_reference(normals, points, sparse[:, :3], sparse[:, 3:])
    else:
        normals = dense[:, 3:6]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        lost = (~(length > ZERO) | np.isinf(length))[:, 0]  # NaN counts as lost
        normals = normals / length
    if lost.any():
        near = PointTree(sparse[:, :3]).nearest(points[lost], 1, threads=thread_count())[1][:, 0]
        normals[lost] = sparse[near, 3:6]
    return np.hstack([points, normals])


def check_finite(prediction: Floats) -> None:
    """`ValueError` where a predicted point (m, 3 or more) is NaN or infinite."""
    if not np.isfinite(prediction[:, :3]).all():
        raise ValueError("model: predicted points that are NaN or infinite; its weights are damaged, train it again")
