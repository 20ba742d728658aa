"""Compiled fits to neighborhoods against NumPy's: normals, and the features of stray points."""

import numpy as np
import pytest

from pnu.geometry.normal_estimation import estimate_normals, refit_normals
from pnu.geometry.outlier_features import outlier_features

pytestmark = pytest.mark.usefixtures("compiled")


def cloud(kind: str, n: int) -> np.ndarray:
    """Points (n, 3) of a rough ellipsoid with strays, or of a kind that has no planes."""
    rng = np.random.default_rng(n)
    points = rng.normal(size=(n, 3))
    points *= [1, 0.6, 0.3] / np.linalg.norm(points, axis=1, keepdims=True)
    points += 0.01 * rng.normal(size=(n, 3))
    points[: n // 50] *= 1.3
    return {"far": points + 1e6, "plane": points * [1, 1, 0], "line": points * [1, 0, 0]}.get(kind, points)


@pytest.mark.parametrize("kind", ["near", "far", "plane", "line"])
@pytest.mark.parametrize("n", [3, 20, 33, 34, 2500])
def test_features_equal_numpys(monkeypatch: pytest.MonkeyPatch, n: int, kind: str) -> None:
    points = cloud(kind, n)
    fast = outlier_features(points)
    monkeypatch.setenv("PNU_FAST", "0")
    plain = outlier_features(points)
    if kind == "line" or n == 3:  # which of its planes a line has is open: features of normals are left out
        plain, fast = plain[:, :18], fast[:, :18]
    np.testing.assert_allclose(fast, plain, rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", ["near", "far", "plane"])
@pytest.mark.parametrize("n", [20, 300, 2500])
def test_normals_equal_numpys(monkeypatch: pytest.MonkeyPatch, n: int, kind: str) -> None:
    points = cloud(kind, n)
    fast = [estimate_normals(points, orient=False), refit_normals(points, estimate_normals(points))]
    monkeypatch.setenv("PNU_FAST", "0")
    plain = [estimate_normals(points, orient=False), refit_normals(points, estimate_normals(points))]
    np.testing.assert_allclose(abs((fast[0] * plain[0]).sum(1)), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(fast[1], axis=1), 1, atol=1e-5)
    alike = (fast[1] * plain[1]).sum(1) > 1 - 1e-4  # single precision decides where the weights of two sheets are alike
    assert alike.mean() > 0.99


def test_normals_of_points_at_one_place_and_of_few() -> None:
    for points in (np.zeros((40, 3)), np.eye(3), np.arange(12.0).reshape(4, 3)):
        found = estimate_normals(points, min(len(points), 16))
        assert np.isfinite(found).all()
