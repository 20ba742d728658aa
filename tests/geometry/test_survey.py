"""What the program says of a cloud before it densifies it."""

import numpy as np
import pytest

from pnu.data import shapes
from pnu.geometry.cloud_statistics import CONTRADICTING, describe_cloud
from pnu.geometry.flipped_parts import flipped_share, smaller_sides
from pnu.geometry.mesh_sampling import sample_area

RNG = np.random.default_rng(0)


def sphere(n: int) -> np.ndarray:
    points = RNG.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_spacing_of_a_grid() -> None:
    grid = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0), [0.0]), -1).reshape(-1, 3)
    found = describe_cloud(grid)
    assert found.middle == pytest.approx(1, abs=0.15)
    assert not found.uneven
    assert found.noise < 1e-6
    assert "no noise to speak of (below 0.001 of it" in str(found)  # not some 1e-25, which is rounding
    assert found.radius == pytest.approx(29 / np.sqrt(2))


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e5])
def test_noise_and_units(factor: float) -> None:
    clean = sphere(4000)
    noisy = clean + 0.01 * RNG.normal(size=clean.shape)
    quiet, loud = describe_cloud(factor * clean), describe_cloud(factor * noisy, clean)
    assert loud.noise == pytest.approx(0.01 * factor, rel=0.4)
    assert quiet.noise < 0.002 * factor
    assert quiet.middle == pytest.approx(factor * np.sqrt(4 * np.pi / 4000), rel=0.1)
    assert "no noise to speak of" in str(quiet)
    assert "noise about" in str(loud)


def test_uneven_clouds_are_told() -> None:
    points = sphere(20_000)
    kept = RNG.random(len(points)) < np.where(points[:, 2] > 0, 0.5, 0.1)
    assert describe_cloud(points[kept]).uneven
    assert "uneven" in str(describe_cloud(points[kept]))
    assert not describe_cloud(points[::4]).uneven


def test_the_smallest_cloud() -> None:
    assert np.isfinite(describe_cloud(sphere(16))[:]).all()


def test_noise_is_a_number_where_no_neighbors_look_the_same_way() -> None:
    normals = np.eye(3)[np.arange(20) % 3]  # at most seven of the 16 neighbors have the normal of a place
    assert describe_cloud(sphere(20), normals).noise == 0


def cube(n: int) -> tuple[np.ndarray, np.ndarray]:
    axis, side = RNG.integers(0, 3, n), RNG.choice([-1.0, 1.0], n)
    points, normals = RNG.uniform(-1, 1, (n, 3)), np.zeros((n, 3))
    points[np.arange(n), axis] = normals[np.arange(n), axis] = side
    return points, normals


def plate(n: int, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    side = RNG.choice([-1.0, 1.0], n)
    points = np.column_stack([RNG.uniform(-1, 1, (n, 2)), side * thickness / 2])
    return points, side[:, None] * [0, 0, 1.0]


def test_normals_that_contradict_each_other() -> None:
    """f of all flipped: 2 f (1 - f) of the pairs. Neither edges nor the two sides of a thin plate do that."""
    shapes = {"sphere": (sphere(2000),) * 2, "cube": cube(2000), "plate": plate(2000, 0.01)}
    for points, normals in shapes.values():
        assert not describe_cloud(points, normals).warnings()
    for name in ("sphere", "cube"):
        points, normals = shapes[name]
        for flipped in (0.1, 0.5):
            wrong = normals * np.where(RNG.random((2000, 1)) < flipped, -1, 1)
            found = describe_cloud(points, wrong)
            assert found.contradicting == pytest.approx(2 * flipped * (1 - flipped), abs=0.04)
            (line,) = found.warnings()
            assert f"{found.contradicting:.0%} of neighboring normals contradict each other; normals=estimate" in line


def lens(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Two caps of a sphere that meet in an edge as sharp as a knife's, 23 degrees."""
    points = sphere(400 * n)
    caps = points[np.abs(points[:, 2]) > 0.98][:n]
    return caps - 0.98 * np.sign(caps[:, 2:]) * [0, 0, 1], caps


@pytest.mark.parametrize("count", [1000, 5000, 60_000])
def test_a_flipped_half_is_told_though_few_pairs_contradict_each_other(count: int) -> None:
    points = sphere(count)
    half = describe_cloud(1e4 + 1e-3 * points, points * np.where(points[:, 2:] > 0, 1, -1))
    assert half.flipped == pytest.approx(0.5, abs=0.06)
    assert half.contradicting < CONTRADICTING or count < 5000  # these alone told nothing
    (line,) = half.warnings()
    assert line.startswith(f"at least {half.flipped:.0%} of the normals look to the other side than those beside them")
    noisy = points + 0.01 * RNG.normal(size=points.shape)
    cap = np.where(points[:, 2:] > 0.5, 1, -1) * np.where(RNG.random((count, 1)) < 0.2, np.nan, points)
    assert flipped_share(noisy, cap) == pytest.approx(0.25, abs=0.06)
    two = np.vstack([points, points + [9, 0, 0]])  # two things side by side may look as they like
    assert flipped_share(two, np.vstack([points, -points])) == 0


@pytest.mark.parametrize("name", ["teapot", "mug", "gear", "person", "wrench"])
def test_a_flipped_half_of_other_shapes(name: str) -> None:
    cloud = sample_area(shapes.make(name), 5000, np.random.default_rng(0))
    points, normals = cloud[:, :3], cloud[:, 3:]
    assert flipped_share(points, normals) == 0
    upper = points[:, 1:2] > np.median(points[:, 1])
    assert flipped_share(points, np.where(upper, -1, 1) * normals) > 0.05


@pytest.mark.parametrize("noise", [0, 0.003, 0.01, 0.03])
@pytest.mark.parametrize("count", [500, 5000])
def test_thin_and_sharp_things_are_not_taken_for_flipped(count: int, noise: float) -> None:
    for points, normals in (cube(count), plate(count, 0.01), plate(count, 0.1), lens(count)):
        assert flipped_share(points + noise * RNG.normal(size=points.shape), normals) == 0
    for name in ("spring_clip", "cup", "heat_sink", "moebius", "perforated_plate"):
        cloud = sample_area(shapes.make(name), count, RNG)
        assert flipped_share(cloud[:, :3] + noise * RNG.normal(size=(count, 3)), cloud[:, 3:]) == 0
    points = sphere(count)
    assert flipped_share(points, sphere(count)) == 0  # no normals at all, and signs at random
    assert flipped_share(points, points * RNG.choice([-1, 1], (count, 1))) == 0


def test_the_smaller_side_of_each_group_of_parts() -> None:
    sizes = np.array([50, 30, 40, 7, 9, 100])  # 0 | 1 | 2 in a row: 30 against 90; 3 | 4; 5 alone
    assert smaller_sides(sizes, np.array([[0, 1], [2, 1], [3, 4]])) == 30 + 7
    assert smaller_sides(sizes, np.empty((0, 2), int)) == 0


def test_a_point_far_from_all_others_is_named() -> None:
    points = sphere(500)
    assert describe_cloud(points).far == 0
    points[17] = [1e6, 0, 0]
    found = describe_cloud(points)
    assert (found.far, found.farthest) == (1, 17)
    assert any(line.startswith("1 of the points lie far from all others (number 18") for line in found.warnings())
    two = np.vstack([sphere(500), sphere(500) + [9, 0, 0]])  # two things are no outliers
    assert describe_cloud(two).far == 0


def test_some_normals_may_be_missing() -> None:
    points = sphere(2000)
    normals = np.where(RNG.random((2000, 1)) < 0.1, np.nan, points)
    found, all_known = describe_cloud(points, normals), describe_cloud(points, points)
    assert found.noise == pytest.approx(all_known.noise, rel=0.5)
    assert found.contradicting == 0
