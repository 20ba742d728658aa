"""Points of a file of any size, a slice at a time: las, laz, binary ply and npy."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pnu.io.arrays import npy_slices
from pnu.io.cloud import LARGEST, Cloud
from pnu.io.columns import SKIP, guessed, spelled
from pnu.io.fields import arranged
from pnu.io.las import las_is_geographic, las_slices
from pnu.io.ply import ply_slices
from pnu.io.text import open_file

STREAMED = frozenset({".las", ".laz", ".ply", ".npy"})
SLICE = 2**18  # points


def check_streamed(path: str | Path) -> None:
    """`ValueError` for a file that is not read in slices."""
    suffix = Path(path).suffix.lower()
    if suffix not in STREAMED:
        raise ValueError(
            f"{path}: {suffix or 'a file without suffix'} is not read in slices, as memory= and tiles= want it; "
            f"save it as one of {' '.join(sorted(STREAMED))}"
        )
    open_file(Path(path), "point cloud", STREAMED)


@np.errstate(invalid="ignore", over="ignore")
def point_slices(path: str | Path, columns: str | None = None, *, rows: int = SLICE) -> Iterator[Cloud]:
    """The points of a file, `rows` at a time in their order, as they are found: nothing is checked or left out.

    columns: of an npy without names. Attributes keep their type; colors too, whatever their range is.

    Raises:
        ValueError: one line: file, what was expected, what was found, what to do.
    """
    path = Path(path)
    suffix = open_file(path, "point cloud", STREAMED)
    if columns is not None and suffix != ".npy":
        raise ValueError(f"{path}: has names for what it holds; columns= is for text and arrays without")
    if suffix in (".las", ".laz"):
        for points, normals, attributes in las_slices(path, rows):
            yield Cloud(points, normals, attributes)
        return
    names: list[str] | None = None if columns is None else list(spelled(columns))
    for found in ply_slices(path, rows) if suffix == ".ply" else npy_slices(path, rows):
        if isinstance(found, np.ndarray):
            names = guessed(str(path), found, suffix).names if names is None else names
            if len(names) != found.shape[1]:
                raise ValueError(f"{path}: columns={','.join(names)} are {len(names)} names, it has {found.shape[1]}")
            found = {name: column for name, column in zip(names, found.T, strict=True) if name != SKIP}
        fields = arranged(found, colors_as_found=True)
        if fields.points is None:
            raise ValueError(f"{path}: expected points with x y z, found {' '.join(found) or 'none'}; save it again")
        others = fields.others if fields.colors is None else fields.others | {"colors": fields.colors}
        yield Cloud(fields.points.astype(np.float64), fields.normals, others)


def in_range(points: np.ndarray) -> np.ndarray:
    """Which of the points (n, 3) are neither NaN, infinite nor beyond what can be computed with, (n,)."""
    with np.errstate(invalid="ignore"):
        good: np.ndarray = (np.abs(points) < LARGEST).all(axis=1)
    return good


def is_geographic(path: str | Path) -> bool:
    """Whether a file says that x and y are degrees."""
    return Path(path).suffix.lower() in (".las", ".laz") and las_is_geographic(Path(path))
