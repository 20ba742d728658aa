"""Where a picture is taken from."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Camera(NamedTuple):
    """An orthographic camera. ShapeView coordinates: x right, y up, z towards the viewer; the picture spans -1..1."""

    rotation: Array  # (3, 3), rows: right, up, towards the viewer
    center: Array  # (3,) the point in the middle of the picture
    half_size: float  # half the picture's side, in units of the points

    def view(self, points: np.ndarray) -> Array:
        """ShapeView coordinates `(n, 3)` of points `(n, 3)`."""
        return (points - self.center) @ self.rotation.T / self.half_size


def in_one_place(first: np.ndarray, *others: np.ndarray) -> bool:
    """Whether clouds `(n, >= 3)` are about as large as the first and where it is, so that one camera shows them all.

    Their boxes, without the farthest 2 % on each side, differ by less than a factor of 2 and half a diagonal.
    """

    def box(points: np.ndarray) -> tuple[Array, float]:
        low, high = np.percentile(points[:, :3], [2, 98], axis=0)
        return (low + high) / 2, float(np.linalg.norm(high - low))

    center, size = box(first)
    for other, other_size in map(box, others):
        if not size / 2 <= other_size <= 2 * size or np.linalg.norm(other - center) > max(size, other_size) / 2:
            return False
    return True


def look_at(
    *points: np.ndarray, azimuth: float = 30, elevation: float = 15, up: str = "y", margin: float = 1.04
) -> Camera:
    """The camera that sees all `points` (arrays `(n, >= 3)`).

    It is turned by `azimuth` about the axis `up` and raised by `elevation`, in degrees. At azimuth 0 it looks along -z
    where `up` is "y", along -x where it is "z", along -y where it is "x".
    """
    if up not in ("x", "y", "z"):
        raise ValueError(f"up={up!r}: expected x, y or z")
    everything = np.concatenate([p[:, :3] for p in points])
    if not len(everything) or not np.isfinite(everything).all():
        raise ValueError(
            f"camera: expected finite points, found {len(everything)} points with NaN or infinity among them"
        )
    a, e = np.radians([azimuth, elevation])
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    raise_ = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
    to_y_up = np.roll(
        np.eye(3), {"x": 1, "y": 0, "z": 2}[up], axis=0
    )  # a cyclic change of axes, so nothing is mirrored
    rotation = raise_ @ turn @ to_y_up
    seen = everything @ rotation.T
    low, high = seen.min(0), seen.max(0)
    half_size = max((high - low)[:2].max() / 2, 1e-12 * np.abs(seen).max(), 1e-300)
    return Camera(rotation, rotation.T @ ((low + high) / 2), margin * half_size)


def turntable(
    *points: np.ndarray, frames: int, azimuth: float = 30, elevation: float = 15, up: str = "y"
) -> list[Camera]:
    """Cameras of a whole turn about the axis `up`, which begins at `azimuth`; each sees all `points` at one scale."""
    cameras = [
        look_at(*points, azimuth=azimuth + 360 * number / frames, elevation=elevation, up=up)
        for number in range(frames)
    ]
    everything = np.concatenate([p[:, :3] for p in points])
    center = (everything.min(0) + everything.max(0)) / 2
    reach = max(np.abs(((everything - center) @ camera.rotation.T)[:, :2]).max() for camera in cameras)
    half_size = max(1.04 * reach, max(camera.half_size for camera in cameras))
    return [camera._replace(center=center, half_size=half_size) for camera in cameras]
