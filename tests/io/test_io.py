"""Formats: what is written is read again, foreign variants are understood, bad files are refused in one line."""

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from pnu.io import (
    MESH_OUTPUTS,
    OUTPUT_SUFFIXES,
    Mesh,
    atomic_path,
    meshes_of,
    read_cloud,
    read_json,
    read_mesh,
    remove_leftovers,
    write_cloud,
    write_json,
    write_mesh,
)

Array = np.ndarray
CUBE = Mesh(
    np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float),
    np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
              [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]),
)  # fmt: skip


@pytest.fixture
def cloud() -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(40, 3))
    return rng.normal(size=(40, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


# Clouds


@pytest.mark.parametrize("suffix", sorted(OUTPUT_SUFFIXES))
@pytest.mark.parametrize("with_normals", [True, False])
def test_cloud_round_trip(tmp_path: Path, cloud: tuple[Array, Array], suffix: str, with_normals: bool) -> None:
    points, normals = cloud
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, points, normals if with_normals else None)
    read = read_cloud(path)
    np.testing.assert_allclose(
        read.points, points, rtol=1e-14, atol=1e-6 if suffix in (".ply", ".pcd", ".las", ".laz") else 0
    )
    assert (read.normals is not None) == with_normals
    if with_normals:
        np.testing.assert_allclose(read.normals, normals, atol=1e-7)
        np.testing.assert_allclose(np.linalg.norm(read.normals, axis=1), 1, atol=1e-15)
    assert read.points.dtype == np.float64
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", sorted(OUTPUT_SUFFIXES))
def test_map_coordinates_keep_their_millimetres(tmp_path: Path, cloud: tuple[Array, Array], suffix: str) -> None:
    points = np.round(cloud[0] + [4.1e6, 5.3e6, 120], 4)
    write_cloud(tmp_path / f"c{suffix}", points)
    assert np.abs(read_cloud(tmp_path / f"c{suffix}").points - points).max() < (1e-6 if suffix == ".pcd" else 1e-8)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_lidar_files_in_slices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    """Colors, lidar's own scalars and others; laspy reads the same; a missing laspy is named with its cure."""
    import laspy

    monkeypatch.setattr("pnu.io.las.SLICE", 7)
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 3)) + [5e5, 5e6, 100]
    attributes = {
        "colors": rng.integers(0, 256, (40, 3), dtype=np.uint8),
        "intensity": rng.random(40).astype(np.float32),  # no whole numbers, as las wants them
        "classification": rng.integers(0, 9, 40, dtype=np.uint8),
        "label": rng.integers(-5, 5, 40, dtype=np.int16),
    }
    path = tmp_path / f"c{suffix}"
    write_cloud(path, points, points - points.mean(0), attributes)
    read = read_cloud(path)
    assert np.abs(read.points - points).max() < 1e-8
    assert read.normals is not None
    assert read.attributes.keys() == attributes.keys()
    for name, values in attributes.items():
        np.testing.assert_array_equal(read.attributes[name], values)
    foreign = laspy.read(path)
    np.testing.assert_allclose(foreign.xyz, points, atol=1e-8)
    np.testing.assert_array_equal(foreign.classification, attributes["classification"])
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ValueError, match=r'laspy, which is not installed: pip install "pnu\[las\]"'):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("channels", [3, 4])
def test_colors_and_scalars_are_kept(tmp_path: Path, cloud: tuple[Array, Array], suffix: str, channels: int) -> None:
    rng = np.random.default_rng(1)
    attributes = {
        "colors": rng.integers(0, 256, (40, channels), dtype=np.uint8),
        "intensity": rng.random(40).astype(np.float32),
        "time": rng.random(40) + 1e9,
        "label": rng.integers(-5, 5, 40, dtype=np.int16),
    }
    write_cloud(tmp_path / f"c{suffix}", *cloud, attributes)
    read = read_cloud(tmp_path / f"c{suffix}")
    assert read.attributes.keys() == attributes.keys()
    for name, values in attributes.items():
        np.testing.assert_array_equal(read.attributes[name], values)
        assert read.attributes[name].dtype == values.dtype
    np.testing.assert_allclose(read.normals, cloud[1], atol=1e-7)


def test_other_programs_read_our_files(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_cloud(tmp_path / "c.ply", *cloud, {"colors": np.full((40, 3), 7, np.uint8)})
    read = trimesh.load(tmp_path / "c.ply")
    np.testing.assert_allclose(read.vertices, cloud[0], atol=1e-6)
    assert read.colors[0].tolist() == [7, 7, 7, 255]
    for suffix in sorted(MESH_OUTPUTS):
        write_mesh(tmp_path / f"m{suffix}", CUBE)
        assert trimesh.load(tmp_path / f"m{suffix}").volume == pytest.approx(1)
        trimesh.load(tmp_path / f"m{suffix}").export(tmp_path / f"t{suffix}")
        assert volume(read_mesh(tmp_path / f"t{suffix}")) == pytest.approx(1)


def test_text_separators_and_comments(tmp_path: Path) -> None:
    points = np.arange(60.0).reshape(20, 3) / 7
    lines = [
        separator.join(map(repr, row))
        for row, separator in zip(points.tolist(), [" ", ", ", "\t", ";"] * 5, strict=True)
    ]
    path = tmp_path / "c.txt"
    path.write_text("# a scan\n//X Y Z\n\n" + "\r\n".join(lines) + " # the last\n\n")
    np.testing.assert_array_equal(read_cloud(path).points, points)


def test_six_columns_of_text_are_normals_or_colors(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    points, normals = cloud
    path = tmp_path / "c.xyz"
    np.savetxt(path, np.hstack([points, normals]), "%.4f")
    assert np.abs(read_cloud(path).normals - normals).max() < 1e-3
    assert read_cloud(path, normals=False).normals is None
    colors = np.random.default_rng(2).integers(0, 256, (40, 3))
    np.savetxt(path, np.hstack([points, colors]))
    read = read_cloud(path)
    assert read.normals is None
    np.testing.assert_array_equal(read.attributes["colors"], colors)
    np.savetxt(path, np.hstack([points, colors / 255]))
    np.testing.assert_array_equal(read_cloud(path).attributes["colors"], colors)
    np.savetxt(path, np.hstack([points, 5 * normals]))
    np.testing.assert_allclose(read_cloud(path).normals, normals)


def test_normals_of_any_length_become_unit(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    points, normals = cloud
    for factor in (1e-200, 3.0, 1e200):
        path = tmp_path / "c.obj"
        rows = [
            f"v {p[0]} {p[1]} {p[2]}\nvn {n[0]} {n[1]} {n[2]}" for p, n in zip(points, normals * factor, strict=True)
        ]
        path.write_text("\n".join(rows))
        np.testing.assert_allclose(read_cloud(path).normals, normals, atol=1e-12)


PLY_ROWS = [(i / 4, i % 3, -i, 10 * i % 256, i) for i in range(20)]
PLY_HEADER = """ply
format {} 1.0
comment elements before the vertices are skipped, lists among their properties too
element camera 2
property list uchar int rows
property double focal
element vertex 20
property float x
property list uchar short rings
property double y
property float64 z
property uchar red
property ushort label
element face 0
property list uchar int vertex_indices
end_header
"""


def ply_text() -> bytes:
    body = "2 5 6 0.5\n0 0.25\n" + "\n".join(f"{x} {i % 3}{' 9' * (i % 3)} {y} {z} {red} {label}"
                                             for i, (x, y, z, red, label) in enumerate(PLY_ROWS))  # fmt: skip
    return (PLY_HEADER.format("ascii") + body + "\n").encode()


def ply_binary(order: str) -> bytes:
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    body = struct.pack(order + "Biid", 2, 5, 6, 0.5) + struct.pack(order + "Bd", 0, 0.25)
    for i, row in enumerate(PLY_ROWS):
        x, *rest = row
        body += struct.pack(order + f"fB{i % 3}h", x, i % 3, *[9] * (i % 3)) + struct.pack(order + "ddBH", *rest)
    return PLY_HEADER.format(name).encode() + body


@pytest.mark.parametrize("content", [ply_text(), ply_binary("<"), ply_binary(">")], ids=["ascii", "little", "big"])
def test_ply_variants(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.ply"
    path.write_bytes(content)
    read = read_cloud(path)
    np.testing.assert_array_equal(read.points, [row[:3] for row in PLY_ROWS])
    np.testing.assert_array_equal(read.attributes["red"], [row[3] for row in PLY_ROWS])
    np.testing.assert_array_equal(read.attributes["label"], [row[4] for row in PLY_ROWS])
    assert read.attributes["label"].dtype == np.uint16
    assert read.attributes.keys() == {"red", "label"}


def test_ply_polygons_are_cut_into_triangles(tmp_path: Path) -> None:
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4]]
    faces = [*quads, [1, 5, 7], [1, 7, 3]]
    header = "element vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
    header += "property list uchar int vertex_index\nend_header\n"
    vertices = CUBE.vertices.astype("<f4").tobytes()
    for some in (quads[:2], faces):  # equal and mixed polygons take different ways
        body = b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in some)
        path = tmp_path / "m.ply"
        path.write_bytes(
            b"ply\nformat binary_little_endian 1.0\n" + header.format(len(some)).encode() + vertices + body
        )
        mesh = read_mesh(path)
        assert len(mesh.faces) == sum(len(face) - 2 for face in some)
    assert volume(mesh) == pytest.approx(1)
    text = (
        "ply\nformat ascii 1.0\n" + header.format(len(faces)) + "\n".join(" ".join(map(str, v)) for v in CUBE.vertices)
    )
    path.write_text(text + "\n" + "\n".join(f"{len(face)} {' '.join(map(str, face))}" for face in faces))
    np.testing.assert_array_equal(read_mesh(path).faces, mesh.faces)


def test_ply_numbered_attributes(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    values = np.arange(80, dtype=np.float32).reshape(40, 2)
    write_cloud(tmp_path / "c.ply", cloud[0], attributes={"flow field": values})
    read = read_cloud(tmp_path / "c.ply").attributes
    np.testing.assert_array_equal(np.stack([read["flow_field_0"], read["flow_field_1"]], 1), values)


def compress_lzf(data: bytes) -> bytes:
    """Literals, and references to the nearest earlier occurrence of the next 3 to 264 bytes."""
    out, literals, position = b"", b"", 0

    def flush() -> bytes:
        return b"".join(
            bytes([len(part) - 1]) + part for part in (literals[i : i + 32] for i in range(0, len(literals), 32))
        )

    while position < len(data):
        length = 2
        start = data.rfind(data[position : position + 3], max(0, position - 8192), position + 2)
        if start >= 0 and position + 3 <= len(data):
            length = 3
            while length < 264 and position + length < len(data) and data[start + length] == data[position + length]:
                length += 1
        if length < 3:
            literals += data[position : position + 1]
            position += 1
            continue
        out, literals = out + flush(), b""
        back, short = position - start - 1, length - 2
        head = bytes([(short << 5) | back >> 8]) if short < 7 else bytes([7 << 5 | back >> 8, short - 7])
        out += head + bytes([back & 255])
        position += length
    return out + flush()


def pcd(mode: str, rows: Array) -> bytes:
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb normal_x normal_y normal_z\n"
    header += "SIZE 4 4 4 1 4 4 4 4\nTYPE F F F U F F F F\nCOUNT 1 1 1 3 1 1 1 1\n"
    header += f"WIDTH {len(rows) // 2}\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA {mode}\n"
    if mode == "ascii":
        values = [[*r["p"], *r["pad"], r["rgb"].view(np.float32), *r["n"]] for r in rows]
        return (header + "\n".join(" ".join(f"{v:.9g}" for v in row) for row in values) + "\n").encode()
    if mode == "binary":
        return header.encode() + rows.tobytes()
    names = [("p", 0), ("p", 1), ("p", 2), ("pad", None), ("rgb", None), ("n", 0), ("n", 1), ("n", 2)]
    flat = b"".join(np.ascontiguousarray(rows[n] if i is None else rows[n][:, i]).tobytes() for n, i in names)
    packed = compress_lzf(flat)
    assert len(packed) < 0.9 * len(flat)  # references occur, not literals alone
    return header.encode() + struct.pack("<II", len(packed), len(flat)) + packed


@pytest.mark.parametrize("mode", ["ascii", "binary", "binary_compressed"])
def test_pcd_variants(tmp_path: Path, mode: str, cloud: tuple[Array, Array]) -> None:
    rows = np.zeros(40, [("p", "<f4", 3), ("pad", "u1", 3), ("rgb", "<u4"), ("n", "<f4", 3)])
    rows["p"], rows["n"], rows["rgb"] = cloud[0], cloud[1], 0x102030
    (tmp_path / "c.pcd").write_bytes(pcd(mode, rows))
    read = read_cloud(tmp_path / "c.pcd")
    np.testing.assert_allclose(read.points, rows["p"], rtol=1e-7)
    np.testing.assert_allclose(read.normals, cloud[1], atol=1e-6)
    assert read.attributes.keys() == {"colors"}
    assert (read.attributes["colors"] == [0x10, 0x20, 0x30]).all()


def test_open3d_reads_our_pcd_and_ply(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    try:
        import open3d
    except (ImportError, OSError):
        pytest.skip("open3d is not here")
    colors = np.random.default_rng(3).integers(0, 256, (40, 3), dtype=np.uint8)
    for suffix in (".pcd", ".ply"):
        write_cloud(tmp_path / f"c{suffix}", *cloud, {"colors": colors})
        read = open3d.io.read_point_cloud(str(tmp_path / f"c{suffix}"))
        np.testing.assert_allclose(np.asarray(read.points), cloud[0], atol=1e-6)
        np.testing.assert_allclose(np.asarray(read.normals), cloud[1], atol=1e-7)
        np.testing.assert_allclose(np.asarray(read.colors) * 255, colors, atol=1e-9)
        for compressed, text in ((True, False), (False, True)):
            open3d.io.write_point_cloud(str(tmp_path / f"o{suffix}"), read, write_ascii=text, compressed=compressed)
            again = read_cloud(tmp_path / f"o{suffix}")
            np.testing.assert_allclose(again.points, cloud[0], atol=1e-5)
            np.testing.assert_allclose(again.normals, cloud[1], atol=1e-5)
            np.testing.assert_array_equal(again.attributes["colors"], colors)


# Meshes


@pytest.mark.parametrize("suffix", sorted(MESH_OUTPUTS))
def test_mesh_round_trip(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m{suffix}"
    write_mesh(path, CUBE)
    mesh = read_mesh(path)
    assert volume(mesh) == pytest.approx(1)
    assert mesh.faces.dtype == np.int64
    assert len(mesh.vertices) == 8
    if suffix != ".stl":  # which has no shared vertices to keep in order
        np.testing.assert_array_equal(mesh.faces, CUBE.faces)
        np.testing.assert_array_equal(mesh.vertices, CUBE.vertices)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off"])
def test_mesh_vertices_as_a_cloud(tmp_path: Path, suffix: str) -> None:
    normals = (CUBE.vertices - 0.5) / np.sqrt(0.75)
    colors = CUBE.vertices * 0.6
    path = tmp_path / f"m{suffix}"
    write_mesh(path, CUBE, vertex_normals=normals, colors=colors, quality=np.arange(8))
    read = read_cloud(path, minimum=8)
    np.testing.assert_allclose(read.normals, normals, atol=1e-7)
    np.testing.assert_allclose(read.attributes["colors"], 153 * CUBE.vertices)
    assert suffix != ".ply" or read.attributes["quality"].tolist() == list(range(8))
    np.testing.assert_array_equal(read_mesh(path).faces, CUBE.faces)


def test_obj_corners(tmp_path: Path) -> None:
    """All spellings of a corner, counted from both ends, polygons, and normals by index."""
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in CUBE.vertices)
    normals = "vn -1 0 0\nvn 1 0 0\n"
    faces = (
        "f 1//1 2//1 4//1 3//1\nf -4/1/-1 -2/1/-1 -1/2/-1 -3/3/-1\nf 1 5 6 2\nf 3/1 4/1 8/1 7/1\nf 1 3 7 5\nf 2 6 8 4\n"
    )
    path = tmp_path / "m.obj"
    path.write_text("mtllib x.mtl\n" + vertices + normals + "vt 0 0\ng cube\n" + faces)
    mesh = read_mesh(path)
    assert volume(mesh) == pytest.approx(1)
    assert len(mesh.faces) == 12
    path.write_text(vertices + normals + "\n".join(faces.splitlines()[:2]))
    expected = np.where(CUBE.vertices[:, :1] > 0, [[1, 0, 0]], [[-1, 0, 0]])
    np.testing.assert_array_equal(read_cloud(path, minimum=8).normals, expected)


def test_off_variants(tmp_path: Path) -> None:
    vertices = "\n".join(f"{x} {y} {z}" for x, y, z in CUBE.vertices)
    faces = "\n".join(f"3 {a} {b} {c} 255 0 0" for a, b, c in CUBE.faces)
    for head in ("OFF\n# comment\n8 12 0", "OFF8 12 0", "OFF 8 12 18", "OFF\n\n8 12"):
        (tmp_path / "m.off").write_text(f"{head}\n{vertices}\n\n{faces}\n")
        assert volume(read_mesh(tmp_path / "m.off")) == pytest.approx(1)


def test_stl_text(tmp_path: Path) -> None:
    corners = CUBE.vertices[CUBE.faces].tolist()
    body = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f" vertex {x} {y} {z}\n" for x, y, z in face)
        + "endloop\nendfacet\n"
        for face in corners
    )
    (tmp_path / "m.stl").write_text(f"solid cube\n{body}endsolid cube\n")
    mesh = read_mesh(tmp_path / "m.stl")
    assert (len(mesh.vertices), volume(mesh)) == (8, pytest.approx(1))


# Writing


def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})

    def fail() -> None:
        with atomic_path(path) as temporary:
            assert (temporary.parent, temporary.suffix) == (tmp_path, ".json")
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert read_json(path) == {"a": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_json_of_arrays_and_nan(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": np.float32(0.5), "b": [np.arange(2), float("nan"), None, True], 3: Path("x")})
    assert read_json(tmp_path / "a.json") == {"a": 0.5, "b": [[0, 1], None, None, True], "3": "x"}
    (tmp_path / "b.json").write_text("{")
    with pytest.raises(ValueError, match=r"b.json: is not JSON"):
        read_json(tmp_path / "b.json")
    with pytest.raises(ValueError, match=r"c.json: no such file"):
        read_json(tmp_path / "c.json")


def test_bench_clouds(shared: Path) -> None:
    for path in (shared / "bench" / "clouds").iterdir():
        cloud = read_cloud(path)
        assert cloud.points.shape == cloud.normals.shape == (5000, 3)
    for path in (shared / "bench" / "truth").glob("*.ply"):
        assert volume(read_mesh(path)) > 0


def test_hidden_files_are_no_meshes(tmp_path: Path) -> None:
    """What a killed program left half-written, and what some file managers write beside each file."""
    for name in ("a.ply", "b/c.off", ".a.0123456789ab.ply", "._a.ply", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    assert meshes_of(tmp_path) == {"a": tmp_path / "a.ply", "b_c": tmp_path / "b/c.off"}
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["._a.ply", "a.ply", "b", "notes.txt"]


@pytest.mark.parametrize("with_normals", [False, True])
def test_npy_in_slices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_normals: bool) -> None:
    monkeypatch.setattr("pnu.io.output.SLICE", 7)
    cloud = np.random.default_rng(0).normal(size=(40, 6))
    cloud[:, 3:] /= np.linalg.norm(cloud[:, 3:], axis=1, keepdims=True)
    write_cloud(tmp_path / "a.npy", cloud[:, :3], cloud[:, 3:] if with_normals else None)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), cloud if with_normals else cloud[:, :3])
