"""Neighbor searches against loops, in trees and in chunks."""

from functools import partial
from types import ModuleType

import numpy as np
import pytest
import torch
from torch import Tensor

from pnu.geometry import neighbor_search as module
from pnu.geometry.neighbor_search import Search, ball_query, knn, nearest
from tests import reference

DTYPES = [torch.float32, torch.float64]


def cloud(clouds: int, n: int, *, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(clouds, n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.fixture(params=["tree", pytest.param("kernel", marks=pytest.mark.slow), "chunks", "tiny chunks"])
def path(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tree of the CPU, and on the CPU what other devices take: kernels, chunks whole or a few rows at a time."""
    if request.param == "kernel":
        kernels = pytest.importorskip("pnu.geometry.triton_kernels")
        monkeypatch.setattr(module, "_knn_tree", partial(module._knn_kernel, kernels))
        monkeypatch.setattr(module, "_ball_tree", lambda q, t, *rest: kernels.ball_query(*module._single(q, t), *rest))
        monkeypatch.setattr(module, "CHUNK_ELEMENTS", 60)
    elif request.param != "tree":
        monkeypatch.setattr(module, "_knn_tree", module._knn_chunks)
        monkeypatch.setattr(module, "_ball_tree", module._ball_chunks)
    if request.param == "tiny chunks":
        monkeypatch.setattr(module, "CHUNK_ELEMENTS", 60)


@pytest.mark.usefixtures("path")
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("m", "n", "k"), [(9, 13, 4), (1, 5, 5), (17, 3, 1), (4, 1, 1), (0, 6, 2)])
def test_knn(m: int, n: int, k: int, dtype: torch.dtype) -> None:
    query, target = cloud(3, m, seed=1, dtype=dtype), cloud(3, n, seed=2, dtype=dtype)
    found = knn(query, target, k)
    assert found.idx.dtype == torch.int64
    assert found.dist_sq.dtype == dtype
    assert found.idx.shape == found.dist_sq.shape == (3, m, k)
    for b in range(3 if m else 0):
        dist_sq, idx = reference.knn(query[b].double().numpy(), target[b].double().numpy(), k)
        np.testing.assert_array_equal(found.idx[b], idx)
        np.testing.assert_allclose(found.dist_sq[b], dist_sq, rtol=1e-5 if dtype == torch.float32 else 1e-12)


@pytest.mark.usefixtures("path")
def test_knn_by_hand() -> None:
    target = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 4, 0], [0, 0, 1]]])
    found = knn(torch.tensor([[[3.0, 4, 0]]]), target, 4)
    assert found.idx[0, 0].tolist() == [2, 1, 0, 3]
    assert found.dist_sq[0, 0].tolist() == [9, 16, 25, 26]


@pytest.mark.usefixtures("path")
def test_each_point_is_its_own_nearest() -> None:
    # an expansion of the square fails this far from the origin
    points = cloud(2, 300, seed=3, dtype=torch.float32) + 100
    found = nearest(points, points)
    assert found.idx.shape == (2, 300)
    assert torch.equal(found.idx, torch.arange(300).expand(2, -1))
    assert bool((found.dist_sq == 0).all())


@pytest.mark.usefixtures("path")
def test_duplicates() -> None:
    target = torch.zeros(1, 6, 3)
    found = knn(target[:, :1], target, 6)
    assert sorted(found.idx[0, 0].tolist()) == list(range(6))
    assert bool((found.dist_sq == 0).all())


@pytest.mark.usefixtures("path")
def test_map_coordinates_keep_their_digits() -> None:
    place = torch.tensor([4.1e6, 5.3e6, 120.0], dtype=torch.float64)
    points = cloud(2, 60, seed=9)
    here, there = knn(points, points, 3), knn(points + place, points + place, 3)
    assert torch.equal(there.idx, here.idx)
    torch.testing.assert_close(there.dist_sq.sqrt(), here.dist_sq.sqrt(), atol=1e-8, rtol=0)


@pytest.mark.parametrize("dtype", [*DTYPES, torch.float16])
def test_every_float_on_a_gpu_takes_the_kernels(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tensor that only says that it is on a GPU."""
    calls: list[tuple[object, ...]] = []

    class Elsewhere(Tensor):
        device = torch.device("cuda")  # type: ignore[assignment]

    class Kernels(ModuleType):
        def knn(self, query: Tensor, target: Tensor, k: int) -> tuple[Tensor, Tensor]:
            calls.append((query.dtype, target.dtype, k))
            found = module._knn_tree(query.as_subclass(Tensor), target.as_subclass(Tensor), k)
            return found.dist_sq, found.idx

    monkeypatch.setattr("pnu.geometry.triton_kernels", Kernels("kernels"))
    points = cloud(1, 30, seed=3, dtype=dtype)
    elsewhere = points.as_subclass(Elsewhere)
    found = knn(elsewhere, elsewhere, 4)
    assert calls == [(torch.float32, torch.float32, 4)]
    assert found.dist_sq.dtype == dtype
    assert torch.equal(found.idx.as_subclass(Tensor), module._knn_tree(points, points, 4).idx)


def test_permuted_targets_give_the_same_neighbors() -> None:
    query, target = cloud(1, 40, seed=4), cloud(1, 70, seed=5)
    order = torch.randperm(70, generator=torch.Generator().manual_seed(6))
    before, after = knn(query, target, 8), knn(query, target[:, order], 8)
    assert torch.equal(before.dist_sq, after.dist_sq)
    assert torch.equal(before.idx, order[after.idx])


def test_many_clouds_and_one_cloud_take_the_same_path() -> None:
    query, target = cloud(5, 50, seed=7), cloud(5, 60, seed=8)
    together = knn(query, target, 3)
    for b in range(5):
        alone = knn(query[b : b + 1], target[b : b + 1], 3)
        assert torch.equal(alone.idx[0], together.idx[b])


def test_search_has_no_gradient() -> None:
    query = cloud(1, 4, seed=9).requires_grad_()
    assert not knn(query, query, 2).dist_sq.requires_grad
    assert not ball_query(query, query, 0.5, 2).requires_grad


@pytest.mark.usefixtures("path")
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("m", "n", "k", "radius"), [
    (9, 60, 4, 0.3), (9, 60, 32, 0.6), (5, 4, 8, 5.0), (7, 30, 3, 1e-6), (1, 1, 2, 1.0), (0, 5, 3, 1.0),
])  # fmt: skip
def test_ball_query(m: int, n: int, k: int, radius: float, dtype: torch.dtype) -> None:
    query, target = cloud(2, m, seed=10, dtype=dtype), cloud(2, n, seed=11, dtype=dtype)
    idx = ball_query(query, target, radius, k)
    assert idx.dtype == torch.int64
    assert idx.shape == (2, m, k)
    for b in range(2):
        expected = reference.ball_query(query[b].double().numpy(), target[b].double().numpy(), radius, k)
        np.testing.assert_array_equal(idx[b], expected)


@pytest.mark.usefixtures("path")
def test_ball_query_by_hand() -> None:
    target = torch.tensor([[[5.0, 0, 0], [1, 0, 0], [0, 0, 0], [2, 0, 0], [0.5, 0, 0]]])
    query = torch.tensor([[[0.0, 0, 0], [9, 9, 9]]])
    # storage order, not distance; a distance equal to the radius is outside; no target at all gives 0
    assert ball_query(query, target, 2.0, 4).tolist() == [[[1, 2, 4, 1], [0, 0, 0, 0]]]
    assert ball_query(query, target, 2.0, 2)[0, 0].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda q, t: knn(q, t, 8), "k: expected 1 to 7 neighbors (the number of target points), found 8"),
        (lambda q, t: knn(q, t, 0), "k: expected 1 to 7 neighbors (the number of target points), found 0"),
        (lambda q, t: knn(q[0], t, 1), r"query: expected points of shape (B, n, 3), found (5, 3)"),
        (lambda q, t: knn(q, t[..., :2], 1), r"target: expected points of shape (B, n, 3), found (2, 7, 2)"),
        (lambda q, t: knn(q, t[:1], 1), "target: expected 2 clouds, one for each of the query, found 1"),
        (lambda q, t: nearest(q, t[:, :0]), "target: expected at least one point, found none"),
        (lambda q, t: ball_query(q, t, 0.0, 4), "radius: expected a positive distance, found 0.0"),
        (lambda q, t: ball_query(q, t, 0.1, 0), "k: expected at least 1 neighbor, found 0"),
    ],
)
def test_bad_input(call, text: str) -> None:  # type: ignore[no-untyped-def]
    query, target = cloud(2, 5, seed=12), cloud(2, 7, seed=13)
    with pytest.raises(ValueError, match=r".") as error:
        call(query, target)
    assert str(error.value) == text


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("k", [1, 16, 100])
def test_gpu_finds_what_the_cpu_finds(k: int) -> None:
    query, target = cloud(3, 500, seed=14, dtype=torch.float32), cloud(3, 700, seed=15, dtype=torch.float32)
    cpu, gpu = knn(query, target, k), knn(query.cuda(), target.cuda(), k)
    assert torch.equal(cpu.idx, gpu.idx.cpu())
    torch.testing.assert_close(cpu.dist_sq, gpu.dist_sq.cpu())
    assert torch.equal(ball_query(query, target, 0.2, 32), ball_query(query.cuda(), target.cuda(), 0.2, 32).cpu())


def test_a_search_again_and_again() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(50, 3, generator=generator, dtype=torch.float64)
    search = Search(target)
    for m, k in ((1, 1), (30, 7), (4, 50)):
        query = torch.rand(m, 3, generator=generator, dtype=torch.float64)
        found, expected = search.knn(query, k), knn(query[None], target[None], k)
        torch.testing.assert_close(found.idx, expected.idx[0], rtol=0, atol=0)
        torch.testing.assert_close(found.dist_sq, expected.dist_sq[0], rtol=0, atol=0)
    with pytest.raises(ValueError, match="k: expected 1 to 50 neighbors"):
        search.knn(target, 51)
