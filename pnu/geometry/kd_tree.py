"""SciPy's tree of points, built where numbers below 1e-308 count."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnu.runtime import denormals


def kd_tree(points: NDArray[np.floating]) -> cKDTree:
    """The tree of points (n, d), also where `denormals.as_zero`.

    SciPy parts points at the number after 0 where many of them are exactly there, in a plane say; that number taken for
    zero, it never ends and the process dies.
    """
    with denormals.as_numbers():
        return cKDTree(points)
