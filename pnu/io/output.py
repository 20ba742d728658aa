"""Point clouds written: each in the format that the suffix names."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from pnu.io.atomic import atomic_path, check_writable
from pnu.io.cloud import CLOUD_SUFFIXES, NORMAL_FIELDS, Cloud
from pnu.io.fields import as_colors
from pnu.io.las import write_las
from pnu.io.mesh import Geometry, ply_normals, write_obj, write_off, xyz_columns
from pnu.io.pcd import write_pcd
from pnu.io.ply import SLICE, write_ply
from pnu.io.text import known_suffix


def write_cloud(
    path: str | Path,
    points: np.ndarray,
    normals: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write points (n, 3), normals (n, 3) and attributes (n,) or (n, k) atomically, in the format of the suffix.

    ply, pcd, las and laz are binary and keep attributes (see `keeps_attributes`); the others do not. Coordinates are
    float64 in npy, which is an array (n, 3) or (n, 6); float32 in ply where that is exact, in pcd where it is good to
    a millionth of the extent, billionths of the extent in las and laz, and float64 otherwise.
    """
    path = Path(path)
    suffix = known_suffix(path, "point cloud", CLOUD_SUFFIXES)
    points = np.asarray(points, np.float64)
    cloud = Cloud(points, None if normals is None else np.asarray(normals, np.float64), dict(attributes or {}))
    for name, values in (cloud.attributes | ({} if cloud.normals is None else {"normals": cloud.normals})).items():
        if len(values) != len(points):
            raise ValueError(f"{path}: expected {len(points)} rows of '{name}', one a point, found {np.shape(values)}")
    with atomic_path(path) as temporary:
        WRITERS[suffix](temporary, cloud)


def check_output(path: str | Path) -> None:
    """`ValueError` where `write_cloud` would refuse this name: unknown suffix, no such folder, not writable."""
    known_suffix(Path(path), "point cloud", CLOUD_SUFFIXES)
    check_writable(path)


def keeps_attributes(path: str | Path) -> bool:
    """Whether the format of this suffix holds colours and scalars beside points and normals."""
    return Path(path).suffix.lower() in {*NORMAL_FIELDS, ".las", ".laz"}


def _write_las(path: Path, cloud: Cloud) -> None:
    attributes = _storable(cloud.attributes)
    if "colors" in attributes and attributes["colors"].dtype != np.uint8:
        attributes["colors"] = as_colors(attributes["colors"])
    write_las(path, cloud.points, cloud.normals, attributes)


def _write_text(path: Path, cloud: Cloud) -> None:
    rows, form = _joined(cloud), "%.15g %.15g %.15g" + ("" if cloud.normals is None else " %.9g %.9g %.9g")
    np.savetxt(path, rows, form)


def _joined(cloud: Cloud) -> np.ndarray:
    return cloud.points if cloud.normals is None else np.hstack([cloud.points, cloud.normals])


def _storable(attributes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Attributes in types that ply and pcd know; blanks in names become _."""
    result = {}
    for name, values in attributes.items():
        values = np.asarray(values)
        if values.dtype.kind == "b":
            values = values.astype(np.uint8)
        elif values.dtype == np.float16:
            values = values.astype(np.float32)
        elif values.dtype.kind not in "iuf" or values.itemsize > 4:
            values = values.astype(np.float64)
        result["_".join(name.split())] = values
    return result


def _write_ply(path: Path, cloud: Cloud) -> None:
    columns = xyz_columns(cloud.points) | ply_normals(cloud.normals)
    for name, values in _storable(cloud.attributes).items():
        if name == "colors" and values.ndim == 2 and values.shape[1] in (3, 4):
            values = values if values.dtype == np.uint8 else as_colors(values)
            columns |= dict(zip(("red", "green", "blue", "alpha"), values.T, strict=False))
        elif values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}_{i}": column for i, column in enumerate(values.reshape(len(values), -1).T)}
    write_ply(path, columns)


def _write_pcd(path: Path, cloud: Cloud) -> None:
    # Most readers of pcd know coordinates as float32 only.
    single = cloud.points.astype(np.float32)
    enough = np.abs(single - cloud.points).max(initial=0) <= 1e-6 * np.ptp(cloud.points, axis=0).max(initial=0)
    fields = dict(zip("xyz", (single if enough else cloud.points).T, strict=True))
    if cloud.normals is not None:
        fields |= dict(zip(NORMAL_FIELDS[".pcd"], cloud.normals.T.astype(np.float32), strict=True))
    for name, values in _storable(cloud.attributes).items():
        if name == "colors" and values.ndim == 2 and values.shape[1] in (3, 4):
            values = values if values.dtype == np.uint8 else as_colors(values)
            packed = np.zeros((len(values), 4), np.uint8)
            packed[:, :3] = values[:, 2::-1]
            packed[:, 3] = values[:, 3] if values.shape[1] == 4 else 0
            fields["rgb" if values.shape[1] == 3 else "rgba"] = packed.view(np.uint32)[:, 0]
        else:
            fields[name] = values
    write_pcd(path, fields)


def _write_npy(path: Path, cloud: Cloud) -> None:
    columns = [cloud.points] if cloud.normals is None else [cloud.points, cloud.normals]
    shape = (len(cloud.points), 3 * len(columns))
    with path.open("wb") as handle:
        np.lib.format.write_array_header_1_0(handle, {"descr": "<f8", "fortran_order": False, "shape": shape})
        for start in range(0, len(cloud.points), SLICE):
            np.hstack([values[start : start + SLICE] for values in columns]).astype("<f8").tofile(handle)


def _write_geometry(write: Callable[[Path, Geometry], None]) -> Callable[[Path, Cloud], None]:
    return lambda path, cloud: write(path, Geometry(cloud.points, np.empty((0, 3), np.int64), cloud.normals))


WRITERS: dict[str, Callable[[Path, Cloud], None]] = {
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
