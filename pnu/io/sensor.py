"""Where a cloud was seen from, as far as its file says so."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pnu.io.fields import matching
from pnu.io.las import is_from_the_air
from pnu.io.pcd import read_viewpoint

PLACES = tuple(
    tuple(f"{name}{axis}" for axis in "xyz")
    for name in ("sensor_", "vp_", "viewpoint_", "scanner_", "sensor_origin_", "camera_", "sensor", "vp")
)
SCANS = frozenset({"scan", "scanid", "scanindex", "scannumber", "pointsourceid", "station", "stationid"})
AXES = {f"{minus}{'xyz'[axis]}": (-1) ** len(minus) * np.eye(3)[axis] for minus in ("", "-") for axis in range(3)}


class Sight(NamedTuple):
    """What says which side of a surface was seen: one of three, and in words where it is from."""

    words: str
    viewpoint: np.ndarray | None = None  # place of the sensor, (3,), or of each point's own, (n, 3), NaN: not known
    up: np.ndarray | None = None  # (3,) direction from which all was seen
    inward: bool | None = None  # the side of closed shapes: true for rooms and tunnels
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


def columns_of_scans(
    sizes: Sequence[int] | np.ndarray, places: Sequence[np.ndarray] | np.ndarray
) -> dict[str, np.ndarray]:
    """Of points (n,) that come scan by scan: "scan", its number, and "sensor_x" ..., where it stood, NaN if at 0 0 0.

    That is where files put scans of which they do not know it. A single scan has no number; without places, none.
    """
    columns: dict[str, np.ndarray] = {}
    if len(sizes) > 1:
        columns["scan"] = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    told = np.where(np.any(places, axis=1, keepdims=True), places, np.nan)
    if not np.isnan(told).all():
        columns |= {name: np.repeat(column, sizes) for name, column in zip(PLACES[0], told.T, strict=True)}
    return columns


def scan_numbers(attributes: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Which scan each point is of, (n,), where columns say so and there are several."""
    for name, values in attributes.items():
        if name.lower().removeprefix("scalar_").replace("_", "") in SCANS and values.ndim == 1:
            different, number = np.unique(values, return_inverse=True)
            return np.asarray(number) if len(different) > 1 else None
    return None


def asked_sight(viewpoint: Any = None, up: Any = None, side: str | None = None) -> Sight | None:
    """What shall decide the side of normals, as keys and arguments of these names say it; None: nothing is asked.

    viewpoint: three numbers, their text, or an array (n, 3); up: "z", "-z", "x" ..., or three numbers; side: in or out.
    `ValueError`, one line, where they are something else, or two answers to one question.
    """
    asked = {"viewpoint": viewpoint, "up": up, "side": side}
    names = [name for name, value in asked.items() if value is not None]
    if len(names) > 1:
        raise ValueError(f"{names[0]}= and {names[1]}=: both decide the side of normals; give one of them")
    if viewpoint is not None:
        places = _numbers(viewpoint)
        if places is None or places.shape[-1:] != (3,) or places.ndim > 2 or np.isinf(places).any():
            raise ValueError(f"viewpoint={_short(viewpoint)}: expected the place of the sensor, viewpoint=x,y,z")
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
