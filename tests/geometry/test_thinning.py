"""Farthest points in blocks against farthest points of the whole: as even, and as even at the borders as inside."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pnu.geometry import farthest_sampling
from pnu.geometry.farthest_blocks import farthest_in_blocks
from pnu.geometry.farthest_sampling import farthest_apart, farthest_points_large
from pnu.geometry.spatial_blocks import along_curve, split_blocks

SIZE = 2**12  # of a block


def sphere(n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(n, 3)).astype(np.float32)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def choose(points: np.ndarray, m: int) -> np.ndarray:
    return farthest_sampling.farthest_order(points, m, 0)


def spacing(chosen: np.ndarray) -> np.ndarray:
    """Distance to the nearest other, and mean of the nearest six, of each: (m, 2)."""
    far = cKDTree(chosen).query(chosen, k=7)[0][:, 1:]
    return np.stack([far[:, 0], far.mean(1)], 1)


def at_border(points: np.ndarray, chosen: np.ndarray, width: float) -> np.ndarray:
    """Which of the chosen points have points of another block within `width`."""
    owner = np.empty(len(points), int)
    for number, members in enumerate(split_blocks(points, SIZE).members):
        owner[members] = number
    near = cKDTree(points).query_ball_point(points[chosen], width)
    return np.array([len(set(owner[idx].tolist())) > 1 for idx in near])


@pytest.mark.parametrize("share", [0.66, 0.25])
def test_borders_are_as_even_as_the_inside(share: float) -> None:
    points = sphere(60_000)
    m = round(share * len(points))
    chosen = farthest_in_blocks(points, m, farthest_apart, size=SIZE)
    assert chosen.shape == np.unique(chosen).shape == (m,)
    # mean and deviation of both spacings, at the places of the borders and elsewhere, beside those without blocks
    whole = choose(points, m)
    ours, exact = spacing(points[chosen]), spacing(points[whole])
    width = 1.5 * np.median(exact[:, 0])
    edge, exact_edge = at_border(points, chosen, width), at_border(points, whole, width)
    assert 0.02 < edge.mean() < 0.6
    for part, exact_part in ((ours[edge], exact[exact_edge]), (ours[~edge], exact[~exact_edge])):
        np.testing.assert_allclose(part.mean(0), exact_part.mean(0), rtol=0.02)  # independent blocks: 5 to 30 % off
        np.testing.assert_allclose(part.std(0), exact_part.std(0), rtol=0.1)
        assert part.min() > 0.93 * exact_part.min()
    reach = cKDTree(points[whole]).query(points)[0].max()
    assert cKDTree(points[chosen]).query(points)[0].max() < 1.06 * reach


def test_a_joint_of_independent_blocks_would_be_seen() -> None:
    points = sphere(60_000)
    parts = [members[choose(points[members], len(members) // 4)] for members in split_blocks(points, SIZE).members]
    chosen = np.concatenate(parts)
    found = spacing(points[chosen])[:, 0]
    edge = at_border(points, chosen, np.median(found))
    assert found[edge].mean() < 0.95 * found[~edge].mean()


def test_uneven_clouds_become_even() -> None:
    points = sphere(80_000)
    points = points[np.random.default_rng(0).random(len(points)) < np.where(points[:, 2] > 0, 1, 0.1)]
    chosen, whole = farthest_in_blocks(points, 4000, farthest_apart, size=SIZE), choose(points, 4000)
    up, expected = ((points[idx, 2] > 0).mean() for idx in (chosen, whole))
    assert up == pytest.approx(expected, abs=0.01)
    np.testing.assert_allclose(spacing(points[chosen]).mean(0), spacing(points[whole]).mean(0), rtol=0.01)


@pytest.mark.parametrize(("share", "m"), [(0.1, 20_000), (0.15, 30_000), (1, 40_000)])
def test_the_common_distance_is_found_at_once(share: float, m: int) -> None:
    points = sphere(80_000)
    points = points[np.random.default_rng(0).random(len(points)) < np.where(points[:, 2] > 0, 1, share)]
    steps: list[tuple[int, int]] = []
    farthest_in_blocks(points, m, farthest_apart, size=SIZE, step=lambda *step: steps.append(step))
    rounds = steps[-1][1] // len(split_blocks(points, SIZE).members)
    assert rounds <= 3  # one alone, one together, and one more where so small blocks mislead


def test_threads_do_not_matter_and_front_parts_are_even() -> None:
    points = sphere(30_000)
    one, three = (farthest_in_blocks(points, 9000, farthest_apart, size=SIZE, threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(one, three)
    front = points[one[: len(one) // 2]]
    random = points[: len(front)]
    assert spacing(front)[:, 0].std() / spacing(front)[:, 0].mean() < 0.5
    assert spacing(random)[:, 0].std() / spacing(random)[:, 0].mean() > 0.5


@pytest.mark.parametrize("m", [19_999, 20_000, 19_000])
def test_nearly_all_points(m: int) -> None:
    points = sphere(20_000)
    assert len(np.unique(farthest_in_blocks(points, m, farthest_apart, size=SIZE))) == m


def test_repeated_points() -> None:
    points = sphere(6000).repeat(4, 0)
    chosen = farthest_in_blocks(points, 6000, farthest_apart, size=SIZE)
    assert len(np.unique(chosen)) == 6000
    assert len(np.unique(points[chosen], axis=0)) > 5500
    assert len(np.unique(farthest_in_blocks(points, 9000, farthest_apart, size=SIZE))) == 9000


def test_large_clouds_take_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    points = sphere(10_000)
    exact = farthest_points_large(points, 3000)
    monkeypatch.setattr(farthest_sampling, "LARGE", 5000)
    monkeypatch.setattr("pnu.geometry.farthest_blocks.BLOCK", SIZE)
    chosen = farthest_points_large(points.astype(np.float64) + 1e6, 3000)
    assert len(np.unique(chosen)) == 3000
    assert spacing(points[chosen]).mean() == pytest.approx(spacing(points[exact]).mean(), rel=0.01)
    np.testing.assert_array_equal(farthest_points_large(points, 100), exact[:100])  # too few for blocks


def test_the_way_is_told() -> None:
    points, steps = sphere(20_000), []
    farthest_in_blocks(points, 5000, farthest_apart, size=SIZE, threads=2, step=lambda *step: steps.append(step))
    done, totals = zip(*steps, strict=True)
    assert list(done) == list(range(len(done)))
    assert done[-1] == totals[-1] >= 2 * len(split_blocks(points, SIZE).members)
    assert list(totals) == sorted(totals)


def test_near_along_the_curve_is_near_in_space() -> None:
    points = sphere(20_000).astype(np.float64) * 7 + 1e5
    order = along_curve(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(points)))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1)
    apart = cKDTree(points).query(points, k=2)[0][:, 1].mean()
    assert np.median(steps) < 3 * apart  # of a random order: about 7
    np.testing.assert_array_equal(along_curve(points[:1].repeat(5, 0)), np.arange(5))
    repeated = np.concatenate([points, points])  # of equal ones the first comes first
    np.testing.assert_array_equal(along_curve(repeated).reshape(-1, 2), order[:, None] + [0, len(points)])
