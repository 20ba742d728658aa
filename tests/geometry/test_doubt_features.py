"""How doubtful points lie to the surface that all others sample: hand-computed values, invariances, few points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnu.geometry.doubt_features import BENT, DOUBT_FEATURES, OF_LEVEL, PLANES, RANKS, doubt_features

FIRST_PLANE, SECOND_PLANE = len(RANKS), len(RANKS) + 6  # columns of a level
BENT_HEIGHT = SECOND_PLANE + 6


def grid(n: int = 21, bend: float = 0.0) -> np.ndarray:
    """Points a unit apart on z = bend (x^2 + y^2) / 2."""
    x, y = np.meshgrid(*2 * [np.arange(n) - n // 2])
    return np.stack([x, y, bend * (x * x + y * y) / 2], -1).reshape(-1, 3).astype(np.float64)


def no_odds(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points), np.float32)


def features(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return doubt_features(points, others, no_odds(points))


def test_heights_over_a_plane_in_spacings_near_and_far() -> None:
    points = np.array([[0.5, 0.5, 1.0], [0.5, 0.5, 0.0], [0.4, 0.5, 3.0]])
    found = features(points, grid())
    assert found.shape == (3, DOUBT_FEATURES)
    spacing = np.sqrt(2)  # to the sixth neighbor
    np.testing.assert_allclose(found[:, FIRST_PLANE], [1 / spacing, 0, 3 / spacing], atol=1e-6)
    assert (found[:2, BENT_HEIGHT] < [0.8, 1e-5]).all()
    # thinned out to a quarter, their spacing is about twice as wide, and the height so many fewer of them
    thinned = found[:, OF_LEVEL + FIRST_PLANE]
    np.testing.assert_allclose(thinned * np.exp(found[:, -6]), found[:, FIRST_PLANE], rtol=0.01, atol=1e-6)
    assert ((np.exp(found[:, -6]) > 1.5) & (np.exp(found[:, -6]) < 3)).all()


def test_the_odds_of_the_first_look_come_along() -> None:
    points, odds = grid(3) + [0.5, 0.5, 1], np.linspace(-1, 9, 9, dtype=np.float32)
    np.testing.assert_array_equal(doubt_features(points, grid(), odds)[:, -1], np.minimum(odds, 6))


def test_a_surface_that_bends_is_continued() -> None:
    bowl = grid(bend=0.4)
    middle = len(bowl) // 2
    found = features(bowl[middle][None], np.delete(bowl, middle, 0))[0]
    assert found[SECOND_PLANE] > 0.2  # the bottom, below the plane through twelve of its neighbors
    assert found[BENT_HEIGHT] < 0.05 * found[SECOND_PLANE]
    assert PLANES[1] == BENT[0]


def test_the_side_on_which_nothing_is() -> None:
    points = np.array([[0.5, 0.5, 0.1], [12.0, 0.5, 0.1]])
    inside, outside = features(points, grid())[:, OF_LEVEL - 1]
    assert inside < np.pi / 2
    assert outside > np.pi


def test_order_place_rotation_and_size_have_no_influence() -> None:
    rng = np.random.default_rng(0)
    others = rng.normal(size=(800, 3))
    others /= np.linalg.norm(others, axis=1, keepdims=True)
    points = rng.uniform(0.8, 1.2, (40, 1)) * others[:40] + 0.01 * rng.normal(size=(40, 3))
    plain = features(points, others)
    turn = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    moved = features(1e3 * points @ turn.T + [5e3, 0, 0], 1e3 * rng.permutation(others) @ turn.T + [5e3, 0, 0])
    np.testing.assert_allclose(moved, plain, atol=1e-4)


@pytest.mark.parametrize(("points", "others"), [(1, 25), (2, 40), (5, 300)])
def test_few_points(points: int, others: int) -> None:
    rng = np.random.default_rng(2)
    found = features(rng.normal(size=(points, 3)), rng.normal(size=(others, 3)))
    assert found.shape == (points, DOUBT_FEATURES)
    assert np.isfinite(found).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("others", ["line", "one place", "plane", "places several times"])
def test_degenerate_clouds(others: str) -> None:
    rng = np.random.default_rng(3)
    clouds = {
        "line": np.linspace(0, 1, 100)[:, None] * [1.0, 2, 3],
        "one place": np.ones((30, 3)),
        "plane": grid(),
        "places several times": rng.normal(size=(20, 3)).repeat(8, 0),
    }
    assert np.isfinite(features(rng.normal(size=(5, 3)), clouds[others])).all()
