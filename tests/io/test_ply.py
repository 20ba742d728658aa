"""Foreign ply: headers of real exporters, counts that do not fit, names, precision."""

import struct
from pathlib import Path

import numpy as np
import pytest

from pnu.io import Mesh, read_cloud, read_mesh, write_cloud, write_mesh

Array = np.ndarray
AXES = "property float x\nproperty float y\nproperty float z\n"
FACES = "property list uchar int vertex_indices\n"
POINTS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
TRIANGLES = np.random.default_rng(1).permuted(np.tile(np.arange(40), (30, 1)), axis=1)[:, :3]
POLYGONS = b"".join(struct.pack(f"<B{3 + i % 3}i", 3 + i % 3, *range(3 + i % 3)) for i in range(30))


def ply(form: str, properties: str, body: bytes, *, vertices: int = 40, more: str = "") -> bytes:
    return f"ply\nformat {form} 1.0\nelement vertex {vertices}\n{properties}{more}end_header\n".encode() + body


def text(values: Array) -> bytes:
    return "".join(" ".join(map(repr, row)) + "\n" for row in values.tolist()).encode()


def faces(form: str) -> bytes:
    if form == "ascii":
        return text(np.c_[np.full(30, 3), TRIANGLES])
    return b"".join(struct.pack("<B3i", 3, *corners) for corners in TRIANGLES.tolist())


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("with_faces", [False, True])
def test_a_file_that_goes_on_is_refused(tmp_path: Path, form: str, with_faces: bool) -> None:
    """Fewer elements in the header than in the body: of the points, of the faces; the right line is said."""
    body = text(POINTS) if form == "ascii" else POINTS.tobytes()
    path = tmp_path / "c.ply"
    more = f"element face 30\n{FACES}" if with_faces else ""
    body += faces(form) if with_faces else b""
    path.write_bytes(ply(form, AXES, body, more=more))
    np.testing.assert_array_equal(read_cloud(path).points, POINTS)
    path.write_bytes(ply(form, AXES, body + b"\n\n", more=more))  # nothing is lost
    np.testing.assert_array_equal(read_cloud(path).points, POINTS)
    if with_faces:
        np.testing.assert_array_equal(read_mesh(path).faces, TRIANGLES)
        path.write_bytes(ply(form, AXES, body, more=more.replace("30", "29")))
        with pytest.raises(ValueError, match=r"c\.ply: goes on after the last element, with .* save it again"):
            read_mesh(path)
    else:
        path.write_bytes(ply(form, AXES, body, vertices=16))
        cure = "write 'element vertex 40' for 'element vertex 16' in its header"
        unit = "24 lines" if form == "ascii" else "288 bytes"
        found = rf"c\.ply: goes on after the last element, with {unit} more than .*; if all belong to it, {cure}"
        with pytest.raises(ValueError, match=found):
            read_cloud(path)


def test_elements_behind_the_points_are_passed(tmp_path: Path) -> None:
    """Polygons of different lengths, which have no common size, and what is cut off inside them."""
    path = tmp_path / "c.ply"
    more = f"element face 30\n{FACES}element material 2\nproperty float shine\n"
    body = POINTS.tobytes() + POLYGONS + struct.pack("<2f", 1, 2)
    path.write_bytes(ply("binary_little_endian", AXES, body, more=more))
    np.testing.assert_array_equal(read_cloud(path).points, POINTS)
    assert len(read_mesh(path).faces) == sum(1 + i % 3 for i in range(30))
    path.write_bytes(ply("binary_little_endian", AXES, body + b"\1" * 4, more=more))
    with pytest.raises(ValueError, match="write 'element material 3' for 'element material 2'"):
        read_cloud(path)
    path.write_bytes(ply("binary_little_endian", AXES, body[:-40], more=more))
    with pytest.raises(ValueError, match="promises 30 of element 'face', the file holds 2[0-9]; it is cut off"):
        read_cloud(path)


def test_lines_of_exporters_and_bool(tmp_path: Path) -> None:
    path = tmp_path / "c.ply"
    content = ply("ascii", AXES + "property bool seen\n", text(np.c_[POINTS, np.arange(40) % 2]))
    path.write_bytes(content.replace(b"element vertex", b"Created by an exporter: of a list\nelement vertex"))
    read = read_cloud(path)
    np.testing.assert_allclose(read.points, POINTS)
    np.testing.assert_array_equal(read.attributes["seen"], np.arange(40) % 2)


def test_names_of_a_mesh(tmp_path: Path) -> None:
    """X Y Z, and corners in capitals."""
    path = tmp_path / "m.ply"
    more = "element face 30\nproperty list uchar int Vertex_Indices\n"
    axes = AXES.replace("float x", "float X").replace("float y", "float Y").replace("float z", "float Z")
    path.write_bytes(ply("ascii", axes, text(POINTS) + faces("ascii"), more=more))
    mesh = read_mesh(path)
    np.testing.assert_allclose(mesh.vertices, POINTS)
    np.testing.assert_array_equal(mesh.faces, TRIANGLES)


@pytest.mark.parametrize("kind", ["ushort", "uchar", "float", "int"])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_colors_of_any_type(tmp_path: Path, kind: str, form: str) -> None:
    colors = np.random.default_rng(2).integers(0, 256, (40, 3))
    scale, code = {"ushort": (257, "<u2"), "uchar": (1, "u1"), "float": (1 / 255, "<f4"), "int": (1, "<i4")}[kind]
    names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    stored = (colors * scale).astype(code)
    body = text(np.c_[POINTS.astype(float), stored])
    if form != "ascii":
        rows = np.empty(40, [("p", "<f4", 3), ("c", code, 3)])
        rows["p"], rows["c"] = POINTS, stored
        body = rows.tobytes()
    (tmp_path / "c.ply").write_bytes(ply(form, AXES + names, body))
    read = read_cloud(tmp_path / "c.ply").attributes["colors"]
    np.testing.assert_array_equal(read, colors)
    assert read.dtype == np.uint8


@pytest.mark.parametrize(("offset", "kind"), [(0, b"float"), (3, b"float"), (1e3, b"double"), (5e6, b"double")])
def test_single_precision_where_it_is_good_to_a_millionth(tmp_path: Path, offset: float, kind: bytes) -> None:
    points = np.random.default_rng(3).uniform(size=(40, 3)) + offset
    write_cloud(tmp_path / "c.ply", points)
    write_mesh(tmp_path / "m.ply", Mesh(points, TRIANGLES))
    extent = np.ptp(points, axis=0).max()
    for path in tmp_path.iterdir():
        assert b"property " + kind + b" x" in path.read_bytes()[:200]
        assert np.abs(read_cloud(path).points - points).max() <= 1e-6 * extent
