"""Even, random and uneven subsets."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pnu.geometry import farthest_sampling
from pnu.geometry import sampling as module
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.sampling import (
    farthest_points,
    nonuniform_points,
    poisson_disk_points,
    random_points,
)
from tests import reference


def cloud(clouds: int, n: int, *, seed: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(clouds, n, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.5


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(params=["compiled", "plain", "near blocks", "steps"])
def path(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The samplers of the CPU, whatever the size, and the loop of other devices."""
    if request.param == "steps":

        def steps(points: Tensor, m: int, *, start: int = 0, skip_near_origin: bool = False) -> Tensor:
            return module._farthest_steps(points.float(), m, torch.full((len(points),), start), skip_near_origin)

        monkeypatch.setattr("tests.geometry.test_sampling.farthest_points", steps)
    elif request.param == "compiled":
        request.getfixturevalue("compiled")
    else:
        monkeypatch.setenv("PNU_FAST", "0")
        monkeypatch.setattr(farthest_sampling, "NEAR_BLOCK", 16)
        monkeypatch.setattr(farthest_sampling, "BLOCKS_PAY", 0 if request.param == "near blocks" else 2**62)


@pytest.mark.usefixtures("path")
@pytest.mark.parametrize(
    ("n", "m", "start"), [(40, 12, 0), (40, 40, 17), (90, 30, 89), (1, 1, 0), (2, 2, 1), (9, 4, 3)]
)
def test_farthest_points(n: int, m: int, start: int) -> None:
    points = cloud(2, n, seed=n)
    idx = farthest_points(points, m, start=start)
    assert idx.dtype == torch.int64
    for b in range(2):
        np.testing.assert_array_equal(idx[b], reference.farthest_points(points[b].numpy(), m, start))


@pytest.mark.usefixtures("path")
def test_released_rule_near_the_origin() -> None:
    points = cloud(3, 60, seed=1) * 0.08
    assert 5 < int((points[0].square().sum(-1) <= 1e-3).sum()) < 55
    idx = farthest_points(points, 60, skip_near_origin=True)
    for b in range(3):
        expected = reference.farthest_points(points[b].numpy(), 60, skip_near_origin=True)
        np.testing.assert_array_equal(idx[b], expected)
        assert len(idx[b].unique()) < 60


@pytest.mark.usefixtures("path")
def test_all_points_near_the_origin() -> None:
    points = cloud(1, 20, seed=2) * 1e-3
    assert farthest_points(points, 5, skip_near_origin=True).tolist() == [[0] * 5]


@pytest.mark.usefixtures("path")
def test_duplicates_are_never_chosen_twice() -> None:
    points = cloud(2, 30, seed=3).repeat(1, 3, 1)
    idx = farthest_points(points, 90)
    assert all(len(row.unique()) == 90 for row in idx)
    assert all(len(points[b, idx[b, :30]].unique(dim=0)) == 30 for b in range(2))
    assert farthest_points(torch.zeros(1, 50, 3), 50)[0].sort().values.tolist() == list(range(50))


@pytest.mark.parametrize("n", [1000, 4096, 20_000])
def test_all_ways_choose_the_same(n: int) -> None:
    points = cloud(1, n, seed=n)
    for start in (0, 1, n // 2, n - 1):
        fast = farthest_points(points, 200, start=start)
        assert torch.equal(fast, module._farthest_steps(points, 200, torch.tensor([start]), False))
        np.testing.assert_array_equal(fast[0], farthest_sampling._farthest_near(points[0].numpy(), 200, start)[0])


def test_one_start_for_each_cloud() -> None:
    points, start = cloud(4, 50, seed=5), torch.tensor([3, 0, 49, 7])
    idx = farthest_points(points, 9, start=start)
    assert torch.equal(idx[:, 0], start)
    for b in range(4):
        assert torch.equal(idx[b : b + 1], farthest_points(points[b : b + 1], 9, start=int(start[b])))


def test_prefixes_are_samplings_too() -> None:
    points = cloud(1, 2000, seed=6)
    many, few = farthest_points(points, 1000), farthest_points(points, 100)
    assert torch.equal(many[:, :100], few)


def test_map_coordinates_in_float64() -> None:
    points = cloud(1, 500, seed=7, dtype=torch.float64)
    far = points + torch.tensor([5e5, 5e6, 0.0], dtype=torch.float64)
    assert torch.equal(farthest_points(points, 100), farthest_points(far, 100))


def test_large_cloud_is_covered_evenly() -> None:
    xyz = cloud(1, 30_000, seed=8)[0].numpy()
    idx = farthest_points_large(xyz, 3000)
    assert idx.dtype == np.int64
    assert idx[0] == 0
    assert len(np.unique(idx)) == 3000
    tree = cKDTree(xyz[idx])
    apart = tree.query(xyz[idx], k=2)[0][:, 1].min()
    # every point left out is nearer to a chosen one than any two chosen are to each other
    assert tree.query(xyz)[0].max() <= apart * (1 + 1e-5)
    np.testing.assert_array_equal(idx, farthest_points_large(torch.from_numpy(xyz), 3000))


@pytest.mark.slow
def test_a_million_points() -> None:
    idx = farthest_points_large(cloud(1, 1_000_000, seed=9)[0], 250_000)
    assert len(np.unique(idx)) == 250_000


def test_random_points_are_uniform_and_all_different() -> None:
    points = cloud(2000, 10, seed=10)
    idx = random_points(points, 3, generator=generator())
    assert all(len(row.unique()) == 3 for row in idx[:100])
    share = torch.bincount(idx.flatten(), minlength=10) / 2000
    assert (share - 0.3).abs().max() < 0.05
    assert torch.equal(idx, random_points(points, 3, generator=generator()))
    assert not torch.equal(idx, random_points(points, 3, generator=generator(1)))


def test_without_strength_the_draw_is_uniform() -> None:
    points = cloud(1, 8, seed=11).expand(4000, -1, -1)
    idx = nonuniform_points(points, 3, strength=0, centers=2, generator=generator())
    assert (torch.bincount(idx.flatten(), minlength=8) / 4000 - 3 / 8).abs().max() < 0.04


@pytest.mark.slow
def test_first_draw_follows_the_weights() -> None:
    # a line of 5 points; with one center c the weight of point i is exp(-strength |i - c| / max |j - c|)
    points = torch.zeros(1, 5, 3)
    points[0, :, 0] = torch.arange(5)
    draws = 20_000
    first = nonuniform_points(
        points.expand(draws, -1, -1), 1, strength=2.0, centers=1, generator=generator()
    )[:, 0]  # fmt: skip
    place = torch.arange(5.0)
    distance = (place[:, None] - place).abs()
    weight = torch.exp(-2 * distance / distance.max(1, keepdim=True).values)
    expected = (weight / weight.sum(1, keepdim=True)).mean(0)
    assert (torch.bincount(first, minlength=5) / draws - expected).abs().max() < 0.012


def test_strength_makes_the_draw_uneven() -> None:
    points = cloud(4, 4096, seed=12)
    unevenness = []
    for strength in (0.0, 2.0, 5.0):
        idx = nonuniform_points(points, 1024, strength=strength, centers=3, generator=generator())
        assert all(len(row.unique()) == 1024 for row in idx)
        chosen = points[0, idx[0]].numpy()
        spacing = cKDTree(chosen).query(chosen, k=9)[0][:, 8]
        unevenness.append(spacing.std() / spacing.mean())
    assert unevenness[0] + 0.02 < unevenness[1] < unevenness[2] - 0.02


def test_poisson_disk_points_keep_their_distance() -> None:
    points = cloud(2, 3000, seed=13)
    idx = poisson_disk_points(points, 300, generator=generator())
    assert torch.equal(idx, poisson_disk_points(points, 300, generator=generator()))
    assert not torch.equal(idx, poisson_disk_points(points, 300, generator=generator(1)))
    for b in range(2):
        even, random = points[b, idx[b]].numpy(), points[b, :300].numpy()
        assert cKDTree(even).query(even, k=2)[0][:, 1].min() > 5 * cKDTree(random).query(random, k=2)[0][:, 1].min()


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda p: farthest_points(p, 9), "m: expected 1 to 8 points (the size of the cloud), found 9"),
        (lambda p: farthest_points(p, 0), "m: expected 1 to 8 points (the size of the cloud), found 0"),
        (lambda p: farthest_points(p, 3, start=8), "start: expected indices in 0..7, found 8"),
        (lambda p: farthest_points_large(p[0], 9), "m: expected 1 to 8 points (the size of the cloud), found 9"),
        (
            lambda p: random_points(p, 9, generator=generator()),
            "m: expected 1 to 8 points (the size of the cloud), found 9",
        ),
        (
            lambda p: nonuniform_points(p, 3, strength=-1, centers=1, generator=generator()),
            "strength: expected a number >= 0, found -1",
        ),
        (
            lambda p: nonuniform_points(p, 3, strength=1, centers=9, generator=generator()),
            "centers: expected 1 to 8 centers, found 9",
        ),
    ],
)
def test_bad_input(call, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=r".") as error:
        call(cloud(2, 8, seed=14))
    assert str(error.value) == text


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("skip", [False, True])
def test_gpu_chooses_what_the_cpu_chooses(skip: bool) -> None:
    points = cloud(3, 2000, seed=15) * 0.5
    cpu = farthest_points(points, 500, start=5, skip_near_origin=skip)
    assert torch.equal(cpu, farthest_points(points.cuda(), 500, start=5, skip_near_origin=skip).cpu())
    twice = points[:, :100].repeat(1, 2, 1).cuda()
    assert all(len(row.unique()) == 200 for row in farthest_points(twice, 200).cpu())
