"""Point clouds read, whatever the format, through one door."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pnu.io.arrays import read_array
from pnu.io.columns import SKIP, guessed, spelled
from pnu.io.delimited import read_ptx, read_text
from pnu.io.e57 import read_e57
from pnu.io.fields import GEOGRAPHIC, arranged
from pnu.io.las import read_las
from pnu.io.mesh import Geometry, read_gltf_mesh, read_obj, read_off, read_stl, read_vtk_mesh
from pnu.io.pcd import read_pcd
from pnu.io.ply import element_sizes, read_ply
from pnu.io.text import open_file

TEXTS = (".xyz", ".txt", ".pts", ".asc", ".csv", ".tsv", ".pwn", ".xyzn", ".xyzrgb")
LARGEST = 1e30  # beyond, squared distances leave the range of float64 or what float32 can hold after scaling
ORIGIN = 1e-6  # of the usual distance from 0 0 0: some write a small number for zero
UNSEEN = 10  # times that the origin is given as often as other places
STEEP = 500  # times that z spans x and y where these are degrees
LENGTH = 0.05  # by which that of a unit normal may differ from 1, as text rounds it


class Cloud(NamedTuple):
    """Points, their normals or None, and what else the file says about each point.

    points (n, 3) float64; normals (n, 3) float64 of length 1, NaN where a point has none.
    attributes: name -> (n,) or (n, k). Colors are "colors", (n, 3) or (n, 4) uint8.
    notes: what was found and done while it was read, a line each: left out, taken for something, changed.
    """

    points: np.ndarray
    normals: np.ndarray | None
    attributes: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()


@np.errstate(invalid="ignore", over="ignore")  # what is not finite is named by the checks
def read_cloud(
    path: str | Path,
    *,
    minimum: int = 16,
    normals: bool = True,
    columns: str | Sequence[str] | None = None,
    pulses: bool = False,
) -> Cloud:
    """Read a point cloud, checked as by `check_cloud`; with `normals=False` without normals.

    columns: of text and of arrays without names, such as "x,y,z,_,r,g,b" (_ is left out); None: by the names in the
    file, or by the usual order: x y z, then unit normals, colors and scalars where they stand.
    pulses: of las also what belongs to the pulse and not to the place: number of returns, scan angle ...
    Of a mesh the vertices are taken. Coordinates stay float64.

    Raises `ValueError` (one line: file, what was expected, what was found, what to do) for a missing, empty, damaged
    or unknown file, fewer than `minimum` points that can be used, and points that are all equal.
    """
    path = Path(path)
    suffix = open_file(path, "point cloud", CLOUD_SUFFIXES)
    if columns is None:
        las = pulses and suffix in (".las", ".laz")
        cloud = Cloud(*read_las(path, pulses=True)) if las else READERS[suffix](path)
    elif suffix in TABLES:
        cloud = READERS[suffix](path, spelled(columns))  # type: ignore[call-arg]
    else:
        raise ValueError(f"{path}: has names for what it holds; columns= is for text and arrays without")
    if not normals:
        cloud = cloud._replace(normals=None)
    return check_cloud(cloud, str(path), minimum=minimum)


def columns_of(paths: Sequence[str | Path], columns: str | None, name: str) -> list[str | None]:
    """What `read_cloud` takes as `columns` for each of several files: null for those that have names of their own.

    `ValueError`, beginning with `columns=`, where they are no names or none of the files takes them; `name`: of all.
    """
    if columns is None:
        return [None] * len(paths)
    spelled(columns)
    found = [columns if Path(path).suffix.lower() in TABLES else None for path in paths]
    if not any(found):
        raise ValueError(f"columns={columns}: is for text and arrays without names, and {name} has none of them")
    return found


@np.errstate(invalid="ignore", over="ignore")
def check_cloud(cloud: Cloud, name: str, *, minimum: int = 16) -> Cloud:
    """The cloud as everything after it takes it, with a note for each thing that was changed.

    Points float64, finite, each place once; normals of length 1, NaN where a point has none, None where all have none.
    `ValueError`, beginning with `name`, if too little is left or the shapes are wrong.
    """
    points = np.asarray(cloud.points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected points of shape (n, 3), found {points.shape}; give one row a point")
    count, notes = len(points), [*cloud.notes]
    if count < minimum:
        raise ValueError(f"{name}: holds {count} points; at least {minimum} are needed")
    if cloud.normals is not None and np.shape(cloud.normals) != points.shape:
        raise ValueError(f"{name}: expected normals of shape {points.shape}, found {np.shape(cloud.normals)}")
    good = (np.abs(points) < LARGEST).all(axis=1)
    if not good.all():
        notes.append(f"{count - good.sum()} of {count} points left out: NaN, infinite or beyond {LARGEST:g}")
        if good.sum() < minimum:
            raise ValueError(f"{name}: {notes[-1]}; at least {minimum} others are needed")
        cloud = chosen(cloud._replace(points=points), np.flatnonzero(good))
    count = len(cloud.points)
    if count > 1 and np.ptp(cloud.points, axis=0).max() <= max(1e-12 * np.abs(cloud.points).max(), 1 / LARGEST):
        raise ValueError(f"{name}: all {count} points are equal; expected points on a surface")
    first = first_of_each_place(cloud.points, cloud.normals)
    size = np.abs(cloud.points).max(axis=1)
    unseen = size <= ORIGIN * np.median(size[first])
    places = unseen[first].sum()  # a piece of a cloud that happens to lie at the origin has many
    if places and unseen.sum() / places > UNSEEN * count / len(first):
        notes.append(f"{unseen.sum()} of {count} points left out: at the origin, where a sensor saw nothing")
        count, first = count - unseen.sum(), first[~unseen[first]]
    if len(first) < count:
        notes.append(f"{count - len(first)} of {count} points left out: at the place of another")
    if len(first) < minimum:
        raise ValueError(f"{name}: holds {len(first)} different points; at least {minimum} are needed")
    if len(first) < len(cloud.points):
        cloud = chosen(cloud, first)
    if GEOGRAPHIC not in notes and looks_geographic(cloud.points):
        notes.append(f"{GEOGRAPHIC} (so it seems, as z spans more than {STEEP} times as much)")
    normals, found = unit_normals(cloud.normals)
    return Cloud(np.asarray(cloud.points, np.float64), normals, dict(cloud.attributes), (*notes, *found))


def looks_geographic(points: np.ndarray) -> bool:
    """Whether x and y can be degrees beside a z in meters: a few kilometers of land are hundredths of a degree.

    So is a pole of a millimeter's width and a meter's height, far from the origin: nothing else is so steep.
    """
    least, most = points.min(axis=0), points.max(axis=0)
    size, place = most - least, np.maximum(np.abs(least), np.abs(most))
    inside = place[0] <= 180 and place[1] <= 90 and (place[:2] > 10 * size[:2]).all()
    return bool(inside and 0 < size[:2].max() < 1 and size[2] > STEEP * size[:2].max())


def chosen(cloud: Cloud, rows: np.ndarray) -> Cloud:
    """Some points of a cloud, with what belongs to them."""
    normals = None if cloud.normals is None else np.asarray(cloud.normals)[rows]
    attributes = {name: np.asarray(values)[rows] for name, values in cloud.attributes.items()}
    return Cloud(cloud.points[rows], normals, attributes, cloud.notes)


def first_of_each_place(points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
    """One row for each place of points (n, 3), (m,) in order; of several normals the first in theirs."""
    order, new = _places(points.T)
    if new.all():
        return np.arange(len(points))
    if normals is not None:
        order, new = _places([*np.asarray(normals).T, *points.T])
    return np.sort(order[new])


def _places(keys: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Rows sorted by keys, x y z the last of them, and which of them is the first of its place."""
    keys = list(keys)
    order = np.lexsort(keys)
    new = np.ones(len(order), bool)
    new[1:] = np.any([np.diff(key[order]) != 0 for key in keys[-3:]], axis=0)
    return order, new


def unit_normals(normals: np.ndarray | None) -> tuple[np.ndarray | None, list[str]]:
    """Normals (n, 3) brought to length 1, NaN where they have no direction, None where none has; and what to say."""
    if normals is None:
        return None, []
    normals = np.asarray(normals, np.float64)
    largest = np.abs(normals).max(axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        scaled = normals / largest  # squares of the smallest and the largest would leave float64
    missing = ~np.isfinite(scaled).all(axis=1)
    if missing.all():
        return None, ["normals are all zero or NaN: taken as none"]
    scaled[missing] = np.nan
    size = np.linalg.norm(scaled, axis=1, keepdims=True)
    lengths = (largest * size)[~missing]
    notes = []
    if missing.any():
        notes.append(f"{missing.sum()} of {len(normals)} normals are zero or NaN: theirs are estimated")
    if np.mean(np.abs(lengths - 1) > LENGTH) > 0.01:
        notes.append(f"normals have lengths {lengths.min():.2g} to {lengths.max():.2g}: their directions are taken")
    return scaled / size, notes


def _read_text(path: Path, columns: Sequence[str] | None = None) -> Cloud:
    return _from_table(path, *read_text(path, columns))


def _read_ptx(path: Path, columns: Sequence[str] | None = None) -> Cloud:
    (values, names, notes), of_scans = read_ptx(path)
    cloud = _from_table(path, values, names if columns is None else list(columns), notes)
    return cloud._replace(attributes=cloud.attributes | of_scans)


def _read_array(path: Path, columns: Sequence[str] | None = None) -> Cloud:
    values, notes = read_array(path)
    if isinstance(values, np.ndarray):
        return _from_table(path, values, None if columns is None else list(columns), notes)
    if columns is not None:
        raise ValueError(f"{path}: has names for what it holds; columns= is for text and arrays without")
    return _from_columns(path, values, notes)


def _from_table(path: Path, values: np.ndarray, names: list[str] | None, notes: tuple[str, ...]) -> Cloud:
    """Columns by their names, or by the usual order."""
    if not values.size:
        raise ValueError(f"{path}: holds no numbers; expected x y z, or x y z and a normal, in each line")
    if names is None:
        if values.shape[1] < 3:
            raise ValueError(
                f"{path}: has {values.shape[1]} columns; expected x y z, and what else there is of a point"
            )
        names, more = guessed(str(path), values, path.suffix.lower())
        notes = (*notes, *more)
    if len(names) != values.shape[1]:
        raise ValueError(f"{path}: columns={','.join(names)} are {len(names)} names, it has {values.shape[1]} columns")
    columns = {name: column for name, column in zip(names, values.T, strict=True) if name != SKIP}
    return _from_columns(path, columns, notes, "say which they are: columns=x,y,z,...")


def _read_ply(path: Path) -> Cloud:
    columns = {name: v for name, v in read_ply(path, {"vertex"}).get("vertex", {}).items() if isinstance(v, np.ndarray)}
    return _without_faces(_from_columns(path, columns), element_sizes(path).get("face", 0))


def _without_faces(cloud: Cloud, faces: int) -> Cloud:
    """A cloud that was read from a file with faces, which says so."""
    note = (
        f"a mesh: its vertices are the points, its {faces} faces are ignored (pnu.upsample samples them: sample=5000)"
    )
    return cloud._replace(notes=(*cloud.notes, note)) if faces else cloud


def _read_pcd(path: Path) -> Cloud:
    columns = read_pcd(path)
    for name in [name for name in columns if name.lower() in ("rgb", "rgba")]:
        packed = columns[name]
        if packed.ndim == 1 and packed.itemsize == 4:
            del columns[name]
            blue, green, red, alpha = packed.view(np.uint32)[:, None].view(np.uint8).reshape(-1, 4).T
            columns["colors"] = np.stack([red, green, blue, alpha][: len(name)], axis=1)
    return _from_columns(path, columns)


def _from_columns(
    path: Path, columns: dict[str, np.ndarray], notes: tuple[str, ...] = (), cure: str = "save it again"
) -> Cloud:
    found = arranged(columns)
    if found.points is None:
        raise ValueError(f"{path}: expected points with x y z, found {' '.join(columns) or 'none'}; {cure}")
    attributes = found.others if found.colors is None else found.others | {"colors": found.colors}
    return Cloud(found.points.astype(np.float64), found.normals, attributes, (*notes, *found.notes))


def _read_las(path: Path) -> Cloud:
    return Cloud(*read_las(path))


def _read_e57(path: Path) -> Cloud:
    return _from_columns(path, read_e57(path))


def _from_geometry(read: Callable[[Path], Geometry]) -> Callable[[Path], Cloud]:
    def cloud(path: Path) -> Cloud:
        vertices, faces, normals, colors = read(path)
        return _without_faces(Cloud(vertices, normals, {} if colors is None else {"colors": colors}), len(faces))

    return cloud


TABLES = frozenset({*TEXTS, ".ptx", ".npy", ".npz"})  # whose columns may have no names
READERS: dict[str, Callable[[Path], Cloud]] = {
    ".ply": _read_ply,
    **dict.fromkeys(TEXTS, _read_text),
    ".ptx": _read_ptx,
    ".pcd": _read_pcd,
    ".obj": _from_geometry(read_obj),
    ".off": _from_geometry(read_off),
    ".stl": _from_geometry(read_stl),
    ".glb": _from_geometry(read_gltf_mesh),
    ".gltf": _from_geometry(read_gltf_mesh),
    ".vtk": _from_geometry(read_vtk_mesh),
    ".vtp": _from_geometry(read_vtk_mesh),
    ".e57": _read_e57,
    ".npy": _read_array,
    ".npz": _read_array,
    ".las": _read_las,
    ".laz": _read_las,
}
CLOUD_SUFFIXES = frozenset(READERS)
