"""Where a cloud was seen from, as far as its file says so."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pnu.io.cloud import CLOUD_SUFFIXES
from pnu.io.fields import matching
from pnu.io.las import is_from_the_air
from pnu.io.pcd import read_viewpoint
from pnu.io.trajectory import read_trajectory, times_of

PLACES = tuple(
    tuple(f"{name}{axis}" for axis in "xyz")
    for name in ("sensor_", "vp_", "viewpoint_", "scanner_", "sensor_origin_", "camera_", "sensor", "vp")
)
AXES = {f"{minus}{'xyz'[axis]}": (-1) ** len(minus) * np.eye(3)[axis] for minus in ("", "-") for axis in range(3)}


class Sight(NamedTuple):
    """What says which side of a surface was seen: one of four, and in words where it is from."""

    words: str
    viewpoint: np.ndarray | None = None  # place of the sensor, (3,), or of each point's own, (n, 3), NaN: not known
    up: np.ndarray | None = None  # (3,) direction from which all was seen
    inward: bool | None = None  # the side of closed shapes: true for rooms and tunnels
    places: np.ndarray | None = None  # (k, 3), of sensors: each point was seen from one of these, not known which
    pixels: bool = False  # that of a camera whose pixels the points are, so that it saw all of them


def sight_of(path: str | Path, attributes: Mapping[str, np.ndarray]) -> Sight | None:
    """What a file says: columns sensor_x sensor_y sensor_z or alike, a pcd's VIEWPOINT, returns and angles of a las.

    attributes: of the cloud that was read from it.
    """
    for spelling in PLACES:
        if names := matching(spelling, dict(attributes)):
            places = np.stack([attributes[name] for name in names], axis=1).astype(np.float64)
            return Sight(f"towards the sensors of {' '.join(names)}", viewpoint=places)
    suffix = Path(path).suffix.lower()
    if suffix == ".pcd" and (place := read_viewpoint(Path(path))) is not None:
        return Sight(f"towards the file's VIEWPOINT {spelled_place(place)}", viewpoint=place)
    if suffix in (".las", ".laz") and is_from_the_air(Path(path)):
        return Sight("up, as seen from the air (scan angles or several returns)", up=np.array([0.0, 0, 1]))
    return None


def asked_sight(
    viewpoint: Any = None, up: Any = None, side: str | None = None, attributes: Mapping[str, np.ndarray] | None = None
) -> Sight | None:
    """What shall decide the side of normals, as keys and arguments of these names say it; None: nothing is asked.

    viewpoint: three numbers, their text, an array (n, 3), or the file of a `Trajectory`, along which times among the
    attributes of a cloud tell the place of each point's sensor; up: "z", "-z", "x" ..., or three numbers; side: in or
    out.
    `ValueError`, one line, where they are something else, or two answers to one question.
    """
    asked = {"viewpoint": viewpoint, "up": up, "side": side}
    names = [name for name, value in asked.items() if value is not None]
    if len(names) > 1:
        raise ValueError(f"{names[0]}= and {names[1]}=: both decide the side of normals; give one of them")
    if viewpoint is not None:
        places = _numbers(viewpoint)
        if places is None and isinstance(viewpoint, str) and _is_file(viewpoint):
            return _sight_along(viewpoint, attributes or {})
        if places is None or places.shape[-1:] != (3,) or places.ndim > 2 or np.isinf(places).any():
            raise ValueError(
                f"viewpoint={_short(viewpoint)}: expected the place of the sensor, viewpoint=x,y,z, or a file of places"
            )
        if np.isnan(places).all(-1).all() or (places.ndim == 1 and np.isnan(places).any()):
            raise ValueError(f"viewpoint={_short(viewpoint)}: expected three numbers, found NaN")
        return Sight("towards the sensor" + (f" at {spelled_place(places)}" if places.ndim == 1 else "s"), places)
    if up is not None:
        direction = AXES.get(up.lower().lstrip("+")) if isinstance(up, str) else _numbers(up)
        if direction is None or np.shape(direction) != (3,) or not 0 < np.linalg.norm(direction) < np.inf:
            raise ValueError(f"up={_short(up)}: expected x, y, z, -x, -y or -z, the axis that points up")
        return Sight(f"up={_short(up)}", up=np.asarray(direction, np.float64))
    if side is not None:
        if side not in ("in", "out"):
            raise ValueError(f"side={_short(side)}: expected out or in, the side of closed shapes to look to")
        return Sight(f"{side}ward, side={side}", inward=side == "in")
    return None


def _is_file(name: str) -> bool:
    return Path(name).is_file() or Path(name).suffix.lower() in CLOUD_SUFFIXES


def _sight_along(path: str, attributes: Mapping[str, np.ndarray]) -> Sight:
    """From a sensor's way, at the times of the points where these are known, else from any of its places."""
    way, times = read_trajectory(path), times_of(dict(attributes))
    of_each = None if times is None else way.at(times)
    if of_each is not None:
        return Sight(f"towards the sensor, which was where {path} says it was at the time", viewpoint=of_each)
    return Sight(f"towards the {len(way.places)} places of {path} that see the points", places=way.places)


def _numbers(values: Any) -> np.ndarray | None:
    """Numbers, or text with commas between them, as float64; None where they are none."""
    try:
        if isinstance(values, str):
            values = [float(word) for word in values.strip("[]() ").split(",")]
        return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values, np.float64)
    except (ValueError, TypeError):
        return None


def _short(value: object) -> str:
    return str(value)[:40]


def spelled_place(place: np.ndarray) -> str:
    """Three numbers as `viewpoint=` takes them."""
    return ",".join(f"{value:.10g}" for value in place)
