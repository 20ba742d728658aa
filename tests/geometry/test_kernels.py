"""Triton kernels against their slow twins: on a GPU where there is one, in Triton's interpreter elsewhere."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from pnu.geometry import neighbor_search, sampling
from tests.ahead import machine_code_sizes

try:
    from pnu.geometry import triton_kernels
except ImportError as error:  # no Triton, or an old one
    pytest.skip(str(error), allow_module_level=True)

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
GENERATOR = torch.Generator().manual_seed(0)


def cloud(batch: int, n: int) -> Tensor:
    return torch.rand(batch, n, 3, generator=GENERATOR) - 0.5


def distances_sq(query: Tensor, target: Tensor) -> Tensor:
    return (query[:, :, None] - target[:, None]).square().sum(-1)


@pytest.mark.parametrize(
    ("m", "n", "k"), [(70, 150, 1), (5, 9, 3), pytest.param(18, 70, 5, marks=pytest.mark.slow), (3, 16, 16)]
)
def test_knn(m: int, n: int, k: int) -> None:
    query, target = cloud(2, m), cloud(2, n)
    dist_sq, idx = triton_kernels.knn(query.to(DEVICE), target.to(DEVICE), k)
    expected = distances_sq(query, target).topk(k, largest=False)
    torch.testing.assert_close(dist_sq.cpu(), expected.values)
    assert torch.equal(idx.cpu(), expected.indices)


def test_knn_takes_the_first_of_equal_points() -> None:
    target = torch.zeros(1, 4, 3)
    _, idx = triton_kernels.knn(target[:, :1].to(DEVICE), target.to(DEVICE), 3)
    assert idx.tolist() == [[[0, 1, 2]]]


@pytest.mark.parametrize("k", [2, pytest.param(9, marks=pytest.mark.slow)])
def test_knn_of_many_equal_distances(k: int) -> None:
    """Three places of fifty points each: more are as near as the k-th than a kernel has room for."""
    places = cloud(2, 3)
    target = places.repeat(1, 50, 1)
    dist_sq, idx = triton_kernels.knn(places.to(DEVICE), target.to(DEVICE), k)
    assert torch.equal(dist_sq.cpu(), torch.zeros(2, 3, k))
    assert torch.equal(idx.cpu(), (torch.arange(3)[:, None] + 3 * torch.arange(k)).expand(2, -1, -1))


@pytest.mark.slow
def test_knn_of_points_that_are_not_numbers() -> None:
    """They are the farthest of all, and have no neighbors before others."""
    target = cloud(1, 70)
    target[0, 5] = torch.nan
    dist_sq, idx = triton_kernels.knn(target.to(DEVICE), target.to(DEVICE), 4)
    good = torch.arange(70) != 5
    expected = distances_sq(target[:, good], target[:, good]).topk(4, largest=False)
    torch.testing.assert_close(dist_sq.cpu()[:, good], expected.values)
    assert torch.equal(idx.cpu()[:, good], torch.arange(70)[good][expected.indices])


@pytest.mark.parametrize("k", [1, 2])
def test_nearest_of_points_that_are_not_numbers(k: int) -> None:
    """What they get can be looked up: a training stops at them with words, not with a broken device."""
    query, target = cloud(1, 5), cloud(1, 150)
    query[0, 2] = torch.nan
    _, idx = triton_kernels.knn(query.to(DEVICE), target.to(DEVICE), k)
    good = torch.arange(5) != 2
    assert torch.equal(idx.cpu()[:, good], distances_sq(query[:, good], target).topk(k, largest=False).indices)
    assert ((idx >= 0) & (idx < 150)).all()


@pytest.mark.parametrize(("radius", "k"), [(0.05, 4), (0.2, 5), (2.0, 8)])
def test_ball_query(radius: float, k: int) -> None:
    query, target = cloud(2, 20), cloud(2, 200)
    idx = triton_kernels.ball_query(query.to(DEVICE), target.to(DEVICE), radius, k).cpu()
    inside = distances_sq(query, target).sqrt() < radius
    for b, i in torch.cartesian_prod(torch.arange(2), torch.arange(20)).tolist():
        found = inside[b, i].nonzero()[:k, 0].tolist()
        assert idx[b, i].tolist() == found + [found[0] if found else 0] * (k - len(found))


@pytest.mark.parametrize("skip", [False, True])
def test_farthest_points_of_a_cloud_with_duplicates(skip: bool) -> None:
    """Sixteen places of two points each, sixteen more points, and four that lie near the origin: as the CPU says."""
    places, near = cloud(1, 16)[0] + 2, 0.01 * cloud(1, 4)[0]
    points = torch.cat([places, near, places, cloud(1, 16)[0]])[None]
    idx = triton_kernels.farthest_points(
        points.to(DEVICE), 52, torch.tensor([2]).to(DEVICE), 1e-3 if skip else -1.0
    ).cpu()[0]
    steps = sampling._farthest_steps(points, 52, torch.tensor([2]), skip)[0]
    cpu = sampling.farthest_points(points, 52, start=2, skip_near_origin=skip)[0]
    able = torch.cat([torch.arange(16), torch.arange(20, 52)]) if skip else torch.arange(52)
    for found in (idx, steps, cpu):
        assert found[: len(able)].sort().values.tolist() == able.tolist()
        assert found[len(able) :].tolist() == [0] * (52 - len(able))


@pytest.mark.parametrize("skip_sq", [-1.0, 0.1])
def test_farthest_points(skip_sq: float) -> None:
    points, start = cloud(2, 90), torch.tensor([3, 5])
    idx = triton_kernels.farthest_points(points.to(DEVICE), 90, start.to(DEVICE), skip_sq).cpu()
    for b in range(2):
        distance = torch.where(points[b].square().sum(-1) > skip_sq, torch.inf, -1.0)
        chosen = [int(start[b])]
        for _ in range(89):
            distance = distance.minimum((points[b] - points[b, chosen[-1]]).square().sum(-1))
            chosen.append(int(distance.argmax()))
        assert idx[b].tolist() == chosen


def awkward(kind: str, batch: int, n: int) -> Tensor:
    """Clouds that kernels stumble over."""
    points = cloud(batch, n)
    if kind == "duplicates":
        return points[:, torch.arange(n) // 3]
    if kind == "one place":
        return points[:, :1].expand(-1, n, -1).contiguous()
    if kind == "far away":
        return points + 100
    return points.double() if kind == "float64" else points


KINDS = ["duplicates", "one place", "far away", "float64"]
BOUNDS = [(1, 1, 1), (65, 129, 1), (17, 65, 2), (3, 64, 64), (2, 127, 33)]


@pytest.mark.slow
@pytest.mark.parametrize(("m", "n", "k"), BOUNDS)
@pytest.mark.parametrize("kind", KINDS)
def test_knn_of_awkward_clouds(kind: str, m: int, n: int, k: int) -> None:
    """Sizes that are no multiple of a block, k at its bounds (1, n, `KERNEL_K`): the twin's distances and order."""
    query, target = awkward(kind, 1, m), awkward(kind, 1, n)
    dist_sq, idx = triton_kernels.knn(query.to(DEVICE), target.to(DEVICE), k)
    expected = distances_sq(query.float(), target.float())
    assert dist_sq.dtype == torch.float32
    torch.testing.assert_close(dist_sq.cpu(), expected.sort(dim=-1, stable=True).values[..., :k])
    torch.testing.assert_close(dist_sq.cpu(), expected.gather(-1, idx.cpu()))
    assert all(len(row.unique()) == k for row in idx.cpu().flatten(0, 1)), "a neighbor twice"
    tied = dist_sq.cpu().diff(dim=-1) == 0
    assert (idx.cpu().diff(dim=-1)[tied] > 0).all(), "of equal ones the lower index comes first"


@pytest.mark.slow
@pytest.mark.parametrize(("m", "n", "k"), [(1, 1, 1), (17, 127, 64), (5, 129, 3), (3, 40, 64)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("radius", [1e-3, 0.3, 10.0])
def test_balls_of_awkward_clouds(kind: str, m: int, n: int, k: int, radius: float) -> None:
    """Balls that hold nothing, some and everything; more places than points."""
    query, target = awkward(kind, 2, m), awkward(kind, 2, n)
    idx = triton_kernels.ball_query(query.to(DEVICE), target.to(DEVICE), radius, k).cpu()
    inside = distances_sq(query.float(), target.float()).sqrt() < radius
    for b in range(2):
        for i in range(m):
            found = inside[b, i].nonzero()[:k, 0].tolist()
            assert idx[b, i].tolist() == found + [found[0] if found else 0] * (k - len(found))


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m"), [(1, 1), (65, 65), (127, 1), (129, 40)])
@pytest.mark.parametrize("kind", KINDS)
def test_farthest_points_of_awkward_clouds(kind: str, n: int, m: int) -> None:
    """As the plain steps say, from the last point on; all different."""
    points, start = awkward(kind, 2, n), torch.tensor([n - 1, 0])
    idx = triton_kernels.farthest_points(points.to(DEVICE), m, start.to(DEVICE)).cpu()
    assert torch.equal(idx, sampling._farthest_steps(points.float(), m, start, False))
    assert all(len(row.unique()) == m for row in idx)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_searches_take_the_kernels(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """The doors that a GPU's clouds go through give what the CPU's trees give, in the query's dtype."""
    query, target = awkward(kind, 2, 19).to(DEVICE), awkward(kind, 2, 70).to(DEVICE)
    trees = neighbor_search.knn(query.cpu(), target.cpu(), 5)
    ball = neighbor_search.ball_query(query.cpu(), target.cpu(), 0.3, 5)
    kernel = neighbor_search._knn_kernel(triton_kernels, query, target, 5)
    assert kernel.dist_sq.dtype == query.dtype
    torch.testing.assert_close(
        kernel.dist_sq.cpu(), trees.dist_sq, rtol=1e-4, atol=2e-5 if kind == "far away" else 1e-7
    )
    assert torch.equal(triton_kernels.ball_query(query, target, 0.3, 5).cpu(), ball)


@pytest.mark.slow
@pytest.mark.parametrize("capability", [80, 90])
def test_kernels_compile_for_a_gpu_that_is_not_here(capability: int, tmp_path: Path) -> None:
    """Each kernel, in the sizes at its bounds, down to the machine code of an A100 and an H100."""
    sizes = machine_code_sizes(AHEAD, capability, tmp_path)
    assert len(sizes) == 9
    assert min(sizes) > 1000


AHEAD = """
from pnu.geometry import triton_kernels as kernels

for k in (1, 2):
    rows, columns = kernels.NEAREST_BLOCK
    compiled(kernels._nearest, [FLOAT, FLOAT, FLOAT, INDEX, "i32", "i32", "i32"], K=k, ROWS=rows, COLUMNS=columns)
for k in (4, 16, 64):
    columns, space = kernels.knn_columns(k)
    compiled(
        kernels._knn, [FLOAT, FLOAT, INDEX, FLOAT, INDEX, "i32", "i32", "i32"],
        K=k, ROWS=16, COLUMNS=columns, SPACE=space, SORTED=max(32, k),
    )
for k in (1, 64):
    compiled(kernels._ball, [FLOAT, FLOAT, INDEX, "i32", "i32", "i32", "fp32"], K=k, ROWS=16, COLUMNS=128)
for n in (1, kernels.FARTHEST_LIMIT):
    compiled(kernels._farthest, [FLOAT, INDEX, INDEX, "i32", "i32", "fp32"], kernels.farthest_warps(n), BLOCK=n)
"""
