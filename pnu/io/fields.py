"""Names that files give to a point's values: one place for ply, pcd, headers of text, and structured arrays."""

from collections.abc import Collection, Mapping
from itertools import chain, count
from typing import NamedTuple

import numpy as np

XYZ, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
POINTS = (
    XYZ,
    ("px", "py", "pz"),
    ("point_x", "point_y", "point_z"),
    ("points:0", "points:1", "points:2"),  # ParaView
    ("points_0", "points_1", "points_2"),
    ("x_coord", "y_coord", "z_coord"),
    ("coord_x", "coord_y", "coord_z"),
    *(("easting", "northing", up) for up in ("z", "height", "elevation", "altitude")),
)
DEGREES = tuple(
    (east, north, up)
    for east, north in (("longitude", "latitude"), ("lon", "lat"), ("lng", "lat"), ("long", "lat"))
    for up in ("z", "height", "elevation", "altitude", "alt", "h")
)
NORMALS = (
    NORMAL,
    ("normal_x", "normal_y", "normal_z"),
    ("normalx", "normaly", "normalz"),
    ("n_x", "n_y", "n_z"),
    ("normals_x", "normals_y", "normals_z"),
    ("normals:0", "normals:1", "normals:2"),
    ("normals_0", "normals_1", "normals_2"),
)
COLORS = (
    COLOR,
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("rf", "gf", "bf"),
    ("color_r", "color_g", "color_b"),
    ("color_red", "color_green", "color_blue"),
    ("colors_0", "colors_1", "colors_2"),
    ("rgb:0", "rgb:1", "rgb:2"),
)
ALPHAS = ("alpha", "a", "diffuse_alpha", "color_a", "color_alpha", "colors_3")
GEOGRAPHIC = "x and y are degrees, not lengths: project them to meters first, or shapes are distorted"


class Fields(NamedTuple):
    """What columns say: points and normals (n, 3), colors (n, 3 or 4) uint8, each None where it is not there."""

    points: np.ndarray | None
    normals: np.ndarray | None
    colors: np.ndarray | None
    others: dict[str, np.ndarray]  # under their own names
    notes: tuple[str, ...]  # what was left out


def arranged(columns: Mapping[str, np.ndarray], *, colors_as_found: bool = False) -> Fields:
    """Points, normals and colors found among columns (n,) by name, without regard to case.

    colors_as_found: in the numbers of the columns, for who knows only a part of them.
    """
    left = dict(columns)
    notes = []

    def take(spellings: tuple[tuple[str, ...], ...]) -> np.ndarray | None:
        for names in spellings:
            found = matching(names, left)
            if found:
                return np.stack([left.pop(name) for name in found], axis=1)
        return None

    points = take(POINTS)
    if points is None and (points := take(DEGREES)) is not None:
        notes.append(GEOGRAPHIC)
    normals = take(NORMALS)
    colors = take(COLORS)
    if colors is not None and (alpha := take(tuple((name,) for name in ALPHAS))) is not None:
        if alpha.dtype != colors.dtype and not colors_as_found:
            colors, alpha = as_colors(colors), as_colors(alpha)
        colors = np.hstack([colors, alpha])
    for kind, given, spellings in (("normals", normals, NORMALS), ("colors", colors, COLORS)):
        for names in spellings if given is not None else ():
            if found := matching(names, left):  # written again, they would contradict the first
                notes.append(f"{' '.join(found)} left out: a second set of {kind}")
                for name in found:
                    del left[name]
    found_colors = colors if colors is None or colors_as_found else as_colors(colors)
    return Fields(points, normals, found_colors, left, tuple(notes))


def distinct_names(names: Collection[str], own: Collection[str], *, length: int = 1000) -> dict[str, str]:
    """Names as they are written: ASCII without blanks, at most so long, and none that another column has.

    `own`: the columns of points, normals and colors that the format writes itself. What would be read as one of those,
    or as the same attribute twice, gets `scalar_` before it.
    """
    taken = {name.lower() for name in own}
    lower = {name.lower() for name in names}
    for spelling in (*NORMALS, *COLORS):
        taken |= set(spelling) if lower.issuperset(spelling) else set()
    taken |= set(ALPHAS) if taken.issuperset(COLOR) else set()
    result = {}
    for name in names:
        plain = "_".join(name.encode("ascii", "replace").decode().replace("?", "_").split())
        spelled = (f"{prefix}{plain}"[:length] for prefix in chain(("", "scalar_"), map("scalar{}_".format, count(2))))
        found = next(found for found in spelled if found and found.lower() not in taken)
        taken.add(found.lower())
        result[name] = found
    return result


def matching(names: tuple[str, ...], columns: Mapping[str, np.ndarray]) -> list[str]:
    """The columns (n,) that have these names, as they are spelled there; none if one lacks."""
    spelled = {name.lower(): name for name, values in reversed(list(columns.items())) if values.ndim == 1}
    found = [name if name in columns and columns[name].ndim == 1 else spelled.get(name) for name in names]
    return [name for name in found if name is not None] if None not in found else []


def bare_name(name: str) -> str:
    """A column's name in small letters, without underscores and the prefix of a scalar."""
    return name.lower().removeprefix("scalar_").replace("_", "")


def as_colors(values: np.ndarray, most: float | None = None) -> np.ndarray:
    """uint8 of colors in 0..1 (floats), 0..255, or 16 bits (0..65535); `most`: of all, where these are a part."""
    if values.dtype == np.uint8:
        return values
    most = np.nanmax(values, initial=0) if most is None else most
    if most > 255:
        scale = 1 / 257
    else:
        scale = 255 if most <= 1 and values.dtype.kind == "f" else 1
    return np.rint(np.clip(np.nan_to_num(values.astype(np.float64)) * scale, 0, 255)).astype(np.uint8)
