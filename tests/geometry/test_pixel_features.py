"""What a camera's picture tells of torn points: lines of inverse depth, and rays with two points."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnu.geometry.pixel_features import BESIDE, PIXEL_FEATURES, pixel_features

Array = NDArray[np.float64]
MIDDLE = 20 * 41 + 20
BETWEEN, BEYOND = -2 * BESIDE, -BESIDE  # columns of the best lines through two sides, and through two in a row


def slanted(torn: float = 0.0, beside: bool = False) -> Array:
    """A plane that a camera at the origin sees at 80 degrees, one point of it farther; last, if beside its own."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.2, 0.2, 41)] * 2))
    rays = np.stack([u, v, np.ones_like(u)], 1)
    normal = np.array([np.sin(np.radians(80)), 0, np.cos(np.radians(80))])
    points = rays * (normal @ [0, 0, 3.0] / (rays @ normal))[:, None]
    farther = points[MIDDLE] * (1 + torn)
    if beside:
        return np.vstack([points, farther])
    points[MIDDLE] = farther
    return points


def test_a_plane_at_any_slant_is_straight_and_a_torn_point_is_not() -> None:
    smooth, torn = (pixel_features(slanted(off), np.zeros(3)) for off in (0.0, 0.1))
    assert smooth.shape == (41 * 41, PIXEL_FEATURES)
    inside = np.abs(slanted()[:, :2] / slanted()[:, 2:]).max(1) < 0.17
    assert smooth[inside][:, [BETWEEN, BEYOND]].max() < 0.02  # rays have different lengths
    pixels = 0.1 / 1.1 / 0.01  # by which inverse depth is off, in the angle of a pixel
    np.testing.assert_allclose(np.sinh(torn[MIDDLE, BETWEEN]), 1.1 * pixels, rtol=0.05)
    assert np.isfinite(torn).all()


def test_two_points_on_a_ray() -> None:
    found = pixel_features(slanted(0.1, beside=True), np.zeros(3))
    farther, nearer = found[-1, :2], found[MIDDLE, :2]
    assert farther[0] > 2
    assert farther[1] == 0
    assert nearer[0] == 0
    np.testing.assert_allclose(np.sinh(nearer[1]) * 1.1, -np.sinh(farther[0]) * 1.21, rtol=0.02)
    others = np.delete(found[:-1], MIDDLE, 0)
    assert (others[:, :2] == 0).all()


def test_place_rotation_size_and_order_have_no_influence() -> None:
    rng = np.random.default_rng(0)
    points, camera = slanted(0.1) + 0.01 * rng.normal(size=(41 * 41, 3)), np.array([0.1, 0, 0.2])
    found, order, turn = (
        pixel_features(points, camera),
        rng.permutation(len(points)),
        Rotation.random(rng=rng).as_matrix(),
    )
    np.testing.assert_allclose(pixel_features(points[order], camera), found[order], atol=1e-5)
    moved = pixel_features(50 * points @ turn.T + 7, 50 * turn @ camera + 7)
    assert (np.abs(moved - found).max(1) > 1e-3).mean() < 0.01  # where two are as near, either may be the neighbor
