"""Files read in slices and written in parts hold what they hold as a whole."""

from pathlib import Path

import numpy as np
import pytest

from pnu.io import check_output, read_cloud, write_cloud
from pnu.io.fields import as_colors
from pnu.io.point_stream import check_streamed, point_slices
from pnu.io.streamed_output import check_partwise, cloud_writer

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(50, 3)) + [1e5, 2e5, 10]
NORMALS = POINTS - POINTS.mean(0)
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
MORE = {
    "colors": RNG.integers(0, 256, (50, 3), np.uint8),
    "intensity": RNG.integers(0, 60000, 50, np.uint16),
    "classification": RNG.integers(1, 9, 50, np.uint8),
    "height above": RNG.normal(size=50).astype(np.float32),
}
SUFFIXES = ("ply", "las", "laz", "npy")


def needed(suffix: str) -> None:
    if suffix in ("las", "laz"):
        pytest.importorskip("laspy")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_slices_are_the_file(tmp_path: Path, suffix: str) -> None:
    needed(suffix)
    path = tmp_path / f"a.{suffix}"
    write_cloud(path, POINTS, NORMALS, MORE)
    whole = read_cloud(path)
    slices = list(point_slices(path, rows=7))
    assert [len(part.points) for part in slices] == [7] * 7 + [1]
    np.testing.assert_array_equal(np.concatenate([part.points for part in slices]), whole.points)
    normals = np.concatenate([part.normals for part in slices if part.normals is not None])
    np.testing.assert_allclose(normals, whole.normals, atol=1e-7)
    assert slices[0].attributes.keys() >= whole.attributes.keys()
    assert suffix == "npy" or len(whole.attributes) == 4
    for name, values in whole.attributes.items():
        found = np.concatenate([part.attributes[name] for part in slices])
        np.testing.assert_array_equal(found >> 8 if found.dtype != values.dtype else found, values, err_msg=name)


def write_copc(path: Path, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of a square of 17 units from the origin on, to a thousandth, by another program's writer.

    A hundred lie in the root of the tree, the others in its four children; the points as they stand in the file.
    """
    copc = pytest.importorskip("copclib")
    file = copc.FileWriter(str(path), copc.CopcConfigWriter(6, copc.Vector3(*[1e-3] * 3)))
    header, info = file.copc_config.las_header, file.copc_config.copc_info
    points = np.rint(points / 1e-3) * 1e-3
    header.min, header.max = copc.Vector3(*points.min(0)), copc.Vector3(*points.max(0))
    info.center_x = info.center_y = info.center_z = info.halfsize = 8.5
    info.spacing = 1
    x, y = (points[:, :2] > 8.5).astype(int).T
    child = np.where(np.arange(len(points)) < 100, 0, 1 + x + 2 * y)
    for number, key in enumerate(((0, 0, 0, 0), (1, 0, 0, 0), (1, 1, 0, 0), (1, 0, 1, 0), (1, 1, 1, 0))):
        node = copc.Points(header)
        for place in points[child == number]:
            point = node.CreatePoint()
            point.x, point.y, point.z = place
            node.AddPoint(point)
        file.AddNode(copc.VoxelKey(*key), node)
    file.Close()
    return points[np.argsort(child, kind="stable")]


def test_slices_of_copc_are_its_points_chunk_by_chunk(tmp_path: Path) -> None:
    needed("laz")
    path = tmp_path / "a.copc.laz"
    points = write_copc(path, np.random.default_rng(0).uniform(0, 17, (300, 3)))
    slices = [part.points for part in point_slices(path, rows=70)]
    assert [len(part) for part in slices] == [70] * 4 + [20]
    np.testing.assert_array_equal(np.concatenate(slices), points)
    np.testing.assert_array_equal(read_cloud(path).points, points)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_parts_are_the_file(tmp_path: Path, suffix: str) -> None:
    needed(suffix)
    more = {} if suffix == "npy" else MORE
    write_cloud(tmp_path / f"whole.{suffix}", POINTS, NORMALS, more)
    with cloud_writer(
        tmp_path / f"parts.{suffix}", 50, POINTS.min(0), POINTS.max(0), {name: v[:2] for name, v in more.items()}
    ) as write:
        for part in (slice(0, 20), slice(20, 20), slice(20, 50)):
            write(POINTS[part], NORMALS[part], {name: values[part] for name, values in more.items()})
    whole, parts = (read_cloud(tmp_path / f"{name}.{suffix}") for name in ("whole", "parts"))
    np.testing.assert_array_equal(parts.points, whole.points)
    np.testing.assert_array_equal(parts.normals, whole.normals)
    assert parts.attributes.keys() == whole.attributes.keys()
    for name, values in whole.attributes.items():
        np.testing.assert_array_equal(parts.attributes[name], values, err_msg=name)


def test_a_file_of_the_wrong_number_does_not_appear(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match="expected 50 points, 49 were written"),
        cloud_writer(tmp_path / "a.ply", 50, POINTS.min(0), POINTS.max(0), {}) as write,
    ):
        write(POINTS[:49], NORMALS[:49], {})
    assert list(tmp_path.iterdir()) == []


def test_columns_and_ranges_of_slices(tmp_path: Path) -> None:
    colors = RNG.integers(0, 256, (50, 3))
    np.save(tmp_path / "a.npy", np.hstack([POINTS, colors]))
    part = next(iter(point_slices(tmp_path / "a.npy", "x,y,z,r,g,b", rows=9)))
    np.testing.assert_array_equal(as_colors(part.attributes["colors"], 255.0), colors[:9])
    np.testing.assert_array_equal(as_colors(np.array([[0.5, 0, 0]]), 200.0), [[0, 0, 0]])  # of others up to 200
    named = np.zeros(50, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("t", "f4")])
    named["x"], named["t"] = POINTS[:, 0], np.arange(50)
    np.save(tmp_path / "b.npy", named)
    parts = list(point_slices(tmp_path / "b.npy", rows=30))
    np.testing.assert_array_equal(parts[1].attributes["t"], np.arange(30, 50))


def test_what_is_not_read_or_written_in_parts_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    with pytest.raises(ValueError, match=r"a.xyz: .xyz is not read in slices, .* save it as one of .las .laz"):
        check_streamed(tmp_path / "a.xyz")
    with pytest.raises(ValueError, match=r"b.xyz: .xyz is not written in parts, .* take one of .las .laz .npy .ply"):
        check_partwise(tmp_path / "b.xyz")
    check_output(tmp_path / "b.xyz")
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n1 2 3\n"
    )
    with pytest.raises(ValueError, match="is a ply in text, which is not read in slices; save it in binary"):
        list(point_slices(tmp_path / "a.ply"))
