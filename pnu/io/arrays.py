"""Clouds in NumPy's files: arrays (n, k) or (h, w, k), structured ones, and archives of several."""

import io
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from pnu.io.fields import COLOR, NORMAL, XYZ

POINT_ARRAYS = ("points", "xyz", "point", "pos", "position", "positions", "coords", "coord", "vertices", "pc", "cloud")
NORMAL_ARRAYS = ("normals", "normal")
COLOR_ARRAYS = ("colors", "color", "colors", "rgb")
LARGEST = 1000  # bytes that a byte of an archive may hold: deflate makes no more


def npy_slices(path: Path, rows: int) -> Iterator[np.ndarray | dict[str, np.ndarray]]:
    """Rows (k, c) of an npy, or columns by name of a structured one, so many rows at a time."""
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        raise _damaged(path, "npy", error) from None
    if not isinstance(values, np.ndarray):
        raise ValueError(f"{path}: is an archive of arrays; name it .npz")
    flat = values.reshape(-1) if values.dtype.names else values.reshape(-1, *values.shape[-1:])
    for start in range(0, len(flat), rows):
        part = np.load(path, mmap_mode="r", allow_pickle=False).reshape(flat.shape)[start : start + rows]
        yield _table(path, part)[0]


def read_array(path: Path) -> tuple[np.ndarray | dict[str, np.ndarray], tuple[str, ...]]:
    """Rows (n, k), or columns by name; and what to say. Nothing is unpickled."""
    if path.suffix.lower() == ".npz":
        return _from_archive(path)
    try:
        # Mapped first: a header that promises more than the file holds fails before anything is allocated.
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy parses the header as Python and lets many kinds of error through
        raise _damaged(path, "npy", error) from None
    if not isinstance(values, np.ndarray):
        raise ValueError(f"{path}: is an archive of arrays; name it .npz")
    return _table(path, values)


def _damaged(path: Path, kind: str, error: Exception) -> ValueError:
    reason = (str(error).splitlines() or [""])[0][:80]
    return ValueError(f"{path}: is no {kind} file of numbers ({reason}); save it again")


def _table(path: Path, values: np.ndarray) -> tuple[np.ndarray | dict[str, np.ndarray], tuple[str, ...]]:
    """An array as rows of numbers, or as columns by name where it is structured."""
    if values.dtype.names:
        columns: dict[str, np.ndarray] = {}
        for name in values.dtype.names:
            column = values[name].reshape(values.size, -1) if values.size else np.empty((0, 1))
            if column.dtype.kind in "fiu":
                columns |= _columns(name, column)
        return columns, ()
    if values.dtype.kind not in "fiu" or values.ndim not in (2, 3) or values.shape[-1] < 3:
        raise ValueError(
            f"{path}: expected an array (n, 3), (n, 6) or (h, w, 3) of numbers, found {values.dtype} {values.shape}"
        )
    note = () if values.ndim == 2 else (f"a map of {values.shape[0]} x {values.shape[1]} points, taken as a cloud",)
    return np.array(values.reshape(-1, values.shape[-1]), np.float64), note


def _columns(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of an array (n, k) by the names of what it is."""
    known = ((POINT_ARRAYS, XYZ), (NORMAL_ARRAYS, NORMAL), (COLOR_ARRAYS, (*COLOR, "alpha")))
    for spellings, names in known:
        if name.lower() in spellings and values.shape[1] in (3, len(names)):
            return dict(zip(names, values.T, strict=False))
    return {name: values[:, 0] if values.shape[1] == 1 else values}


def _from_archive(path: Path) -> tuple[np.ndarray | dict[str, np.ndarray], tuple[str, ...]]:
    try:
        with zipfile.ZipFile(path) as archive:
            members = [item for item in archive.infolist() if item.filename.endswith(".npy")]
            if sum(item.file_size for item in members) > LARGEST * path.stat().st_size:
                raise ValueError("it promises more than it can hold")
            arrays = {}
            for item in members:
                data = io.BytesIO(archive.read(item))
                arrays[item.filename.removesuffix(".npy")] = np.lib.format.read_array(data, allow_pickle=False)
    except Exception as error:  # of zip, of deflate, of the arrays' headers
        raise _damaged(path, "npz", error) from None
    arrays = {name: values for name, values in arrays.items() if values.dtype.names or values.dtype.kind in "fiu"}
    found = ", ".join(f"{name} {values.shape}" for name, values in arrays.items()) or "none"
    lower = {name.lower(): name for name in reversed(list(arrays))}
    named = next((lower[name] for name in POINT_ARRAYS if name in lower), None)
    clouds = [
        name
        for name, values in arrays.items()
        if values.dtype.names or (values.ndim in (2, 3) and values.shape[-1] >= 3)
    ]
    if named is None and {*XYZ} <= lower.keys():
        return _matching(arrays, arrays[lower["x"]].size), ()
    if named is None and len(clouds) == 1:
        named = clouds[0]
    if named is None:
        raise ValueError(f"{path}: expected an array 'points', or a single one of shape (n, 3); found {found}")
    values, notes = _table(path, arrays[named])
    said = (f"array '{named}' of {', '.join(arrays)}",) if len(arrays) > 1 else ()
    if isinstance(values, dict) or values.shape[1] != 3:
        return values, (*said, *notes)
    others = {name: other for name, other in arrays.items() if name != named}
    return dict(zip(XYZ, values.T, strict=True)) | _matching(others, len(values)), (*said, *notes)


def _matching(arrays: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Columns of those arrays that have as many rows."""
    columns: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if not values.dtype.names and count and values.size in (count, 3 * count, 4 * count):
            columns |= _columns(name, values.reshape(count, -1))
    return columns
