"""Depths in steps wider than the spacing: found wherever they were measured from, smoothed within themselves."""

from collections.abc import Callable

import numpy as np
import pytest

from pnu.data import shapes
from pnu.geometry.depth_steps import WIDE, depth_steps, smoothed_within_steps
from pnu.geometry.spacing import spacing


def seen_sphere(pixels: int = 150) -> tuple[np.ndarray, np.ndarray]:
    """What a camera at the origin sees of the unit sphere at (0, 0, 3): points (n, 3), and their distances (n,)."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.31, 0.31, pixels)] * 2))
    ray = np.column_stack([u, v, np.ones_like(u)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    root = 9 * ray[:, 2] ** 2 - 8
    ray, root = ray[root > 0.03], root[root > 0.03]
    away = 3 * ray[:, 2] - np.sqrt(root)
    return ray * away[:, None], away


def stepped(points: np.ndarray, step: float) -> np.ndarray:
    """Points on the same rays with depths z in so wide steps."""
    depth = points[:, 2]
    return points * (np.round(depth / step) * step / depth)[:, None]


def off_sphere(points: np.ndarray) -> float:
    return float(np.abs(np.linalg.norm(points - [0, 0, 3], axis=1) - 1).mean())


@pytest.mark.parametrize("step", [0.03, 0.08])
def test_points_come_back_to_the_surface_on_their_rays(step: float) -> None:
    true, _ = seen_sphere()
    points = stepped(true, step)
    steps = depth_steps(points, np.zeros(3))
    assert steps is not None
    np.testing.assert_allclose(steps.step, step, rtol=1e-6)
    np.testing.assert_allclose(steps.spacings, step / spacing(points))
    smooth = smoothed_within_steps(points, steps)
    assert (np.abs(smooth[:, 2] - points[:, 2]) <= step / 2 * (1 + 1e-9)).all()
    assert off_sphere(smooth) < 0.4 * off_sphere(points)  # where it faces the camera a step is all that is known
    np.testing.assert_allclose(smooth / smooth[:, 2:], points / points[:, 2:], atol=1e-12)


def test_a_plane_comes_back_exactly_but_for_its_rim() -> None:
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(0, 1, 100)] * 2))
    points = np.column_stack([u, v, np.round((0.31 * u + 0.2 * v) / 0.03) * 0.03])
    steps = depth_steps(points)
    assert steps is not None
    off = smoothed_within_steps(points, steps) @ [-0.31, -0.2, 1]
    assert np.quantile(np.abs(off), 0.9) < 0.002
    assert np.abs(points @ [-0.31, -0.2, 1]).mean() > 0.006


def test_steps_are_found_in_any_frame_and_in_single_precision() -> None:
    points = stepped(seen_sphere()[0], 0.03)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    moved = (points @ turn + [4, -2, 1]).astype(np.float32).astype(float)
    steps = depth_steps(moved)
    assert steps is not None
    np.testing.assert_allclose(np.median(steps.step), 0.03, rtol=1e-3)
    np.testing.assert_allclose(np.abs(steps.direction @ turn[2]), 1, atol=1e-6)


def test_distances_from_the_sensor_come_in_steps_too() -> None:
    true, away = seen_sphere()
    points = true / away[:, None] * (np.round(away / 0.03) * 0.03)[:, None]
    for moved, camera in ((points, None), (points + [5.0, 1, 2], np.array([5.0, 1, 2]))):
        steps = depth_steps(moved, camera)
        assert steps is not None
        np.testing.assert_allclose(steps.step, 0.03, rtol=1e-6)
        smooth = smoothed_within_steps(moved, steps) - (0 if camera is None else camera)
        assert off_sphere(smooth) < 0.4 * off_sphere(points)  # where it faces the camera a step is all that is known


def test_neither_the_order_nor_the_unit_matters() -> None:
    points = stepped(seen_sphere()[0], 0.03)
    order = np.random.default_rng(1).permutation(len(points))
    expected, turned = depth_steps(points), depth_steps(1024 * points[order])
    assert expected is not None
    assert turned is not None
    smooth = smoothed_within_steps(points, expected)[order]
    np.testing.assert_allclose(smoothed_within_steps(1024 * points[order], turned) / 1024, smooth, atol=1e-12)


def sphere(n: int) -> np.ndarray:
    points = np.random.default_rng(2).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def grid(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return tuple(values.ravel() for values in np.meshgrid(x, y))  # type: ignore[return-value]


def heights() -> np.ndarray:
    """A map of heights in whole numbers, on a grid as wide."""
    x, y = grid(np.arange(80.0), np.arange(80.0))
    return np.column_stack([x, y, np.round(6 * np.sin(x / 20) * np.cos(y / 25))])


def profiles() -> np.ndarray:
    """A surface along planes five spacings apart."""
    x, y = grid(np.arange(0.0, 100, 5), np.arange(0.0, 100))
    return np.column_stack([x, y, 5 * np.sin(x / 30) * np.cos(y / 25)])


def rings() -> np.ndarray:
    """A cylinder as slices show it, four spacings apart."""
    angle, z = grid(np.linspace(0, 2 * np.pi, 200, endpoint=False), np.arange(0.0, 4, 0.125))
    return np.column_stack([np.cos(angle), np.sin(angle), z])


NO_STEPS: dict[str, Callable[[], np.ndarray]] = {
    "random": lambda: sphere(20000),
    "voxels": lambda: np.unique(np.round(sphere(60000) / 0.04), axis=0) * 0.04,
    "rounded": lambda: np.unique(np.round(sphere(5000), 2), axis=0),
    "heights": heights,
    "profiles": profiles,
    "rings": rings,
    "fine steps": lambda: stepped(seen_sphere()[0], 0.9 * WIDE * spacing(seen_sphere()[0])),
    "few": lambda: stepped(seen_sphere(30)[0], 0.1),
}


@pytest.mark.parametrize("kind", NO_STEPS)
def test_other_clouds_have_no_steps(kind: str) -> None:
    assert depth_steps(NO_STEPS[kind](), np.zeros(3)) is None


@pytest.mark.parametrize("name", ["bolt", "enclosure", "flange", "gear", "pulley"])
def test_neither_have_the_corners_of_parts_with_walls(name: str) -> None:
    assert depth_steps(np.unique(shapes.make(name).vertices, axis=0)) is None
