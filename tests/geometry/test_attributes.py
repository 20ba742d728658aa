"""Attributes at new points: exact where they must be, and never from the other side of a sheet."""

import subprocess
import sys

import numpy as np
import pytest

from pnu.geometry.attributes import carry
from pnu.io import read_cloud, write_cloud
from pnu.io.scan_columns import tells_apart

RNG = np.random.default_rng(0)


def plane(n: int, z: float = 0.0, up: float = 1.0) -> np.ndarray:
    return np.hstack([RNG.uniform(0, 1, (n, 2)), np.full((n, 1), z), np.tile([0, 0, up], (n, 1))])


def test_known_points_keep_their_values() -> None:
    cloud, values = plane(50), RNG.normal(size=(50, 3))
    np.testing.assert_allclose(carry(cloud, cloud, values), values, atol=1e-9)


def test_constants_stay_and_slopes_are_followed() -> None:
    sparse, dense = plane(2000), plane(300)
    np.testing.assert_allclose(carry(dense, sparse, np.full(2000, 7.5)), 7.5)
    inner = dense[(abs(dense[:, :2] - 0.5) < 0.4).all(1)]
    np.testing.assert_allclose(carry(inner, sparse, sparse[:, 0]), inner[:, 0], atol=0.03)


def test_sides_of_a_thin_sheet_do_not_mix() -> None:
    sparse = np.vstack([plane(500, 0.01), plane(500, -0.01, -1.0)])
    colors = np.repeat(np.array([[255, 0, 0], [0, 0, 255]], np.uint8), 500, axis=0)
    dense = np.vstack([plane(900, 0.01), plane(900, -0.01, -1.0)])
    np.testing.assert_array_equal(carry(dense, sparse, colors), np.repeat(colors[[0, -1]], 900, axis=0))


def test_types_and_shapes_stay() -> None:
    sparse, dense = plane(40), plane(25)
    for values in (np.arange(40), np.arange(40, dtype=np.uint8), np.ones((40, 4), np.float32), np.arange(40) > 20):
        carried = carry(dense, sparse, values)
        assert carried.dtype == values.dtype
        assert carried.shape == (25, *values.shape[1:])


def test_whole_numbers_are_rounded() -> None:
    sparse = np.array([[0.0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1]])
    dense = np.array([[0.3, 0, 0, 0, 0, 1]])
    share = (1 / 0.3**2) / (1 / 0.3**2 + 1 / 0.7**2)
    assert carry(dense, sparse, np.array([0, 100]))[0] == round(100 * (1 - share)) == 16


@pytest.mark.parametrize("kind", [np.uint8, np.int64, np.float64, np.str_, np.bool_])
def test_kinds_have_no_mean(kind: type) -> None:
    """Ground (2) beside a building (6) is no vegetation (4): what has the greater weight around a point."""
    sparse, dense = plane(400), plane(300)
    classes = np.where(sparse[:, 0] < 0.5, 2, 6).astype(np.uint8)
    if kind is np.bool_:
        values = classes > 2
    else:
        values = classes.astype(kind)
    carried = carry(dense, sparse, values)
    assert carried.dtype == values.dtype
    assert set(carried) == set(values)
    clear = abs(dense[:, 0] - 0.5) > 0.1
    expected = values[np.where(dense[:, 0] < 0.5, classes.argmin(), classes.argmax())]
    np.testing.assert_array_equal(carried[clear], expected[clear])


def test_the_kind_of_the_greatest_weight() -> None:
    """Two neighbors of a kind a little farther away outweigh a single one of another."""
    sparse = np.zeros((100, 6))
    sparse[:, 5], sparse[:, 0] = 1, np.arange(100) + 10.0
    sparse[:3, 0] = [0.9, -1, -1.01]
    kinds = np.ones(100, np.uint16)
    kinds[0] = 9
    assert carry(np.array([[0.0, 0, 0, 0, 0, 1]]), sparse, kinds)[0] == 1
    assert carry(np.array([[0.4, 0, 0, 0, 0, 1]]), sparse, kinds)[0] == 9


def test_numbers_of_many_scans_are_no_amounts() -> None:
    sparse, dense = plane(400), plane(300)
    numbers = np.arange(400) // 4  # more than are taken for kinds by themselves
    assert set(carry(dense, sparse, 1000 * numbers)) - set(1000 * numbers)
    assert set(carry(dense, sparse, 1000 * numbers, kinds=True)) <= set(1000 * numbers)
    names = ("scan", "point_source_id", "scalar_Classification", "sensor_x", "Label")
    assert all(map(tells_apart, names))
    assert not any(map(tells_apart, ("intensity", "gps_time", "scan_angle", "z")))


def test_point_that_faces_no_neighbor_takes_the_nearest() -> None:
    sparse, dense = plane(10), plane(5, up=-1.0)
    nearest = np.linalg.norm(dense[:, None, :3] - sparse[:, :3], axis=2).argmin(1)
    np.testing.assert_array_equal(carry(dense, sparse, np.arange(10)), nearest)


@pytest.mark.parametrize("suffix", [".ply", pytest.param(".pcd", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_colors_of_a_thin_sheet_reach_the_file(tmp_path, suffix: str) -> None:
    """Two sides a third of a spacing apart, red and blue, densified by the command itself."""
    sides = np.repeat([1.0, -1.0], 400)
    cloud = np.vstack([plane(400, 0.008), plane(400, -0.008, -1.0)])
    colors = np.where(sides[:, None] > 0, [[200, 0, 0]], [[0, 0, 100]]).astype(np.uint8)
    write_cloud(tmp_path / "in.ply", cloud[:, :3], cloud[:, 3:], {"colors": colors, "side": sides})
    command = [
        sys.executable,
        "-m",
        "pnu",
        "upsample",
        "input=in.ply",
        f"output=out{suffix}",
        "run=surface",
        "quiet=true",
    ]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=120)
    dense = read_cloud(tmp_path / f"out{suffix}")
    assert dense.normals is not None
    assert dense.attributes["colors"].dtype == np.uint8
    up = dense.normals[:, 2] > 0
    np.testing.assert_array_equal(
        dense.attributes["colors"][:, :3], np.where(up[:, None], [[200, 0, 0]], [[0, 0, 100]])
    )
    np.testing.assert_allclose(dense.attributes["side"], np.where(up, 1.0, -1.0), atol=1e-5)
    assert (np.sign(dense.points[:, 2]) == np.where(up, 1, -1)).mean() > 0.95
