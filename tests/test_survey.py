"""What the program says of a cloud before it densifies it."""

import numpy as np
import pytest

from pnu.ops.survey import survey

RNG = np.random.default_rng(0)


def sphere(n: int) -> np.ndarray:
    points = RNG.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_spacing_of_a_grid() -> None:
    grid = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0), [0.0]), -1).reshape(-1, 3)
    found = survey(grid)
    assert found.middle == pytest.approx(1, abs=0.15)
    assert not found.uneven
    assert found.noise < 1e-6
    assert found.radius == pytest.approx(29 / np.sqrt(2))


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e5])
def test_noise_and_units(factor: float) -> None:
    clean = sphere(4000)
    noisy = clean + 0.01 * RNG.normal(size=clean.shape)
    quiet, loud = survey(factor * clean), survey(factor * noisy, clean)
    assert loud.noise == pytest.approx(0.01 * factor, rel=0.4)
    assert quiet.noise < 0.002 * factor
    assert quiet.middle == pytest.approx(factor * np.sqrt(4 * np.pi / 4000), rel=0.1)
    assert "no noise to speak of" in str(quiet)
    assert "noise about" in str(loud)


def test_uneven_clouds_are_told() -> None:
    points = sphere(20_000)
    kept = RNG.random(len(points)) < np.where(points[:, 2] > 0, 0.5, 0.1)
    assert survey(points[kept]).uneven
    assert "uneven" in str(survey(points[kept]))
    assert not survey(points[::4]).uneven


def test_the_smallest_cloud() -> None:
    assert np.isfinite(survey(sphere(16))[:]).all()


def test_noise_is_a_number_where_no_neighbours_look_the_same_way() -> None:
    normals = np.eye(3)[np.arange(20) % 3]  # at most seven of the 16 neighbours have the normal of a place
    assert survey(sphere(20), normals).noise == 0
