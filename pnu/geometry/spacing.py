"""How dense a cloud is."""

import numpy as np

from pnu.geometry.point_tree import PointTree


def spacing(points: np.ndarray, neighbors: int = 6) -> float:
    """Spacing that as many points have if evenly spread over the same surface, from the area that neighbors fill.

    points `(n, >= 3)`; n > `neighbors` for a good answer. The median over at most 4000 of the points. Random and even
    samples of a surface give about the same.
    """
    points = points[:, :3]
    far = PointTree(points).nearest(points[:: -(-len(points) // 4000)], min(neighbors + 1, len(points)))[0][:, -1]
    return float(np.median(far) * np.sqrt(np.pi / neighbors))


def local_spacing(points: np.ndarray, neighbors: int = 6) -> np.ndarray:
    """The same around each of the points `(n, >= 3)`: `(n,)`."""
    k = min(neighbors, len(points) - 1)
    far = PointTree(points[:, :3]).among_themselves(k + 1)[0][:, -1]
    return np.asarray(far * np.sqrt(np.pi / k))
