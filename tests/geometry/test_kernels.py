"""Triton kernels against their slow twins: on a GPU where there is one, in Triton's interpreter elsewhere."""

import pytest
import torch
from torch import Tensor

from pnu.geometry import sampling

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
