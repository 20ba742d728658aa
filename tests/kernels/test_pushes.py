"""Compiled even spacing against the plain one."""

import numpy as np
import pytest
import torch

from pnu.geometry import even_spacing
from pnu.geometry.even_spacing import pushed_apart, repel

pytestmark = pytest.mark.usefixtures("compiled")


def sheet(kind: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals (n, 3)."""
    rng = np.random.default_rng(n)
    normals = np.tile([0.0, 0.0, 1.0], (n, 1))
    points = np.column_stack([rng.uniform(size=(n, 2)), np.zeros(n)])
    if kind == "two sides":
        points[::2, 2], normals[::2] = 1e-3, [0.0, 0.0, -1.0]
    if kind == "repeated":
        points[: n // 2] = points[n // 2 : 2 * (n // 2)]
    if kind == "line":
        points[:, 1] = 0
    if kind == "equal":
        points[:] = points[0]
    if kind == "far":
        points += 1e6
    return points, normals


@pytest.mark.parametrize("kind", ["plain", "two sides", "repeated", "line", "equal", "far"])
@pytest.mark.parametrize("n", [1, 2, 7, 9, 130])
def test_points_move_as_by_plain_steps(monkeypatch: pytest.MonkeyPatch, kind: str, n: int) -> None:
    points, normals = sheet(kind, n)
    monkeypatch.setattr(even_spacing, "CHUNK", 50)
    fast = [repel(points, normals, steps=2, movable=movable) for movable in (None, n // 2)]
    monkeypatch.setenv("PNU_FAST", "0")
    plain = [repel(points, normals, steps=2, movable=movable) for movable in (None, n // 2)]
    np.testing.assert_allclose(fast, plain, rtol=1e-15, atol=1e-12)
    np.testing.assert_array_equal(fast[1][n // 2 :], points[n // 2 :])


def test_each_point_has_its_own_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 3.0, 0]])
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    near = np.array([[1, 2], [0, 2]])
    for fast in ("1", "0"):
        monkeypatch.setenv("PNU_FAST", fast)
        moved = pushed_apart(points, normals, near, np.array([2.0, 0.5]))
        # half a reach times (1 - 1 / 2), which is below three tenths of it; the second sees nobody
        np.testing.assert_allclose(moved, [[-0.5, 0, 0], [1, 0, 0]], atol=1e-15)


def test_threads_do_not_change_a_bit() -> None:
    points, normals = sheet("plain", 5000)
    before = torch.get_num_threads()
    try:
        found = []
        for number in (1, 3):
            torch.set_num_threads(number)
            found.append(repel(points, normals, steps=2))
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(*found)
