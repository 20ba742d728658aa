"""Point clouds written: each in the format that the suffix names."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from pnu.io.atomic import atomic_path, check_writable
from pnu.io.cloud import Cloud
from pnu.io.fields import COLOR, NORMAL, XYZ, as_colors, distinct_names
from pnu.io.las import write_las
from pnu.io.mesh import Geometry, ply_normals, write_obj, write_off, xyz_columns
from pnu.io.pcd import write_pcd
from pnu.io.ply import SLICE, write_ply
from pnu.io.shift import shifted
from pnu.io.text import known_suffix

PCD_NORMAL = ("normal_x", "normal_y", "normal_z")


def write_cloud(
    path: str | Path,
    points: np.ndarray,
    normals: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
) -> tuple[str, ...]:
    """Write points (n, 3), normals (n, 3) and attributes (n,) or (n, k) atomically, in the format of the suffix.

    Returns what was changed or left out, a line each.

    ply, pcd, las and laz are binary and keep attributes; text, obj and off keep colors alone; npy, an array (n, 3) or
    (n, 6), none (see `kept_attributes`). Coordinates are float32 in ply where that is good to a millionth of the
    extent; always in pcd, whose readers know nothing else, less a shift that a comment names where they need one;
    billionths of the extent in las and laz; and float64 otherwise.
    """
    path = Path(path)
    suffix = known_suffix(path, "point cloud to write", OUTPUT_SUFFIXES)
    points = np.asarray(points, np.float64)
    cloud = Cloud(points, None if normals is None else np.asarray(normals, np.float64), dict(attributes or {}))
    for name, values in (cloud.attributes | ({} if cloud.normals is None else {"normals": cloud.normals})).items():
        if len(values) != len(points):
            raise ValueError(f"{path}: expected {len(points)} rows of '{name}', one a point, found {np.shape(values)}")
    kept = kept_attributes(path, cloud.attributes)
    left = [name for name in cloud.attributes if name not in kept]
    cloud = cloud._replace(attributes={name: np.asarray(cloud.attributes[name]) for name in kept})
    with atomic_path(path) as temporary:
        notes = WRITERS[suffix](temporary, cloud)
    return (*notes, *([f"left out, since {suffix[1:]} does not hold them: {', '.join(left)}"] if left else []))


def check_output(path: str | Path) -> None:
    """`ValueError` where `write_cloud` would refuse this name: unknown suffix, no such folder, not writable."""
    known_suffix(Path(path), "point cloud to write", OUTPUT_SUFFIXES)
    check_writable(path)


def kept_attributes(path: str | Path, names: Iterable[str]) -> list[str]:
    """Which of a cloud's attributes the format of this suffix holds beside points and normals."""
    suffix = Path(path).suffix.lower()
    if suffix in (".ply", ".pcd", ".las", ".laz"):
        return list(names)
    return [name for name in names if name == "colors" and suffix != ".npy"]


def _write_las(path: Path, cloud: Cloud) -> list[str]:
    return _renamed(write_las(path, cloud.points, cloud.normals, storable_attributes(cloud.attributes)))


def _write_text(path: Path, cloud: Cloud) -> list[str]:
    """x y z, a color and a normal, in the order that CloudCompare and MeshLab use too."""
    columns, form = [cloud.points], "%.15g %.15g %.15g"
    if "colors" in cloud.attributes:
        columns, form = [*columns, as_colors(cloud.attributes["colors"])[:, :3]], form + " %d %d %d"
    if cloud.normals is not None:
        columns, form = [*columns, cloud.normals], form + " %.9g %.9g %.9g"
    np.savetxt(path, np.hstack(columns), form)
    return []


def _storable(values: np.ndarray) -> np.ndarray:
    """In a type that ply and pcd know."""
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype == np.float16:
        return values.astype(np.float32)
    return values if values.dtype.kind in "iuf" and values.itemsize <= 4 else values.astype(np.float64)


def _renamed(names: Mapping[str, str]) -> list[str]:
    return [f"'{name}' is written as '{found}'" for name, found in names.items() if found != "_".join(name.split())]


def ply_columns(
    points: np.ndarray,
    normals: np.ndarray | None,
    attributes: Mapping[str, np.ndarray],
    *,
    single: bool | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Properties of a ply's vertices (n,), and under which name each attribute is among them.

    single: whether coordinates are float32; None: where that is enough.
    """
    if single is None:
        own = xyz_columns(points)
    else:
        own = dict(zip(XYZ, points.astype(np.float32 if single else np.float64).T, strict=True))
    own |= ply_normals(normals)
    more: dict[str, np.ndarray] = {}
    for name, values in attributes.items():
        if name == "colors":
            own |= dict(zip((*COLOR, "alpha"), as_colors(values).T, strict=False))
        elif values.ndim == 1:
            more[name] = _storable(values)
        else:
            flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
            more |= {f"{name}_{i}": _storable(column) for i, column in enumerate(flat.T)}
    names = distinct_names(more, own)
    return own | {names[name]: values for name, values in more.items()}, names


def storable_attributes(attributes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Attributes in types that ply and las know; colors as uint8."""
    return {name: as_colors(v) if name == "colors" else _storable(v) for name, v in attributes.items()}


def _write_ply(path: Path, cloud: Cloud) -> list[str]:
    columns, names = ply_columns(cloud.points, cloud.normals, cloud.attributes)
    write_ply(path, columns)
    return _renamed(names)


def _write_pcd(path: Path, cloud: Cloud) -> list[str]:
    single = shifted(cloud.points)
    own = dict(zip(XYZ, single.points.T, strict=True))
    if cloud.normals is not None:
        own |= dict(zip(PCD_NORMAL, cloud.normals.T.astype(np.float32), strict=True))
    if "colors" in cloud.attributes:
        colors = as_colors(cloud.attributes["colors"])
        packed = np.zeros((len(colors), 4), np.uint8)
        packed[:, :3] = colors[:, 2::-1]
        packed[:, 3] = colors[:, 3] if colors.shape[1] == 4 else 0
        own["rgb" if colors.shape[1] == 3 else "rgba"] = packed.view(np.uint32)[:, 0]
    more = {name: _storable(values) for name, values in cloud.attributes.items() if name != "colors"}
    names = distinct_names(more, {*own, *NORMAL, "rgb", "rgba", "_"})
    comments = [single.text] if single.text else []
    write_pcd(path, own | {names[name]: values for name, values in more.items()}, comments)
    return [*single.notes, *_renamed(names)]


def _write_npy(path: Path, cloud: Cloud) -> list[str]:
    columns = [cloud.points] if cloud.normals is None else [cloud.points, cloud.normals]
    shape = (len(cloud.points), 3 * len(columns))
    with path.open("wb") as handle:
        np.lib.format.write_array_header_1_0(handle, {"descr": "<f8", "fortran_order": False, "shape": shape})
        for start in range(0, len(cloud.points), SLICE):
            np.hstack([values[start : start + SLICE] for values in columns]).astype("<f8").tofile(handle)
    return []


def _write_geometry(write: Callable[[Path, Geometry], None]) -> Callable[[Path, Cloud], list[str]]:
    def vertices(path: Path, cloud: Cloud) -> list[str]:
        colors = cloud.attributes.get("colors")
        colors = None if colors is None else as_colors(colors)[:, :3]
        write(path, Geometry(cloud.points, np.empty((0, 3), np.int64), cloud.normals, colors))
        return []

    return vertices


WRITERS: dict[str, Callable[[Path, Cloud], list[str]]] = {
    ".ply": _write_ply,
    ".xyz": _write_text,
    ".txt": _write_text,
    ".pcd": _write_pcd,
    ".obj": _write_geometry(write_obj),
    ".off": _write_geometry(write_off),
    ".npy": _write_npy,
    ".las": _write_las,
    ".laz": _write_las,
}
OUTPUT_SUFFIXES = frozenset(WRITERS)
