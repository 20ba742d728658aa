"""Every format that is written, with every kind of cloud: what is read again is what was written, or what was said."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from pnu.io import Mesh, kept_attributes, read_cloud, read_mesh, write_cloud, write_mesh
from pnu.io.output import WRITERS

Array = np.ndarray
COUNT = 40
OFFSETS = {"near": 0.0, "utm": np.array([447_321.25, 5_411_933.5, 312.75])}
EXACT = {".xyz", ".txt", ".obj", ".off", ".npy"}  # 15 digits, or all


def scene(scale: float = 3.0) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return scale * normals, normals, rng.integers(0, 256, (COUNT, 3), dtype=np.uint8)


@pytest.mark.parametrize("suffix", sorted(WRITERS))
@pytest.mark.parametrize("place", OFFSETS)
def test_every_format_and_kind_of_cloud(tmp_path: Path, suffix: str, place: str) -> None:
    points, normals, colors = scene()
    points = points + OFFSETS[place]
    scalars = {
        "intensity": np.linspace(0, 1, COUNT, dtype=np.float32),
        "gps_time": np.linspace(0, 1, COUNT) + 3e8,
        "label": np.arange(COUNT, dtype=np.int16) - 9,
    }
    for with_normals, with_colors, with_scalars in product((False, True), repeat=3):
        given = ({"colors": colors} if with_colors else {}) | (scalars if with_scalars else {})
        path = tmp_path / f"cloud{suffix}"
        notes = write_cloud(path, points, normals if with_normals else None, given)
        read = read_cloud(path)
        extent = np.ptp(points, axis=0).max()
        far = np.abs(read.points - points).max()
        assert far <= (1e-13 * np.abs(points).max() if suffix in EXACT else 1e-6 * extent)
        assert (read.normals is not None) == with_normals
        if with_normals:
            np.testing.assert_allclose(read.normals, normals, atol=1e-7)
        kept = kept_attributes(path, given)
        assert read.attributes.keys() == set(kept)
        for name in kept:
            np.testing.assert_array_equal(read.attributes[name], given[name])
        left = [name for name in given if name not in kept]
        assert all(any(name in note for note in notes) for name in left)
        assert len(notes) == bool(left) + (suffix == ".pcd" and place == "utm")


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".obj", ".off"])
@pytest.mark.parametrize("with_normals", [False, True])
def test_text_keeps_colors(tmp_path: Path, suffix: str, with_normals: bool) -> None:
    points, normals, colors = scene()
    path = tmp_path / f"c{suffix}"
    write_cloud(path, points, normals if with_normals else None, {"colors": np.c_[colors, colors[:, :1]]})
    np.testing.assert_array_equal(read_cloud(path).attributes["colors"], colors)


NAMES = [
    "x",
    "NX",
    "nx",
    "ny",
    "normal_x",
    "red",
    "rgb",
    "_",
    "Intensity",
    "intensity",
    "a b",
    "a_b",
    "a",
    "höhe",
    "hähe",
]
NAMES += [
    "normals",
    "far too long a name for the thirty-two bytes of las, one",
    "X",
    "far too long a name for the thirty",
]


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".las", ".laz"])
def test_a_name_that_collides_overwrites_nothing(tmp_path: Path, suffix: str) -> None:
    """Names of the columns that a format writes itself, or that become equal: all values are there under some name."""
    points, normals, colors = scene()
    given = {name: np.full(COUNT, 200 + i, np.int16) for i, name in enumerate(NAMES)}
    path = tmp_path / f"c{suffix}"
    notes = write_cloud(path, points, normals, given | {"colors": colors})
    read = read_cloud(path)
    np.testing.assert_allclose(read.points, points, atol=1e-6)
    np.testing.assert_allclose(read.normals, normals, atol=1e-7)
    np.testing.assert_array_equal(read.attributes.pop("colors"), colors)
    assert sorted(int(values[0]) for values in read.attributes.values()) == list(range(200, 200 + len(NAMES)))
    assert read.attributes["scalar_NX"][0] == 201
    assert any("'nx' is written as 'scalar" in note for note in notes)


@pytest.mark.parametrize("suffix", [".ply", ".las"])
def test_attributes_that_look_like_normals(tmp_path: Path, suffix: str) -> None:
    points, _, _ = scene()
    columns = {name: np.arange(COUNT, dtype=np.float32) for name in ("nx", "ny", "nz", "r", "g", "b")}
    write_cloud(tmp_path / f"c{suffix}", points, None, columns)
    read = read_cloud(tmp_path / f"c{suffix}")
    assert read.normals is None
    assert "colors" not in read.attributes
    assert len(read.attributes) == 6


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".off"])
@pytest.mark.parametrize("place", OFFSETS)
def test_meshes_far_from_the_origin(tmp_path: Path, suffix: str, place: str) -> None:
    points, _, _ = scene()
    mesh = Mesh(
        points + OFFSETS[place], np.random.default_rng(1).permuted(np.tile(np.arange(COUNT), (9, 1)), axis=1)[:, :3]
    )
    notes = write_mesh(tmp_path / f"m{suffix}", mesh)
    read = read_mesh(tmp_path / f"m{suffix}")
    assert np.abs(read.vertices[read.faces] - mesh.vertices[mesh.faces]).max() <= 1e-6 * np.ptp(points)
    assert len(notes) == (suffix == ".stl" and place == "utm")


def test_other_programs_read_shifted_coordinates(tmp_path: Path) -> None:
    """Open3D knows single precision in pcd alone: the shape is there, and the shift is in the header."""
    open3d = pytest.importorskip("open3d")
    points = scene()[0] + OFFSETS["utm"]
    (note,) = write_cloud(tmp_path / "c.pcd", points)
    text = "shift 447321 5411934 313"
    assert text in note
    assert text.encode() in (tmp_path / "c.pcd").read_bytes()
    read = np.asarray(open3d.io.read_point_cloud(str(tmp_path / "c.pcd")).points)
    np.testing.assert_allclose(read + [447321, 5411934, 313], points, atol=1e-6)
