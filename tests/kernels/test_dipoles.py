"""Compiled fields of dipoles against plain ones, and the orientation that comes from them."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from pnu.geometry import orientation
from pnu.geometry.normal_estimation import estimate_normals
from pnu.geometry.orientation import NeighborCloud

pytestmark = pytest.mark.usefixtures("compiled")


def shape(kind: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and lines (n, 3) in float64."""
    normals = np.random.default_rng(n).normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * [1.0, 0.7, 0.4]
    if kind == "sheet":
        points[:, 2], normals = 0.3 * points[:, 0] ** 2, np.tile([0.0, 0.0, 1.0], (n, 1))
    if kind == "repeated":
        points[: n // 2] = points[n // 2 : 2 * (n // 2)]
    if kind == "far":
        points = points + 1e6
    return points, normals


def assert_both_ways_equal(
    monkeypatch: pytest.MonkeyPatch, compute: Callable[[], np.ndarray], tolerance: float
) -> None:
    fast = compute()
    monkeypatch.setenv("PNU_FAST", "0")
    plain = compute()
    np.testing.assert_allclose(fast, plain, rtol=0, atol=tolerance * np.abs(plain).max())


KINDS = pytest.mark.parametrize("kind", ["ellipsoid", "sheet", "repeated", "far"])


@KINDS
@pytest.mark.parametrize("n", [7, 130, 300])
@pytest.mark.parametrize("what", ["distances", "dipoles", "winding", "adjoint", "field"])
def test_fields_equal_plain_ones(monkeypatch: pytest.MonkeyPatch, what: str, n: int, kind: str) -> None:
    points, normals = shape(kind, n)
    cloud, lines = NeighborCloud.of(points), normals.astype(np.float32)
    ways: dict[str, Callable[[], np.ndarray]] = {
        "distances": lambda: orientation._Pairs(cloud, np.sqrt(cloud.area)).inverse_cubes,
        "dipoles": lambda: orientation._dipoles(cloud, lines, 1.4),
        "winding": lambda: orientation._Pairs(cloud, np.sqrt(cloud.area)).winding(lines),
        "adjoint": lambda: orientation._Pairs(cloud, np.sqrt(cloud.area)).transposed(lines[:, 0]),
        "field": lambda: orientation.field(cloud, lines, 0.1),
    }
    # the plain distances of all pairs are differences of squares, which cost digits
    assert_both_ways_equal(monkeypatch, ways[what], 1e-5 if what == "field" else 2e-3)


@pytest.mark.parametrize("kind", ["ellipsoid", "sheet", "far"])
def test_normals_are_the_same_to_rounding(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    points = shape(kind, 400)[0]
    assert_both_ways_equal(monkeypatch, lambda: estimate_normals(points), 1e-4)


def test_threads_do_not_change_a_bit() -> None:
    points, before = shape("ellipsoid", 5000)[0], torch.get_num_threads()
    try:
        found = []
        for number in (1, 3):
            torch.set_num_threads(number)
            found.append(orientation.field(NeighborCloud.of(points), points.astype(np.float32), 0.1))
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(*found)
