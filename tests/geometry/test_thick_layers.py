"""Layers of noise thicker than the spacing of points: measured, told from walls, and averaged."""

import numpy as np
import pytest

from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area
from pnu.geometry.spacing import spacing
from pnu.geometry.thick_layers import APART, LEFT, layer_means, layer_noise


def noisy_sphere(n: int, noise: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True) + noise * rng.normal(size=(n, 3))


@pytest.mark.parametrize("spacings", [1.2, 2.0, 4.0])
def test_noise_is_measured_where_it_is_wider_than_the_spacing(spacings: float) -> None:
    noise = spacings * np.sqrt(4 * np.pi / 20000)
    found = layer_noise(noisy_sphere(20000, noise))
    assert found is not None
    assert 0.65 * noise < found < 1.15 * noise


@pytest.mark.parametrize("name", ["pipe_tee", "cup", "enclosure", "heat_sink", "perforated_plate", "urchin"])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_thin_walls_are_no_layer(name: str, noise: float) -> None:
    points = sample_area(shapes.make(name), 10000, np.random.default_rng(0))[:, :3]
    points = points + noise * spacing(points) * np.random.default_rng(1).normal(size=points.shape)
    assert layer_noise(points) is None


def test_neither_are_what_fills_space_and_few_points() -> None:
    assert layer_noise(np.random.default_rng(0).uniform(-1, 1, (20000, 3))) is None
    assert layer_noise(noisy_sphere(5000, 0.1)) is None


def test_means_lie_apart_and_not_in_the_fringe() -> None:
    points = noisy_sphere(60000, 0.025)
    noise = layer_noise(points)
    assert noise is not None
    means = layer_means(points, noise)
    assert 0.6 * LEFT < len(means.points) < 20000
    assert len(np.unique(means.rows)) == len(means.rows) == len(means.points)
    off = np.abs(np.linalg.norm(means.points, axis=1) - 1)
    assert off.mean() < 0.65 * 0.025  # of the points 0.8
    assert off.max() < 2.5 * 0.025  # 4.3
    apart = np.linalg.norm(points[means.rows][:, None] - points[means.rows][None, :200], axis=2)
    assert np.sort(apart, axis=0)[1].min() > 0.99 * APART * noise


def test_order_and_unit_do_not_matter() -> None:
    points = noisy_sphere(15000, 0.05)
    noise = layer_noise(points)
    assert noise is not None
    order = np.random.default_rng(1).permutation(len(points))
    found, other = layer_means(points, noise), layer_means(points[order], noise)
    np.testing.assert_allclose(other.points, found.points, atol=1e-12)
    np.testing.assert_array_equal(order[other.rows], found.rows)
    scaled = layer_noise(1000 * points)
    assert scaled == pytest.approx(1000 * noise)
