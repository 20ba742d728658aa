"""A mesh where a cloud is expected: its vertices, said; or points on its faces."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from pnu.commands.upsample import _sampled, main
from pnu.io import CLOUD_SUFFIXES, OUTPUT_SUFFIXES, Mesh, check_output, read_cloud, read_mesh, write_mesh
from tests.io.test_io import CUBE, volume
from tests.refusals import refused

Array = np.ndarray


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl"])
def test_ignored_faces_are_said(tmp_path: Path, suffix: str) -> None:
    write_mesh(tmp_path / f"m{suffix}", CUBE)
    read = read_cloud(tmp_path / f"m{suffix}", minimum=8)
    (note,) = read.notes
    assert "12 faces are ignored" in note
    assert "sample=5000" in note
    assert sorted(map(tuple, read.points)) == sorted(map(tuple, CUBE.vertices))


def trimesh_scene(path: Path) -> Array:
    """Two boxes and points, each moved, one of them mirrored; the vertices as they are placed."""
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    moved, mirror = np.eye(4), np.diag([-1.0, 1, 1, 1])
    moved[:3, 3] = 5, 0, 0
    box = trimesh.creation.box()
    scene.add_geometry(box, transform=moved)
    scene.add_geometry(box.copy(), transform=mirror)
    scene.export(path)
    return np.concatenate([box.vertices + [5, 0, 0], box.vertices * [-1, 1, 1]])


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_gltf(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m{suffix}"
    if suffix == ".glb":
        placed = trimesh_scene(path)
    else:
        data = CUBE.vertices.astype("<f4").tobytes() + CUBE.faces.astype("<u2").tobytes()
        (tmp_path / "m.bin").write_bytes(data)
        path.write_text(json.dumps(gltf(len(data), "m.bin")))
        placed = CUBE.vertices
    mesh = read_mesh(path)
    assert {tuple(v) for v in mesh.vertices.round(5)} == {tuple(v) for v in placed.round(5)}
    assert volume(mesh) == pytest.approx(2 if suffix == ".glb" else 1)
    assert "faces are ignored" in read_cloud(path, minimum=8).notes[0]


def gltf(length: int, uri: str | None, count: int = 8) -> dict:
    buffer = {"byteLength": length} | ({"uri": uri} if uri else {})
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 96}, {"buffer": 0, "byteOffset": 96, "byteLength": 72}],
        "buffers": [buffer],
    }


def ball(mode: int, normals: Array | None, matrix: Array) -> tuple[dict, bytes]:
    """A tree and its buffer: 60 points of a ball, or 20 triangles of them, with normals, as a node places them."""
    points = np.random.default_rng(0).normal(size=(60, 3))
    points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype("<f4")
    data, attributes, count = points.tobytes(), {"POSITION": 0}, 1
    if normals is not None:
        data, attributes, count = data + normals.astype("<f4").tobytes(), attributes | {"NORMAL": 1}, 2
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0}, {"mesh": 0, "matrix": matrix.T.ravel().tolist()}],
        "meshes": [{"primitives": [{"attributes": attributes, "mode": mode}]}],
        "accessors": [
            {"bufferView": i, "componentType": 5126, "count": 720 // 12, "type": "VEC3"} for i in range(count)
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": 720 * i, "byteLength": 720} for i in range(count)],
        "buffers": [{"byteLength": len(data)}],
    }
    return tree, data


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("mode", [0, 4])  # points, triangles
def test_gltf_normals(tmp_path: Path, suffix: str, mode: int) -> None:
    """Of a ball as it is, and of one that a node makes an ellipsoid, mirrored and moved."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.diag([-1.0, 2, 3]), (9, 0, 0)
    for given in (True, False):
        points = np.frombuffer(ball(mode, None, matrix)[1], "<f4").reshape(60, 3)
        tree, data = ball(mode, points if given else None, matrix)
        path = tmp_path / f"{given}{suffix}"
        if suffix == ".glb":
            text = json.dumps(tree).encode().ljust(4000)
            head = b"glTF" + struct.pack("<IIII", 2, 28 + len(text) + len(data), len(text), 0x4E4F534A)
            path.write_bytes(head + text + struct.pack("<II", len(data), 0x004E4942) + data)
        else:
            (tmp_path / f"{given}.bin").write_bytes(data)
            tree["buffers"][0]["uri"] = f"{given}.bin"
            path.write_text(json.dumps(tree))
        cloud = read_cloud(path)
        assert len(cloud.points) == 120
        if not given:
            assert cloud.normals is None
            continue
        assert cloud.normals is not None
        size = np.where(cloud.points[:, :1] > 4, [-1.0, 2, 3], 1)
        inner = (cloud.points - [9, 0, 0] * (cloud.points[:, :1] > 4)) / size
        expected = inner / size
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(cloud.normals, expected, atol=1e-5)
        if mode == 4:
            assert len(read_mesh(path).faces) == 40


def test_gltf_normals_that_do_not_fit(tmp_path: Path) -> None:
    tree, data = ball(0, np.ones((60, 3)), np.eye(4))
    tree["accessors"][1]["count"] = 59
    (tmp_path / "m.bin").write_bytes(data)
    tree["buffers"][0]["uri"] = "m.bin"
    (tmp_path / "m.gltf").write_text(json.dumps(tree))
    with pytest.raises(ValueError, match=r"m\.gltf: .*its normals are not as many as its points"):
        read_cloud(tmp_path / "m.gltf")


def test_normals_of_a_gltf_that_only_some_parts_have_are_left_out(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.icosphere(2)
    path = tmp_path / "m.glb"
    path.write_bytes(box.scene().export(file_type="glb", include_normals=True))
    cloud = read_cloud(path)
    assert cloud.normals is not None
    np.testing.assert_allclose((cloud.normals * cloud.points).sum(1), 1, atol=1e-2)
    points = trimesh.PointCloud(np.random.default_rng(0).random((50, 3)) + 5)
    path.write_bytes(trimesh.Scene([box, points]).export(file_type="glb", include_normals=True))
    assert read_cloud(path).normals is None


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"glTF", "does not begin with a header of glb"),
        (b"glTF" + struct.pack("<III", 2, 20, 2**31) + b"JSON", "does not begin with a header of glb"),
        (b"{}", "does not begin with a header of glb"),
        (gltf(168, None, 10**9), "an accessor counts 1000000000 items, more than there is room for"),
        (gltf(168, None, 300), "is no glTF that can be read"),
    ],
)
def test_forged_glb(tmp_path: Path, content: bytes | dict, found: str) -> None:
    if isinstance(content, dict):
        text = json.dumps(content).encode().ljust(1000)
        content = b"glTF" + struct.pack("<IIII", 2, 12 + 8 + 1000 + 8 + 168, 1000, 0x4E4F534A) + text
        content += struct.pack("<II", 168, 0x004E4942) + bytes(168)
    (tmp_path / "m.glb").write_bytes(content)
    with pytest.raises(ValueError, match=rf"m\.glb: .*{found}") as error:
        read_mesh(tmp_path / "m.glb")
    assert "\n" not in str(error.value)


def test_formats_that_hold_no_cloud_are_no_output(tmp_path: Path) -> None:
    for suffix in sorted(CLOUD_SUFFIXES - OUTPUT_SUFFIXES):
        with pytest.raises(ValueError, match=rf"the suffix '\{suffix}' is not a format of a point cloud to write; use"):
            check_output(tmp_path / f"c{suffix}")


def test_points_on_the_faces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, output = tmp_path / "cube.stl", tmp_path / "o.ply"
    write_mesh(path, Mesh(2 * CUBE.vertices + 7, CUBE.faces))
    main([f"input={path}", f"output={output}", "sample=100", "ratio=2"])
    assert "a mesh: the points are on its 12 faces, not its 8 vertices" in capsys.readouterr().out
    dense = read_cloud(output)
    assert len(dense.points) == 200
    assert np.abs(np.abs(dense.points - 8).max(1) - 1).max() < 0.3  # near the cube's surface
    cloud = _sampled(str(path), 100, True, 0)
    assert np.abs(np.abs(cloud.points - 8).max(1) - 1).max() < 1e-6
    assert ((cloud.points - 8) * cloud.normals).sum(1).min() > 0.9
    for text, sample, name in (("sample=3: expected at least 16", 3, path), ("is no mesh", 50, tmp_path / "c.xyz")):
        line = refused(capsys, main, [f"input={name}", f"output={output}", f"sample={sample}"])
        assert text in line
