"""LOP, WLOP, EAR and L0: each term of their equations by hand, then what they are for."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pnu.geometry.pair_weights import theta, within
from pnu.upsamplers import Context, Upsampler, ear, l0, lop, whole_clouds, wlop

E = np.exp(-1.0)
H = 4.0  # theta(1) = exp(-1), theta(2) = exp(-4)
ORIGIN = np.zeros((1, 3))
CORNER = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])  # distances 1, 2, sqrt 5


def turned(degrees: float) -> list[float]:
    """A unit normal tilted from z towards x."""
    angle = np.radians(degrees)
    return [np.sin(angle), 0, np.cos(angle)]


def test_theta() -> None:
    np.testing.assert_allclose(theta(np.array([0.0, 1, 2]), H), [1, E, E**4])


def test_pairs_are_those_within_the_radius() -> None:
    pairs = within(CORNER, CORNER, 2.1, itself=False)
    assert sorted(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)) == [(0, 1), (0, 2), (1, 0), (2, 0)]
    assert len(within(CORNER, CORNER, 2.1).i) == 7


def test_lop_attraction() -> None:
    method = lop.LOP(repulsion=0)
    np.testing.assert_allclose(method.first(ORIGIN, CORNER[1:], H), [[E / (E + E**4), 2 * E**4 / (E + E**4), 0]])
    # alpha = theta / r
    expected = [[E / (E + E**4 / 2), 2 * E**4 / 2 / (E + E**4 / 2), 0]]
    np.testing.assert_allclose(method.step(ORIGIN, CORNER[1:], H), expected)
    far = np.full((1, 3), 100.0)
    np.testing.assert_array_equal(method.step(far, CORNER, H), far)  # none to draw it: it stays


def test_lop_repulsion() -> None:
    # of the origin by the two others: beta = theta / r / r^4
    near, other = E, E**4 / 2**5
    expected = [-near / (near + other), -2 * other / (near + other), 0]
    np.testing.assert_allclose(lop.LOP().apart(CORNER, H)[0], expected)


def test_wlop_weights() -> None:
    pair = CORNER[:2]
    np.testing.assert_allclose(wlop.density(pair, H), [1 + E, 1 + E])
    # attraction: alpha / v. The point at (0, 2, 0) sees (1, 0, 0) at sqrt 5, the others see each other.
    v = 1 + np.exp(-5.0)
    weights = np.array([E / v, E**4 / 2 / v])
    found = wlop.WLOP(repulsion=0).step(ORIGIN, CORNER[1:], H)
    np.testing.assert_allclose(found, [(weights @ CORNER[1:]) / weights.sum()])
    # repulsion: beta = w theta / r, w = 1 + sum theta
    w = np.array([1 + E + np.exp(-5.0), 1 + E**4 + np.exp(-5.0)])
    weights = w * [E, E**4 / 2]
    np.testing.assert_allclose(wlop.WLOP().apart(CORNER, H)[0], -(weights @ CORNER[1:]) / weights.sum())


def test_bilateral_normals() -> None:
    np.testing.assert_allclose(ear.psi(np.cos(np.radians([0.0, 15])), 15), [1, E])
    points, normals = CORNER[:2], np.array([turned(0), turned(15)])
    mean = normals[0] + E * E * normals[1]  # theta(1) psi(15 degrees)
    found = ear.bilateral_normals(points, normals, H, 15)
    np.testing.assert_allclose(found[0], mean / np.linalg.norm(mean))


def test_resampling_is_drawn_by_its_own_side() -> None:
    """Of two points as far away, one in the plane, one a quarter of the radius off it: weights 1 and exp(-1)."""
    points = np.array([[1.0, 0, 0], [0, 0, 1]])
    found = ear.resampled(ORIGIN, np.array([turned(0)]), points, H, mu=0)
    np.testing.assert_allclose(found, [[1 / (1 + E), 0, E / (1 + E)]])
    moved = ear.resampled(CORNER[:2], np.array([turned(0)] * 2), CORNER[:2] + [0, 0, 9], H, mu=0.5)
    np.testing.assert_allclose(moved, [[-0.5, 0, 0], [1.5, 0, 0]])  # nothing draws, the two repel each other


def test_priority_of_insertion() -> None:
    points = np.array([[-1.0, 0, 0], [1, 0, 0]])
    tree, ends = cKDTree(points), np.array([[0, 1]])
    for normals, expected in (
        (np.array([turned(0), turned(0)]), 1.0),  # clearance 1, parallel normals
        (np.array([turned(-45), turned(45)]), 2 * np.sqrt(0.5)),  # perpendicular: (2 - 0) times distance to the lines
    ):
        priority, _ = ear.priorities(tree, normals, ends, ORIGIN, 1.0)
        np.testing.assert_allclose(priority, [expected])
    np.testing.assert_array_equal(ear.neighbor_pairs(tree), [[0, 1]])
    places = np.array([[0.0, 0, 0], [0.5, 0, 0], [2, 0, 0]])
    np.testing.assert_array_equal(ear.apart_in_order(places, np.ones(3)), [0, 2])


def test_inserted_points_are_projected_to_one_side_of_an_edge() -> None:
    """Floor z = 0 for x < 0, wall x = 0 for z > 0: a place off both goes onto one of them, with its normal."""
    grid = np.arange(1.0, 6)
    floor = np.array([[-x, y, 0] for x in grid for y in grid])
    wall = np.array([[0, y, z] for z in grid for y in grid])
    points, normals = np.vstack([floor, wall]), np.repeat([[0.0, 0, 1], [-1.0, 0, 0]], 25, axis=0)
    ends = np.array([[0, 25]])  # (-1, 1, 0) and (0, 1, 1)
    found, direction = ear.projected(cKDTree(points), normals, points[ends].mean(1), ends, 4.0, 15)
    on_floor, on_wall = abs(found[0, 2]) < 1e-9, abs(found[0, 0]) < 1e-9
    assert on_floor != on_wall
    np.testing.assert_allclose(direction[0], [0, 0, 1] if on_floor else [-1, 0, 0], atol=1e-9)


def test_l0_keeps_the_step_and_nothing_else() -> None:
    given = np.array([[0.0], [0.1], [1.0], [1.1]])
    chain = np.array([[0, 1], [1, 2], [2, 3]])
    difference = l0.edge_matrix(chain, 4, np.ones(3))
    np.testing.assert_array_equal(difference.toarray(), [[1, -1, 0, 0], [0, 1, -1, 0], [0, 0, 1, -1]])
    found = l0.l0_minimum(given, difference, np.zeros((3, 1)), 0.05)
    np.testing.assert_allclose(found.ravel(), [0.05, 0.05, 1.05, 1.05], atol=0.02)


def test_l0_points_move_along_their_normals_into_one_plane() -> None:
    points, normals = np.array([[0.0, 0, 0.1], [1, 0, -0.1]]), np.array([turned(0)] * 2)
    found = l0.l0_points(points, normals, np.array([[0, 1], [1, 0]]), 1.0)
    np.testing.assert_allclose(found, [[0, 0, 0], [1, 0, 0]], atol=1e-3)


def noisy_cube(n: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points, side = rng.uniform(-1, 1, (n, 3)), rng.integers(6, size=n)
    normals = np.zeros((n, 3))
    normals[np.arange(n), side // 2] = 1.0 - 2 * (side % 2)
    points[np.arange(n), side // 2] = 1.0 - 2 * (side % 2)
    return points + noise * rng.normal(size=(n, 3)), normals


def off_cube(points: np.ndarray) -> float:
    """Mean distance to the faces of the points over their middles: edges are rounded by all but EAR."""
    places = np.sort(np.abs(points[:, :3]), axis=1)
    return float(np.abs(places[places[:, 1] < 0.5, 2] - 1).mean())


@pytest.mark.parametrize(
    "method", [lop.LOP(turns=6), wlop.WLOP(turns=6), ear.EAR(turns=3), l0.L0()], ids=lambda m: type(m).__name__
)
def test_a_noisy_cube_gets_nearer_to_the_surface_anywhere(method: Upsampler) -> None:
    points, normals = noisy_cube(1000, 0.04)
    found = whole_clouds.upsample(50 * points + 1e4, normals, ratio=1, model=method, outliers="keep")
    assert off_cube((found - 1e4) / 50) < 0.8 * off_cube(points)
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:], axis=1), 1)


@pytest.mark.parametrize("name", ["lop", "wlop", "ear", "l0"])
def test_any_ratio_by_name(name: str) -> None:
    points, normals = noisy_cube(150, 0.0)
    found = whole_clouds.upsample(points, normals, ratio=2.3, model=name, outliers="keep")
    assert found.shape == (345, 6)
    assert len(np.unique(found[:, :3], axis=0)) == 345


def test_ear_leads_points_to_the_edges_and_keeps_their_normals() -> None:
    points, normals = noisy_cube(1200, 0.0)
    found = whole_clouds.upsample(points, normals, ratio=3, model=ear.EAR(sensitivity=1, turns=2), outliers="keep")
    axis = np.abs(found[:, :3]).argmax(1)
    cosine = np.abs(found[np.arange(len(found)), 3 + axis])
    assert (cosine > 0.99).mean() > 0.97
    cloud = torch.from_numpy(np.hstack([points, normals]))
    given = ear.EAR().upsample_cloud(cloud, 1500, Context())
    np.testing.assert_allclose(given[:1200, :3].numpy(), points)  # a clean cloud's points stay


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lop.LOP(radius=0), "radius=0: expected a number of spacings > 0"),
        (lambda: wlop.WLOP(repulsion=0.5), r"repulsion=0\.5: expected a number from 0 to below 0\.5"),
        (lambda: lop.LOP(turns=0), "turns=0: expected at least 1"),
        (lambda: ear.EAR(angle=90), "angle=90: expected degrees between 0 and 90"),
        (lambda: ear.EAR(sensitivity=-1), "sensitivity=-1"),
        (lambda: ear.EAR(radius=float("nan")), "radius=nan"),
        (lambda: ear.EAR(turns=-1), "turns=-1: expected at least 0"),
        (lambda: l0.L0(neighbors=0), "neighbors=0: expected at least 1"),
        (lambda: l0.L0(point_weight=0), "point_weight=0: expected a number > 0"),
    ],
)
def test_arguments(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
