"""What the columns of a table are where it has no names: by the usual order, and by what the numbers can be."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pnu.io.fields import COLOR, NORMAL, POINTS, XYZ

SKIP = "_"
USUAL = "x,y,z,nx,ny,nz"
UNIT = 0.05  # by which the length of a normal may differ from 1, as text rounds it


class Columns(NamedTuple):
    """Names of the columns, `_` for one that is left out, and what to say of them."""

    names: list[str]
    notes: tuple[str, ...] = ()


def spelled(columns: str | Sequence[str]) -> list[str]:
    """Names from `columns=x,y,z,_,r,g,b`; `ValueError` where they have no x y z, or one of them twice."""
    text = columns if isinstance(columns, str) else ",".join(columns)
    names = [word.strip() for word in text.strip("[]() ").split(",")]
    lower = [name.lower() for name in names if name not in (SKIP, "")]
    if len(set(lower)) < len(lower) or not any(set(lower).issuperset(xyz) for xyz in POINTS):
        raise ValueError(f"columns={text}: expected x, y and z among the names, each once, such as x,y,z,_,r,g,b")
    return ["intensity" if name.lower() == "i" else name or SKIP for name in names]


def guessed(name: str, values: np.ndarray, suffix: str = "") -> Columns:
    """The columns of values (n, k), k >= 3: x y z, then unit normals and colors where they stand; others are scalars.

    `ValueError` beginning with `name`, where they could be several things and nothing speaks for one.
    """
    width = values.shape[1]
    if width == 3:
        return Columns([*XYZ])
    if is_row_number(values[:, 0]):
        names, notes = guessed(name, values[:, 1:], suffix)
        return Columns([SKIP, *names], ("column 1 counts the points: left out", *notes))
    names = [*XYZ, *[""] * (width - 3)]
    doubt = ""
    spots = [i for i in range(3, width - 2) if is_normal(values[:, i : i + 3]) and suffix != ".xyzrgb"]
    if spots:
        names[spots[0] : spots[0] + 3] = NORMAL
    spots = [i for i in range(3, width - 2) if not any(names[i : i + 3]) and is_color(values[:, i : i + 3])]
    if suffix in (".xyzn", ".pwn") and width == 6:
        names[3:] = NORMAL
    elif spots:
        at = _color(values, spots, suffix)
        doubt = "i" if len(spots) > 1 and not _constant(values[:, spots[0] + 3]) else ""
        names[at : at + 3] = COLOR
        if at + 3 < width and not names[at + 3] and _constant(values[:, at + 3]):
            names[at + 3] = "alpha"
    left = [i for i in range(width) if not names[i]]
    if len(left) == 3 and left[2] - left[0] == 2:
        kind = _kind(name, values[:, left])
        names[left[0] : left[2] + 1] = kind
    elif len(left) == 1 and (width == 4 or "red" in names):
        names[left[0]] = "intensity"
    names = [known or f"column_{i + 1}" for i, known in enumerate(names)]
    if names[3:] in ([*NORMAL], [*COLOR]):
        return Columns(names)
    said = f"columns taken as {' '.join(names)}"
    if doubt:
        other = ["x", "y", "z", *(("i", "r", "g", "b") if names[3] == "red" else ("r", "g", "b", "i")), *names[7:]]
        return Columns(names, (f"{said}; if they are not: columns={','.join(other)}",))
    return Columns(names, (f"{said}; columns=x,y,z,... says otherwise",))


def is_row_number(values: np.ndarray) -> bool:
    """Whether a column says no more than the number of its row."""
    return len(values) > 2 and values[0] in (0, 1) and bool(np.all(np.diff(values) == 1))


def is_normal(values: np.ndarray) -> bool:
    """Whether columns (n, 3) are unit vectors, but for a few."""
    lengths = np.linalg.norm(values, axis=1)
    lengths = lengths[np.isfinite(lengths) & (lengths > 0)]
    return bool(len(lengths) and np.mean(np.abs(lengths - 1) < UNIT) > 0.9)


def is_color(values: np.ndarray) -> bool:
    """Whether columns (n, 3) are whole numbers 0..255, or fractions 0..1 that show something."""
    least, most = np.nanmin(values, initial=0), np.nanmax(values, initial=0)
    if least < 0 or most == 0:
        return False
    whole = np.array_equal(values, np.rint(values), equal_nan=True)
    return bool(1 / 255 <= most <= 1 or (most <= 255 and whole))


def _constant(values: np.ndarray) -> bool:
    return bool(np.all(values == values[0]) and values[0] in (1, 255))


def _color(values: np.ndarray, spots: list[int], suffix: str) -> int:
    """Where of several spots red stands: beside a constant alpha, in pts and ptx behind the intensity, else first."""
    if len(spots) == 1 or _constant(values[:, spots[0] + 3]):
        return spots[0]
    return spots[1] if suffix in (".pts", ".ptx") else spots[0]


def _kind(name: str, values: np.ndarray) -> tuple[str, ...]:
    """Three columns that are neither unit vectors nor colors in 0..255."""
    values = values[np.isfinite(values).all(axis=1)]
    if not values.any() or (values < 0).any() or values.max() < 1 / 255:
        return NORMAL  # of any length, zero among them
    if values.max() <= 65535 and np.array_equal(values, np.rint(values)):
        return COLOR
    raise ValueError(
        f"{name}: three columns after x y z are neither unit normals nor colors of 0..1, 0..255 or 0..65535; say which "
        f"they are: columns={USUAL} or columns=x,y,z,r,g,b"
    )
