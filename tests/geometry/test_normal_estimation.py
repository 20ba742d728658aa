"""Normals of bare clouds where planes through neighbors see more than one side: thin walls, noise, few points."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pnu.geometry import orientation
from pnu.geometry.normal_estimation import estimate_normals
from pnu.geometry.orientation import NeighborCloud
from pnu.runtime import threads

Floats = NDArray[np.float64]


def flipped(points: Floats, true: Floats) -> float:
    """Share of the normals that look to the wrong side."""
    return float(((estimate_normals(points) * true).sum(1) < 0).mean())


def tube(n: int, wall: float, seed: int) -> tuple[Floats, Floats]:
    """n random points of both sides of the wall of an open tube of radius and half length 1, and outward normals."""
    rng = np.random.default_rng(seed)
    outer = rng.random(n) < 0.5
    angle, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(-1, 1, n)
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], 1)
    places = np.where(outer, 1, 1 - wall)[:, None] * radial + z[:, None] * [0, 0, 1]
    return places, np.where(outer, 1, -1)[:, None] * radial


def crate(n: int, wall: float, seed: int) -> tuple[Floats, Floats]:
    """About n random points of both sides of five walls of a cube of half width 1, and outward normals."""
    rng, places, normals = np.random.default_rng(seed), [], []
    for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1)):
        for inner in (False, True):
            some = rng.uniform(-1, 1, (n // 10, 3)) * (1 - wall if inner else 1)
            some[:, axis] = side * (1 - wall * inner)
            places.append(some)
            normals.append(np.eye(3)[axis] * np.full((n // 10, 1), -side if inner else side))
    return np.concatenate(places), np.concatenate(normals)


@pytest.mark.parametrize(("shape", "most"), [(tube, 0.04), (crate, 0.2)])
def test_walls_as_thin_as_the_spacing_have_two_sides(shape, most) -> None:  # type: ignore[no-untyped-def]
    points, true = shape(1500, 0.1, seed=0)
    assert flipped(points, true) < most


@pytest.mark.parametrize(("noise", "most"), [(0.03, 0.01), (0.08, 0.12)])
def test_noise_of_the_size_of_the_spacing_turns_few_normals_over(noise: float, most: float) -> None:
    rng = np.random.default_rng(0)
    around, across = rng.uniform(0, 2 * np.pi, (2, 2000))
    ring = np.stack([np.cos(around), np.sin(around), np.zeros(2000)], 1)
    true = np.cos(across)[:, None] * ring + np.sin(across)[:, None] * [0, 0, 1]
    assert flipped(ring + 0.35 * true + noise * rng.standard_normal((2000, 3)), true) < most


def test_moments_are_those_of_plain_least_squares() -> None:
    """Steps without the matrix (n, 3 n) against a dense one, in float64."""
    points, _ = tube(200, 0.2, seed=1)
    cloud = NeighborCloud.of(points)
    weight = np.sqrt(cloud.area)
    pairs = orientation._Pairs(cloud, weight)
    offset = cloud.points[None].astype(np.float64) - cloud.points[:, None]
    floor = (cloud.spacing[:, None] ** 2 + cloud.spacing**2) / 2
    distance = np.sqrt(np.maximum((offset**2).sum(-1), floor))
    dense = offset / (4 * np.pi * distance[..., None] ** 3) * weight[:, None] * weight[:, None, None]
    flat = dense.reshape(200, 600)
    rng = np.random.default_rng(2)
    moments, values = rng.normal(size=(200, 3)).astype(np.float32), rng.normal(size=200).astype(np.float32)
    np.testing.assert_allclose(pairs.winding(moments), flat @ moments.ravel(), atol=1e-5)
    np.testing.assert_allclose(pairs.transposed(values).ravel(), flat.T @ values, atol=1e-5)

    x, residual = np.zeros(600), 0.5 * weight.astype(np.float64)
    gradient = flat.T @ residual
    direction = gradient
    for found in orientation._least_squares(pairs, np.float32(0.5) * weight, 4):
        step = (gradient @ gradient) / ((flat @ direction) @ (flat @ direction))
        x, residual = x + step * direction, residual - step * (flat @ direction)
        new = flat.T @ residual
        direction, gradient = new + (new @ new) / (gradient @ gradient) * direction, new
        np.testing.assert_allclose(found.ravel(), x, atol=2e-3 * np.abs(x).max())


def test_sides_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    points, _ = tube(1500, 0.1, seed=0)
    found = []
    for count in (1, 3):
        monkeypatch.setattr(threads, "thread_count", lambda count=count: count)
        found.append(estimate_normals(points))
    np.testing.assert_array_equal(*found)
