"""Compiled searches against all distances: the k nearest points and farthest point sampling, bit by bit."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pnu.geometry import farthest_sampling
from pnu.geometry.point_tree import PointTree
from pnu.geometry.sampling import farthest_points
from pnu.kernels.boxes import box_order

KINDS = ("random", "plane", "line", "equal", "repeated", "far", "lattice", "clusters")
Points = np.ndarray


def cloud(kind: str, n: int) -> Points:
    """Points (n, 3) of a kind."""
    points = np.random.default_rng(n).normal(size=(n, 3))
    if kind in ("plane", "line"):
        points[:, 2 if kind == "plane" else 1 :] = 0
    if kind == "equal":
        points[:] = points[0]
    if kind == "repeated":
        points = points[np.random.default_rng(1).integers(0, max(n // 5, 1), n)]
    if kind == "far":
        points = 0.01 * points + 1e6
    if kind == "lattice":
        points = np.round(3 * points)
    if kind == "clusters":
        points[: n // 2] *= 1e-6
        points[0] = 1e5
    return points


def nearest(queries: Points, points: Points, k: int) -> tuple[Points, Points]:
    """By all distances; of equal ones the lowest index first."""
    x, y, z = (queries[:, None] - points).transpose(2, 0, 1)
    dist_sq = x * x + y * y + z * z
    idx = np.argsort(dist_sq, axis=1, kind="stable")[:, :k]
    return np.take_along_axis(dist_sq, idx, 1), idx


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "k"), [(1, 1), (5, 5), (17, 3), (129, 24), (1000, 1), (2000, 24), (700, 700)])
def test_neighbors_are_those_of_all_distances(n: int, k: int, kind: str) -> None:
    points = cloud(kind, n)
    queries = np.concatenate([points[:150], points[:50] + 0.1 * cloud("random", min(n, 50)), [[7.0, 8.0, 9.0]]])
    dist_sq, idx = PointTree(points).nearest_sq(queries, k)
    expected, expected_idx = nearest(queries, points, k)
    np.testing.assert_array_equal(dist_sq, expected)
    if kind != "equal" or n < 500:
        np.testing.assert_array_equal(idx, expected_idx)
    assert all(len(set(row)) == k for row in idx)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [1, 7, 33])
def test_neighbors_of_queries_that_lie_together(k: int, kind: str) -> None:
    points = cloud(kind, 1000)
    apart = np.median(nearest(points, points, 4)[0][:, 3]) ** 0.5
    for push in (0.0, 0.3, 5.0):  # of four around each point, in spacings
        queries = np.repeat(points, 4, 0)
        queries += push * apart * np.random.default_rng(k).normal(size=queries.shape)
        dist_sq, idx = PointTree(points).nearest_sq(queries, k)
        expected, expected_idx = nearest(queries, points, k)
        np.testing.assert_array_equal(dist_sq, expected)
        if kind != "equal":
            np.testing.assert_array_equal(idx, expected_idx)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("kind", ["random", "lattice", "equal", "repeated"])
def test_neighbors_depend_neither_on_the_order_of_queries_nor_on_threads(kind: str) -> None:
    points, mixed = cloud(kind, 5000), np.random.default_rng(0).permutation(5000)
    tree = PointTree(points)
    dist, idx = tree.nearest(points, 9)
    for number, found in ((1, tree.nearest(points[mixed], 9)), (3, tree.nearest(points[mixed], 9, threads=3))):
        np.testing.assert_array_equal(found[0], dist[mixed], err_msg=f"{number} threads")
        np.testing.assert_array_equal(found[1], idx[mixed], err_msg=f"{number} threads")


def test_a_tree_without_kernels_finds_the_same(monkeypatch: pytest.MonkeyPatch, compiled: None) -> None:
    points, queries = cloud("random", 3000), cloud("random", 400)
    dist, idx = PointTree(points).nearest(queries, 16)
    monkeypatch.setenv("PNU_FAST", "0")
    plain = PointTree(points)
    assert not plain.compiled
    found, found_idx = plain.nearest(queries, 16)
    np.testing.assert_allclose(found, dist, rtol=1e-14)
    np.testing.assert_array_equal(found_idx, idx)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [1, 2, 63, 64, 65, 200, 2000])
def test_farthest_points_are_those_of_plain_steps(monkeypatch: pytest.MonkeyPatch, n: int, kind: str) -> None:
    points = cloud(kind, n).astype(np.float32)
    monkeypatch.setattr(farthest_sampling, "NEAR_BLOCK", 50)
    spread = float(np.ptp(points, axis=0).max())
    cases = [{"start": n // 3}, {"given": n // 3}, {"given": n // 4, "least": spread / 8}, {"least": spread / 20}]
    for m in {1, max(n // 2, 1), n}:
        for case in cases:
            idx, apart = farthest_sampling.farthest_apart(points, m, **case)  # type: ignore[arg-type]
            options = {"start": 0} | case
            for plain in (farthest_sampling._farthest_plain, farthest_sampling._farthest_near):
                expected, expected_apart = plain(points, m, **options)  # type: ignore[arg-type]
                np.testing.assert_array_equal(idx, expected)
                np.testing.assert_array_equal(apart, expected_apart)
            assert len(set(idx)) == len(idx) == (m if "least" not in case else len(idx))
            given = min(int(case.get("given", 0)), m)
            np.testing.assert_array_equal(idx[:given], np.arange(given))
            assert np.isinf(apart[: max(given, 1)]).all()
            assert (apart[max(given, 1) :] >= np.float32(case.get("least", 0))).all()


@pytest.mark.usefixtures("compiled")
def test_farthest_points_stop_where_all_is_near_those_chosen() -> None:
    points = cloud("random", 2000).astype(np.float32)
    least = 0.2 * float(np.ptp(points, axis=0).max())
    idx, apart = farthest_sampling.farthest_apart(points, 2000, given=5, least=least)
    between = cKDTree(points[idx]).query(points)[0]
    assert 5 < len(idx) < 500
    assert between.max() < least
    far = np.linalg.norm(points[idx[5:], None] - points[idx], axis=2)
    before = np.where(np.arange(len(idx)) < np.arange(5, len(idx))[:, None], far, np.inf).min(1)
    np.testing.assert_allclose(apart[5:], before, rtol=1e-5)


@pytest.mark.usefixtures("compiled")
def test_farthest_points_of_several_threads() -> None:
    clouds = [cloud("random", n).astype(np.float32) for n in (3000, 2000, 1000)]
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda points: farthest_sampling.farthest_order(points, 500, 0), clouds))
    for points, idx in zip(clouds, found, strict=True):
        np.testing.assert_array_equal(idx, farthest_sampling.farthest_order(points, 500, 0))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_or_chosen_from_plainly(value: float) -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    bad = points.copy()
    bad[50, 1] = value
    with pytest.raises(ValueError, match=r"points: expected finite coordinates"):
        PointTree(bad)
    with pytest.raises(ValueError, match=r"queries: expected finite coordinates"):
        PointTree(points).nearest(bad, 3)
    for k in (0, 201):
        with pytest.raises(ValueError, match=rf"k: expected 1 to 200 neighbors, found {k}"):
            PointTree(points).nearest(points, k)
    chosen = farthest_points(torch.from_numpy(bad)[None].float(), 20)
    assert chosen.shape == (1, 20)
    assert ((chosen >= 0) & (chosen < 200)).all()


@pytest.mark.parametrize("first", [50_000, 66_000, 99_999])
def test_boxes_of_sorted_points_of_which_one_goes_first(first: int) -> None:
    """Sorted but for one: its selections take rounds by the thousand where pivots are always the same three."""
    row = np.arange(100_000.0)
    row = np.concatenate([row[[first]], np.delete(row, first)])
    order = box_order(np.column_stack([row, np.zeros((len(row), 2))]), 32)
    leaves = row[order].reshape(-1, 32)
    assert (leaves[1:].min(1) > leaves[:-1].max(1)).all()
    assert sorted(order) == list(range(len(row)))
