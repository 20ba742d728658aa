"""Upsamplers without training: exact where they must be, and as good as they are known to be."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pnu import metrics
from pnu.io import read_cloud, read_mesh
from pnu.upsamplers import APSS, Context, Midpoint, classical, whole_clouds

FAST = ("apss", "midpoint")


def quiet(stage: str, done: int, total: int) -> None:
    assert 0 <= done <= total


def sphere(n: int, seed: int = 0) -> np.ndarray:
    normals = np.random.default_rng(seed).normal(size=(n, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("ratio", [1, 2.3, 40])
@pytest.mark.parametrize("name", FAST)
def test_count_frame_and_normals(name: str, ratio: float) -> None:
    normals = sphere(300)
    dense = whole_clouds.upsample(50 * normals + 1e5, normals, ratio=ratio, model=classical(name))
    assert dense.shape == (round(300 * ratio), 6)
    assert len(np.unique(dense[:, :3], axis=0)) == len(dense)
    offset = (dense[:, :3] - 1e5) / 50
    radius = np.linalg.norm(offset, axis=1)
    np.testing.assert_allclose(np.linalg.norm(dense[:, 3:], axis=1), 1)
    assert ((dense[:, 3:] * offset).sum(1) / radius).min() > 0.95
    if name == "apss":  # a sphere is reproduced, also between the points
        np.testing.assert_allclose(radius, 1, atol=1e-6)
    # Nothing is left uncovered: no place on the sphere is farther from the result than from the input.
    places = sphere(2000, seed=1)
    assert cKDTree(offset).query(places)[0].max() <= 1.05 * cKDTree(normals).query(places)[0].max()


@pytest.mark.parametrize("name", FAST)
def test_seed(name: str) -> None:
    normals = sphere(200)
    one, same, other = (
        whole_clouds.upsample(normals, normals, ratio=3, model=classical(name), seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert np.array_equal(one, other) == (name == "midpoint")


@pytest.mark.parametrize("name", FAST)
def test_without_normals(name: str) -> None:
    dense = whole_clouds.upsample(sphere(500), ratio=2, model=classical(name))
    assert (dense[:, :3] * dense[:, 3:]).sum(1).min() > 0.8


def test_midpoints_by_hand() -> None:
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    normals = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    cloud = torch.cat([square, normals], 1)
    dense = Midpoint(3).upsample_cloud(cloud, 6, Context(progress=quiet)).tolist()
    half = 0.5**0.5
    expected = {
        (0.5, 0, 0): (half, half, 0), (1, 0.5, 0): (-half, half, 0), (0.5, 1, 0): (-half, half, 0),
        (0, 0.5, 0): (half, half, 0), (0.5, 0.5, 0): None,
    }  # fmt: skip
    corners = {tuple(point[:3]): tuple(point[3:]) for point in cloud.tolist()}
    assert {tuple(p[:3]) for p in dense} > set(corners)
    for point in dense:
        normal = (corners | expected)[tuple(point[:3])]
        if normal is not None:  # in the middle two diagonals meet, one of them between opposite normals
            assert point[3:] == pytest.approx(normal)
        assert np.linalg.norm(point[3:]) == pytest.approx(1)


def test_apss_fills_a_hole_of_the_sampling() -> None:
    normals = sphere(1500)
    normals = normals[normals[:, 2] < np.cos(0.12)]  # a hole of three spacings
    dense = whole_clouds.upsample(normals, normals, ratio=4, model=classical("apss"))
    assert cKDTree(dense[:, :3]).query([0, 0, 1])[0] < 0.08 < cKDTree(normals).query([0, 0, 1])[0]


def test_poisson_surface() -> None:
    pytest.importorskip("open3d")
    normals = sphere(2000)
    dense = whole_clouds.upsample(normals, normals, ratio=2, model=classical("poisson"))
    assert dense.shape == (4000, 6)
    np.testing.assert_allclose(np.linalg.norm(dense[:, :3], axis=1), 1, atol=0.01)
    assert (dense[:, :3] * dense[:, 3:]).sum(1).min() > 0.98
    assert float(metrics.spacing_cv(dense)) < 0.15


@pytest.mark.slow
def test_poisson_makes_no_bubble_at_an_open_border() -> None:
    pytest.importorskip("open3d")
    normals = sphere(4000)
    normals = normals[normals[:, 2] > 0]
    dense = whole_clouds.upsample(normals, normals, ratio=2, model=classical("poisson"))
    assert cKDTree(normals).query(dense[:, :3])[0].max() < 0.25


@pytest.mark.parametrize("name", FAST)
def test_names_are_models(name: str) -> None:
    normals = sphere(100)
    dense = whole_clouds.upsample(normals, normals, model=name)
    np.testing.assert_array_equal(dense, whole_clouds.upsample(normals, normals, model=classical(name)))


@pytest.mark.parametrize("make", [lambda: Midpoint(0), lambda: APSS(3), lambda: APSS(seeds=1), lambda: APSS(reach=1)])
def test_too_few_neighbors_are_refused(make: Callable[[], object]) -> None:
    """They would give no points, and without new ones midpoints go on for ever."""
    with pytest.raises(ValueError, match=r"^(neighbors|seeds|reach)=\d: expected at least \d$"):
        make()


def test_unknown_method() -> None:
    with pytest.raises(ValueError, match="method=aps: expected one of apss, poisson, midpoint"):
        classical("aps")


@pytest.mark.slow
def test_apss_is_as_good_as_known(shared: Path) -> None:
    found = []
    for shape in ("casting", "duck", "fandisk", "camel", "elephant", "kitten"):
        points, normals, *_ = read_cloud(shared / "bench" / "clouds" / f"{shape}.xyz")
        dense = whole_clouds.upsample(points, normals, model=classical("apss"))
        truth = np.load(shared / "bench" / "truth" / f"{shape}_20000.npy")
        close = metrics.compare_mesh(dense, read_mesh(shared / "bench" / "truth" / f"{shape}.ply"))
        far = metrics.compare(dense, truth)
        names = ("chamfer_sq", "hausdorff_sq", "p2f", "normal_unsigned_deg")
        found.append([float((far | close)[name]) for name in names])
    mean = np.mean(found, 0) * [1e3, 1e3, 1e3, 1]
    assert (mean <= [0.1, 1.7, 0.75, 7.5]).all(), mean
