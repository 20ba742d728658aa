"""Noise that differs from place to place: measured where it is, and told from walls that points do not resolve."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pnu
from pnu.cleaning import clean_cloud, is_noisy
from pnu.data import shapes
from pnu.geometry.cloud_normals import settled_normals
from pnu.geometry.mesh_sampling import sample_area, sample_poisson_disk
from pnu.geometry.noise_level import is_louder_in_places, local_noise, noise_level
from pnu.geometry.spacing import spacing
from pnu.io import Cloud

NOISE = 0.015  # a third of the spacing of 6000 points of the unit sphere


def sphere(n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).standard_normal((n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def half_noisy(n: int = 6000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sphere with noise where x > 0: points (n, 3), true normals (n, 3), where there is noise (n,)."""
    clean = sphere(n)
    loud = clean[:, 0] > 0
    return clean + NOISE * loud[:, None] * np.random.default_rng(1).standard_normal((n, 3)), clean, loud


def test_local_noise_is_that_of_each_place() -> None:
    points, normals, loud = half_noisy()
    found = local_noise(points, normals)
    inside = np.abs(normals[:, 0]) > 0.2
    assert np.median(found[inside & loud]) == pytest.approx(NOISE, rel=0.15)
    assert (np.abs(np.log2(found[inside & loud] / NOISE)) < 1).mean() > 0.95
    assert found[inside & ~loud].max() < 0.03 * NOISE
    assert noise_level(points, normals) < 0.1 * NOISE  # that of the quietest tenth


def test_local_noise_at_some_rows_in_any_order_and_frame() -> None:
    points, normals, _ = half_noisy(1500)
    found = local_noise(points, normals)
    rows = np.array([3, 700, 1499])
    np.testing.assert_array_equal(local_noise(points, normals, rows), found[rows])
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_allclose(local_noise(points[order], normals[order]), found[order], rtol=1e-9, atol=1e-12)
    turn = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    moved = local_noise(5 * points @ turn.T + [7, 8, 9], normals @ turn.T)
    np.testing.assert_allclose(moved, 5 * found, rtol=1e-6, atol=1e-12)


def test_points_apart_tell_nothing_of_places() -> None:
    even = sample_poisson_disk(shapes.make("teddy"), 1000, np.random.default_rng(0))
    assert local_noise(even[:, :3], even[:, 3:]).max() == 0


@pytest.mark.parametrize("name", ["heat_sink", "enclosure", "gear", "gyroid", "teddy", "perforated_plate"])
def test_thin_walls_are_no_noise(name: str) -> None:
    cloud = sample_area(shapes.make(name), 5000, np.random.default_rng(0))
    normals = settled_normals(cloud[:, :3], None).normals
    assert not is_louder_in_places(cloud[:, :3], normals, noise_level(cloud[:, :3], normals))


@pytest.mark.parametrize("noise", [0.003, 0.01, 0.02])
def test_noise_that_is_everywhere_is_not_in_places(noise: float) -> None:
    points = sphere(5000) + noise * np.random.default_rng(1).standard_normal((5000, 3))
    assert not is_louder_in_places(points, sphere(5000), noise_level(points, sphere(5000)))


def test_a_cloud_that_is_noisy_in_places_takes_the_weights_for_noise() -> None:
    points, normals, _ = half_noisy()
    assert not noise_level(points) > 0.1 * spacing(points)
    assert is_noisy(points, normals)
    assert clean_cloud(Cloud(points, None, {})).character == "noisy"


@pytest.mark.parametrize("given", [False, True])
def test_where_there_is_noise_it_goes_and_elsewhere_nothing_moves(given: bool) -> None:
    points, normals, loud = half_noisy()
    dense = pnu.upsample(points, normals if given else None, ratio=2)
    off = np.abs(np.linalg.norm(dense[:, :3], axis=1) - 1)
    there = dense[:, 0] > 0.2
    before = np.abs(np.linalg.norm(points[loud], axis=1) - 1).mean()
    assert off[there].mean() < (0.17 if given else 0.3) * before
    assert off[dense[:, 0] < -0.2].mean() < 0.02 * before
