"""Columns that tell the scans of a file apart: which of them a point is of, and where that scan stood."""

from collections.abc import Mapping, Sequence

import numpy as np

from pnu.io.fields import bare_name

STOOD = ("sensor_x", "sensor_y", "sensor_z")
KINDS = frozenset({"classification", "class", "label", "segment", "instance", "cluster"})
SCANS = frozenset({"scan", "scanid", "scanindex", "scannumber", "pointsourceid", "station", "stationid"})


def tells_apart(name: str) -> bool:
    """Whether a column of that name numbers kinds or scans, or says where these stood: never an amount."""
    return bare_name(name) in SCANS | KINDS or name in STOOD


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
        columns |= {name: np.repeat(column, sizes) for name, column in zip(STOOD, told.T, strict=True)}
    return columns


def scan_numbers(attributes: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Which scan each point is of, (n,), where columns say so and there are several."""
    for name, values in attributes.items():
        if bare_name(name) in SCANS and values.ndim == 1:
            different, number = np.unique(values, return_inverse=True)
            return np.asarray(number) if len(different) > 1 else None
    return None
