"""The way of a scanner that was carried or driven: where it was, and when, as programs for mobile mapping write it."""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pnu.io.cloud import TEXTS, read_cloud
from pnu.io.delimited import read_text
from pnu.io.fields import POINTS, bare_name, matching

PLACES = (*POINTS, *((f"{name}x", f"{name}y", f"{name}z") for name in ("t", "pos_", "position_", "p_")))
TIMES = frozenset({"time", "t", "timestamp", "gpstime", "gpsseconds", "seconds", "sec", "stamp"})
COVERED = 0.5  # of the points' times that lie within a way's, if both are of one clock


class Trajectory(NamedTuple):
    """Places (k, 3), and their times (k,), ascending, if they are known."""

    places: np.ndarray
    times: np.ndarray | None

    def at(self, times: np.ndarray) -> np.ndarray | None:
        """Places (n, 3) at times (n,), NaN before and after; None where these are of another clock."""
        if self.times is None or not len(times):
            return None
        within = (times >= self.times[0]) & (times <= self.times[-1])
        if within.mean() < COVERED:
            return None
        found = np.stack([np.interp(times, self.times, axis) for axis in self.places.T], axis=1)
        found[~within] = np.nan
        return found


def times_of(columns: dict[str, np.ndarray]) -> np.ndarray | None:
    """The times among columns (n,), by their names."""
    for name, values in columns.items():
        if bare_name(name) in TIMES and values.ndim == 1:
            return values.astype(np.float64)
    return None


def read_trajectory(path: str | Path) -> Trajectory:
    """Of a cloud's file, or of text with names for its columns, or with x y z, or with time x y z and what may follow.

    Raises:
        ValueError: no such file, or none with places.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file; give the places of a sensor, or x,y,z of a single one")
    return _read(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=2)
def _read(path: Path, _: int) -> Trajectory:
    if path.suffix.lower() in TEXTS:
        values, names, _notes = read_text(path)
        if names is None:
            first = values[:, 0] if values.ndim == 2 and values.shape[1] else np.empty(0)
            timed = values.shape[1] > 3 and len(values) > 1 and bool((np.diff(first) > 0).all())
            names = [*["time"] * timed, "x", "y", "z", *map(str, range(values.shape[1]))][: values.shape[1]]
        columns = dict(zip(names, values.T, strict=True))
        found = next((some for spelling in PLACES if (some := matching(spelling, columns))), None)
        if found is None:
            raise ValueError(f"{path}: expected places x y z, or time x y z; found {' '.join(columns)}")
        places, times = np.stack([columns[name] for name in found], axis=1), times_of(columns)
    else:
        cloud = read_cloud(path, minimum=1, pulses=True)
        places, times = cloud.points, times_of(cloud.attributes)
    usable = np.isfinite(places).all(1) & (True if times is None else np.isfinite(times))
    places, times = places[usable].astype(np.float64), None if times is None else times[usable]
    if not len(places):
        raise ValueError(f"{path}: expected places x y z, or time x y z; holds none")
    if times is not None:
        order = np.argsort(times, kind="stable")
        places, times = places[order], times[order]
    return Trajectory(places, times)
