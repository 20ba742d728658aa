"""Rims of holes and borders of clouds."""

import numpy as np
import pytest

from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area
from pnu.geometry.open_rims import open_rims
from tests.reconstruction.test_surfaces import sphere_points


def even_sphere(n: int) -> np.ndarray:
    return sphere_points(n)[:, :3].astype(np.float64)


def test_a_closed_surface_has_no_rim() -> None:
    assert open_rims(even_sphere(2000)) == []
    normal = np.random.default_rng(0).normal(size=(4000, 3))  # random points of an even density
    assert open_rims(normal / np.linalg.norm(normal, axis=1, keepdims=True)) == []


def test_the_lip_of_a_thin_wall_is_no_rim() -> None:
    cup = sample_area(shapes.make("mug"), 3000, np.random.default_rng(0))
    assert open_rims(cup[:, :3]) == []


def test_two_holes_the_wider_first() -> None:
    points = even_sphere(4000)
    holed = points[(points[:, 2] < 0.9) & (points[:, 0] < 0.95)]
    wide, narrow = open_rims(holed)
    assert wide.radius == pytest.approx(np.sqrt(1 - 0.9**2), rel=0.25)
    assert narrow.radius == pytest.approx(np.sqrt(1 - 0.95**2), rel=0.25)
    assert (holed[wide.rows, 2] > 0.75).all()
    assert (holed[narrow.rows, 0] > 0.85).all()


def test_a_sheet_ends_on_all_sides() -> None:
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), -1).reshape(-1, 2)
    sheet = np.hstack([grid, np.zeros((1600, 1))]) + np.random.default_rng(0).normal(size=(1600, 3)) * [0.1, 0.1, 0.01]
    (rim,) = open_rims(sheet)
    assert rim.radius == pytest.approx(19.5 * 2**0.5, rel=0.05)
    on_border = ((grid == 0) | (grid == 39)).any(1)
    assert on_border[rim.rows].mean() > 0.6
    assert len(set(rim.rows) & set(np.flatnonzero(on_border))) > 0.9 * on_border.sum()


def test_few_points_have_none() -> None:
    assert open_rims(even_sphere(20)) == []


def test_rows_are_those_of_a_large_cloud() -> None:
    points = even_sphere(70_000)
    holed = points[points[:, 2] < 0.9]
    (rim,) = open_rims(holed)
    assert (holed[rim.rows, 2] > 0.85).all()
