"""What every cloud goes through when it comes in: nothing is changed or left out without a line that says so."""

import struct
from pathlib import Path

import numpy as np
import pytest

from pnu.io import Cloud, check_cloud, read_cloud, write_cloud
from tests.io.test_io import ply_binary

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(40, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)


def test_a_clean_cloud_is_left_alone() -> None:
    cloud = check_cloud(Cloud(POINTS, NORMALS, {"label": np.arange(40)}), "c")
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-15)
    assert cloud.notes == ()


def test_points_that_are_not_finite_are_dropped_with_all_that_belongs_to_them() -> None:
    points = POINTS.copy()
    points[3, 0], points[7, 1], points[9, 2] = np.nan, -np.inf, 1e200
    cloud = check_cloud(Cloud(points, NORMALS, {"label": np.arange(40)}), "c")
    kept = np.delete(np.arange(40), [3, 7, 9])
    np.testing.assert_array_equal(cloud.points, POINTS[kept])
    np.testing.assert_allclose(cloud.normals, NORMALS[kept])
    np.testing.assert_array_equal(cloud.attributes["label"], kept)
    assert cloud.notes == ("3 of 40 points left out: NaN, infinite or beyond 1e+30",)


def test_a_signalling_nan_is_one_too(tmp_path: Path) -> None:
    content = ply_binary("<").replace(struct.pack("<f", 1.25), struct.pack("<I", 0x7FA00000))
    (tmp_path / "c.ply").write_bytes(content)
    cloud = read_cloud(tmp_path / "c.ply")
    assert len(cloud.points) == 19
    assert "1 of 20 points left out: NaN" in cloud.notes[0]


def test_each_place_counts_once() -> None:
    rows = np.r_[0:40, 5, 5, 8]
    cloud = check_cloud(Cloud(POINTS[rows], None, {"label": rows}), "c")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.attributes["label"].tolist() == list(range(40))
    assert cloud.notes == ("3 of 43 points left out: at the place of another",)


def test_a_piece_at_the_origin_is_no_zeros() -> None:
    points = np.vstack([POINTS, 1e8 + POINTS])
    cloud = check_cloud(Cloud(points, None, {}), "c")
    np.testing.assert_array_equal(cloud.points, points)
    assert cloud.notes == ()


@pytest.mark.parametrize("nothing", [0, 1e-9])
def test_zeros_where_a_sensor_saw_nothing(nothing: float) -> None:
    points = np.vstack([POINTS, np.full((30, 3), nothing)])
    cloud = check_cloud(Cloud(points, None, {}), "c")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.notes == ("30 of 70 points left out: at the origin, where a sensor saw nothing",)
    corner = np.repeat(np.vstack([POINTS, np.zeros((1, 3))]), 30, 0)  # one point of a cloud that is all repeated
    assert len(check_cloud(Cloud(corner, None, {}), "c").points) == 41


def test_no_order_tells_which_of_several_normals_is_taken() -> None:
    points, normals = np.vstack([POINTS, POINTS[:9]]), np.vstack([NORMALS, -NORMALS[:9]])
    there, back = (check_cloud(Cloud(points[::step], normals[::step], {}), "c") for step in (1, -1))
    both = [np.hstack([cloud.points, cloud.normals]) for cloud in (there, back)]
    np.testing.assert_array_equal(*[rows[np.lexsort(rows.T)] for rows in both])


@pytest.mark.parametrize("value", [0, np.nan, np.inf])
def test_normals_that_are_none(value: float) -> None:
    cloud = check_cloud(Cloud(POINTS, np.full((40, 3), value), {}), "c")
    assert cloud.normals is None
    assert cloud.notes == ("normals are all zero or NaN: taken as none",)
    some = NORMALS.copy()
    some[[2, 5]] = value
    cloud = check_cloud(Cloud(POINTS, some, {}), "c")
    assert cloud.normals is not None
    assert np.flatnonzero(np.isnan(cloud.normals).all(1)).tolist() == [2, 5]
    np.testing.assert_allclose(np.delete(cloud.normals, [2, 5], 0), np.delete(NORMALS, [2, 5], 0))
    assert cloud.notes == ("2 of 40 normals are zero or NaN: theirs are estimated",)
    assert check_cloud(cloud, "c").normals is not None  # what was checked may be checked again


@pytest.mark.parametrize("factor", [1e-200, 1e-4, 3.0, 1e200])
def test_normals_of_any_length_are_directions(factor: float) -> None:
    cloud = check_cloud(Cloud(POINTS, factor * NORMALS, {}), "c")
    np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-12)
    assert cloud.notes == (f"normals have lengths {factor:.2g} to {factor:.2g}: their directions are taken",)


def test_what_is_said_of_a_file(tmp_path: Path) -> None:
    write_cloud(tmp_path / "c.ply", np.vstack([POINTS, POINTS[:3]]), np.zeros((43, 3)))
    assert read_cloud(tmp_path / "c.ply").notes == (
        "3 of 43 points left out: at the place of another",
        "normals are all zero or NaN: taken as none",
    )
    assert read_cloud(tmp_path / "c.ply", normals=False).notes == ("3 of 43 points left out: at the place of another",)


def test_degrees_are_told_from_lengths() -> None:
    """Some kilometers of land in degrees, beside the same in meters and a thin pole."""
    land = np.random.default_rng(0).random((100, 3)) * [0.02, 0.01, 40] + [11.5, 48.1, 500]
    (note,) = check_cloud(Cloud(land, None, {}), "c").notes
    assert "x and y are degrees" in note
    meters = (land - land[0]) * [74_000, 111_000, 1]
    pole = land * [5, 10, 0.1]  # 10 cm wide, 4 m high
    for points in (meters, meters + [5e5, 5e6, 0], pole, POINTS, POINTS * [1, 1, 0], POINTS * [1e-3, 1e-3, 1]):
        assert check_cloud(Cloud(points, None, {}), "c").notes == ()
