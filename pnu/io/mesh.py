"""Triangle meshes: ply, off, obj, stl; glb, gltf, vtk and vtp are read only."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pnu.io.atomic import atomic_path
from pnu.io.fields import NORMAL, XYZ, arranged, as_colors
from pnu.io.gltf import read_gltf
from pnu.io.ply import Lists, read_ply, write_ply
from pnu.io.polygons import triangulate
from pnu.io.shift import read_shift, shifted, single_is_enough
from pnu.io.text import indices, known_suffix, open_file, table, text_lines
from pnu.io.vtk import read_vtk


class Mesh(NamedTuple):
    """Vertices (v, 3) float64 and triangles (f, 3) int64, indices into the vertices, counter-clockwise from outside."""

    vertices: np.ndarray
    faces: np.ndarray


class Geometry(NamedTuple):
    """What a mesh format holds: vertices (v, 3), faces (f, 3); normals (v, 3) and colors (v, 3) uint8, or None."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None


@np.errstate(invalid="ignore", over="ignore")  # what is not finite is named by the checks
def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh; polygons are cut into triangles.

    Raises `ValueError` (one line: file, what was expected, what was found, what to do) for a missing, empty, damaged
    or unknown file, a mesh without faces, corners that are no vertices, coordinates that are not finite.
    """
    path = Path(path)
    suffix = open_file(path, "mesh", MESH_SUFFIXES)
    geometry = READERS[suffix](path)
    vertices, faces = geometry.vertices, geometry.faces
    if not len(faces):
        raise ValueError(f"{path}: expected a mesh, found {len(vertices)} vertices and no faces; give a triangle mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"{path}: a face has corner {faces.min() if faces.min() < 0 else faces.max()}, there are {len(vertices)} "
            "vertices; the file is damaged, save it again"
        )
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise ValueError(
            f"{path}: {len(bad)} of {len(vertices)} vertices hold NaN or infinity (the first: "
            f"number {bad[0] + 1}); repair the mesh"
        )
    return Mesh(vertices, faces)


def write_mesh(
    path: str | Path,
    mesh: Mesh,
    *,
    vertex_normals: np.ndarray | None = None,
    colors: np.ndarray | None = None,
    quality: np.ndarray | None = None,
) -> tuple[str, ...]:
    """Write a mesh atomically, in the format of the suffix; returns what was changed, a line each.

    vertex_normals (v, 3), colors (v, 3) uint8 or 0..1, quality (v,) any scalar: kept by ply; obj and off keep the
    first two; stl none. stl, which knows single precision only, names a shift where coordinates need one.
    """
    path = Path(path)
    suffix = known_suffix(path, "mesh to write", MESH_OUTPUTS)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if colors is not None and np.issubdtype(np.asarray(colors).dtype, np.floating):
        colors = np.rint(np.clip(colors, 0, 1) * 255)
    notes: tuple[str, ...] = ()
    with atomic_path(path) as temporary:
        if suffix == ".ply":
            columns = xyz_columns(vertices) | ply_normals(vertex_normals)
            if colors is not None:
                columns |= dict(zip(("red", "green", "blue"), np.asarray(colors).T.astype(np.uint8), strict=True))
            if quality is not None:
                columns["quality"] = np.asarray(quality, np.float32)
            write_ply(temporary, columns, faces)
        elif suffix == ".stl":
            notes = _write_stl(temporary, vertices, faces)
        else:
            writer = write_obj if suffix == ".obj" else write_off
            writer(temporary, Geometry(vertices, faces, vertex_normals, colors))
    return notes


def xyz_columns(points: np.ndarray) -> dict[str, np.ndarray]:
    """In single precision, which every program reads, where that is enough."""
    kind = np.float32 if single_is_enough(points) else np.float64
    return dict(zip(XYZ, points.astype(kind).T, strict=True))


def ply_normals(normals: np.ndarray | None) -> dict[str, np.ndarray]:
    """Normals as properties of ply."""
    return {} if normals is None else dict(zip(NORMAL, np.asarray(normals, np.float32).T, strict=True))


def _read_ply(path: Path) -> Geometry:
    elements = read_ply(path, {"vertex", "face"})
    vertex = arranged({name: v for name, v in elements.get("vertex", {}).items() if isinstance(v, np.ndarray)})
    if vertex.points is None:
        raise ValueError(f"{path}: expected a vertex element with properties x y z; save the file again")
    vertices = vertex.points.astype(np.float64)
    faces = np.empty((0, 3), np.int64)
    for name, corners in elements.get("face", {}).items():
        if name.lower() in ("vertex_indices", "vertex_index") and isinstance(corners, Lists):
            faces = triangulate(vertices, corners.counts, corners.values.astype(np.int64))
    return Geometry(vertices, faces, vertex.normals, vertex.colors)


def read_obj(path: Path) -> Geometry:
    """Wavefront: v (with colors behind), vn, f. A vertex normal is the mean of those that its corners name."""
    rows: dict[str, list[str]] = {"v": [], "vn": []}
    faces: list[tuple[str, int, int]] = []  # and how many vertices and normals were read before
    for line in _obj_lines(path):
        key, *rest = line.split(maxsplit=1)
        if key in rows:
            if not rest:
                raise ValueError(f"{path}: a line has '{key}' and no numbers; expected x y z")
            rows[key].append(rest[0])
        elif key == "f":
            faces.append((rest[0] if rest else "", len(rows["v"]), len(rows["vn"])))
    values = table(path, lambda: rows["v"])
    if values.size and values.shape[1] not in (3, 4, 6, 7):
        raise ValueError(f"{path}: a vertex (v) has {values.shape[1]} numbers; expected 3 (x y z), 4, 6 or 7")
    vertices = values[:, :3] if values.size else np.empty((0, 3))
    colors = as_colors(values[:, -3:]) if values.size and values.shape[1] >= 6 else None
    given = table(path, lambda: rows["vn"])
    if given.size and given.shape[1] != 3:
        raise ValueError(f"{path}: a normal (vn) has {given.shape[1]} numbers; expected 3")
    counts, corners, named = _obj_faces(path, faces)
    normals = None
    if (
        len(given)
        and len(named)
        and np.all((named >= 0) & (named < len(given)) & (corners >= 0) & (corners < len(vertices)))
    ):
        normals = np.zeros_like(vertices)
        np.add.at(normals, corners, given[named])
    elif len(given) == len(vertices):
        normals = given
    return Geometry(vertices, triangulate(vertices, counts, corners), normals, colors)


def _obj_lines(path: Path) -> Iterator[str]:
    """Lines with content, without comments; one that ends with a backslash goes on in the next."""
    held = ""
    for raw in text_lines(path):
        line = held + raw.partition("#")[0].rstrip()
        held = line[:-1] + " " if line.endswith("\\") else ""
        if not held and line.strip():
            yield line
    if held.strip():
        yield held


def _obj_faces(path: Path, faces: list[tuple[str, int, int]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners a face, vertex of each corner, normal of each corner, counted from 0; -1: none.

    A negative number counts back from the last that was read before the face.
    """
    counts, corners, named = [], [], []
    for line, vertices, normals in faces:
        words = line.split()
        counts.append(len(words))
        try:
            for word in words:
                parts = word.split("/")
                corner, normal = int(parts[0]), int(parts[2]) if len(parts) > 2 and parts[2] else 0
                if not -vertices <= corner or not corner:
                    raise ValueError
                corners.append(corner - 1 if corner > 0 else vertices + corner)
                named.append(normal - 1 if normal > 0 else normals + normal if normal else -1)
        except ValueError:
            raise ValueError(
                f"{path}: 'f {line[:40]}' is no face; expected corners such as 1/1/1 or 1, or -1 for the last vertex "
                f"of the {vertices} before it"
            ) from None
    return indices(path, counts), indices(path, corners), indices(path, named)


def read_off(path: Path) -> Geometry:
    """Object file format, with normals (NOFF) and colors (COFF) of the vertices."""
    lines = [line for line in (raw.partition("#")[0].strip() for raw in text_lines(path)) if line]
    words = lines[0].split() if lines else []
    head, found, rest = (words[0] if words else "").partition("OFF")
    if not found or head.strip("STCN"):
        raise ValueError(
            f"{path}: expected 'OFF' in the first line, found '{' '.join(words)[:30]}'; is it another format?"
        )
    sizes = [rest, *words[1:]] if rest else words[1:]
    body = 1
    if not sizes and len(lines) > 1:
        sizes, body = lines[1].split(), 2
    if len(sizes) < 2 or not all(size.isdecimal() and len(size) < 16 for size in sizes[:2]):
        raise ValueError(f"{path}: expected the numbers of vertices and faces, found '{' '.join(sizes)[:30]}'")
    vertex_count, face_count = int(sizes[0]), int(sizes[1])
    if (more := len(lines) - body - vertex_count - face_count) > 0:
        raise ValueError(
            f"{path}: goes on after the last face, with {more} lines more than the header promises; correct its counts "
            f"({vertex_count} vertices, {face_count} faces), or save it again"
        )
    if len(lines) - body < vertex_count + face_count:
        raise ValueError(
            f"{path}: the header promises {vertex_count} vertices and {face_count} faces, the file holds "
            f"{len(lines) - body} lines more; it is cut off, copy it again"
        )
    rows = lines[body : body + vertex_count]
    values = table(path, lambda: rows)
    width = 6 if "N" in head else 3
    if vertex_count and values.shape[1] < width:
        raise ValueError(f"{path}: a vertex has {values.shape[1]} numbers; expected {width}")
    values = values if vertex_count else np.empty((0, width))
    colors = as_colors(values[:, width : width + 3]) if values.shape[1] >= width + 3 else None
    counts, corners = [], []
    for line in lines[body + vertex_count : body + vertex_count + face_count]:
        try:
            count, *polygon = line.split()
            counts.append(int(count))
            corners += [int(corner) for corner in polygon[: int(count)]]
            if len(polygon) < counts[-1] or counts[-1] < 0:
                raise ValueError
        except ValueError:
            raise ValueError(f"{path}: '{line[:40]}' is no face; expected a count and as many corners") from None
    faces = triangulate(values[:, :3], indices(path, counts), indices(path, corners))
    return Geometry(values[:, :3], faces, values[:, 3:6] if "N" in head else None, colors)


def read_stl(path: Path) -> Geometry:
    """STL, text or binary; corners at one place become one vertex."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + 50 * count:
        triangles = np.frombuffer(data, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("tag", "<u2")], count, 84)
        corners = triangles["corners"].reshape(-1, 3).astype(np.float64)
        if (shift := read_shift(data[:80].decode("ascii", "replace"))) is not None:
            corners += shift
    elif data.lstrip().startswith(b"solid") and b"\0" not in data:
        rows = [line.split("vertex", 1)[1] for line in text_lines(path) if line.lstrip().startswith("vertex")]
        corners = table(path, lambda: rows)
        if len(corners) % 3 or (corners.size and corners.shape[1] != 3):
            raise ValueError(
                f"{path}: expected three corners of three numbers a triangle; the file is cut off or damaged"
            )
        corners = corners.reshape(-1, 3)
    else:
        raise ValueError(
            f"{path}: expected stl, {84 + 50 * count} bytes for the {count} triangles promised, found {len(data)}; "
            "it is cut off or another format"
        )
    vertices, index = np.unique(corners, axis=0, return_inverse=True)  # stl repeats each vertex in each triangle
    return Geometry(vertices, index.reshape(-1, 3).astype(np.int64))


def read_gltf_mesh(path: Path) -> Geometry:
    """The meshes of a glTF file as one."""
    return Geometry(*read_gltf(path))


def read_vtk_mesh(path: Path) -> Geometry:
    """The polygons of a vtk or vtp file."""
    vertices, counts, corners, columns = read_vtk(path)
    colors = columns.get("colors", columns.get("RGB"))
    good = colors is not None and colors.ndim == 2 and colors.shape[1] in (3, 4)
    normals = next((v for name, v in columns.items() if name.lower() == "normals" and v.shape == vertices.shape), None)
    faces = triangulate(vertices, counts, corners)
    return Geometry(vertices, faces, normals, as_colors(colors)[:, :3] if colors is not None and good else None)


def write_obj(path: Path, geometry: Geometry) -> None:
    """Wavefront: v, vn where there are normals, f."""
    vertices, faces, normals, colors = geometry
    rows = vertices if colors is None else np.hstack([vertices, np.asarray(colors) / 255])
    with path.open("w", encoding="ascii") as handle:
        np.savetxt(handle, rows, "v" + " %.15g" * 3 + " %.6g" * (rows.shape[1] - 3))
        if normals is not None:
            np.savetxt(handle, normals, "vn %.9g %.9g %.9g")
        corners = np.repeat(faces + 1, 1 if normals is None else 2, axis=1)
        np.savetxt(handle, corners, "f %d %d %d" if normals is None else "f %d//%d %d//%d %d//%d")


def write_off(path: Path, geometry: Geometry) -> None:
    """OFF, with normals as NOFF."""
    vertices, faces, normals, colors = geometry
    rows, form = [vertices], "%.15g %.15g %.15g"
    if normals is not None:
        rows, form = [*rows, np.asarray(normals)], form + " %.9g %.9g %.9g"
    if colors is not None:
        rows, form = [*rows, np.asarray(colors)], form + " %d %d %d"
    with path.open("w", encoding="ascii") as handle:
        handle.write(f"{'C' * (colors is not None)}{'N' * (normals is not None)}OFF\n{len(vertices)} {len(faces)} 0\n")
        np.savetxt(handle, np.hstack(rows), form)
        np.savetxt(handle, faces, "3 %d %d %d")


def _write_stl(path: Path, vertices: np.ndarray, faces: np.ndarray) -> tuple[str, ...]:
    single = shifted(vertices)
    triangles = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("tag", "<u2")])
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    triangles["corners"] = single.points[faces]
    with path.open("wb") as handle:
        handle.write(f"binary stl {single.text}".encode().ljust(80)[:80] + len(faces).to_bytes(4, "little"))
        triangles.tofile(handle)
    return single.notes


READERS: dict[str, Callable[[Path], Geometry]] = {
    ".ply": _read_ply,
    ".obj": read_obj,
    ".off": read_off,
    ".stl": read_stl,
    ".glb": read_gltf_mesh,
    ".gltf": read_gltf_mesh,
    ".vtk": read_vtk_mesh,
    ".vtp": read_vtk_mesh,
}
MESH_SUFFIXES = frozenset(READERS)
MESH_OUTPUTS = frozenset({".ply", ".obj", ".off", ".stl"})
