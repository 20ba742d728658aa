"""Gathering and interpolation, values and gradients."""

import numpy as np
import pytest
import torch
from torch import Tensor

from pnu.geometry.neighbor_features import gather, interpolate
from tests import reference


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("shape", [(2,), (2, 5), (2, 5, 3), (2, 1, 2, 4), (2, 0, 3)])
def test_gather(shape: tuple[int, ...]) -> None:
    features = random(2, 7, 4)
    idx = torch.randint(7, shape, generator=torch.Generator().manual_seed(1))
    out = gather(features, idx)
    assert out.shape == (*shape, 4)
    for place in np.ndindex(shape):
        assert torch.equal(out[place], features[place[0], idx[place]])


def test_gather_of_a_transposed_tensor() -> None:
    features = random(2, 4, 7).transpose(1, 2)
    idx = torch.tensor([[0, 6], [3, 3]])
    assert torch.equal(gather(features, idx), gather(features.contiguous(), idx))


def test_gradient_of_gather_adds_up() -> None:
    features = random(2, 5, 3).requires_grad_()
    idx = torch.tensor([[[0, 0], [4, 0]], [[1, 2], [2, 2]]])
    gather(features, idx).sum().backward()
    assert features.grad is not None
    assert features.grad[..., 0].tolist() == [[3, 0, 0, 0, 1], [0, 1, 3, 0, 0]]
    assert torch.autograd.gradcheck(lambda f: gather(f, idx), features)


def test_interpolate() -> None:
    features, points, query = random(2, 9, 4), random(2, 9, 3, seed=1), random(2, 6, 3, seed=2)
    for k in (1, 3, 9):
        out = interpolate(features, points, query, k)
        for b in range(2):
            expected = reference.interpolate(features[b].numpy(), points[b].numpy(), query[b].numpy(), k)
            np.testing.assert_allclose(out[b], expected, rtol=1e-9)


def test_interpolate_by_hand() -> None:
    points = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [50, 0, 0]]])
    features = torch.tensor([[[0.0], [9], [7]]])
    # at distances 1 and 2 the weights are 2/3 and 1/3
    assert interpolate(features, points, torch.tensor([[[1.0, 0, 0]]]), k=2).item() == pytest.approx(3)
    assert interpolate(features, points, points).flatten().tolist() == pytest.approx([0, 9, 7], abs=1e-5)


def test_interpolate_with_fewer_points_than_neighbors() -> None:
    assert interpolate(torch.ones(1, 1, 2), torch.zeros(1, 1, 3), random(1, 4, 3).float()).tolist() == [[[1, 1]] * 4]


def test_interpolate_keeps_constants_and_has_a_gradient() -> None:
    points, query = random(1, 8, 3), random(1, 5, 3, seed=3)
    torch.testing.assert_close(
        interpolate(torch.full((1, 8, 2), 2.5, dtype=torch.float64), points, query),
        torch.full((1, 5, 2), 2.5, dtype=torch.float64),
    )
    features = random(1, 8, 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: interpolate(f, points, query), features)


def test_bad_indices() -> None:
    with pytest.raises(ValueError, match=r"idx: expected features \(B, n, C\) and indices \(B, \.\.\.\), found"):
        gather(random(2, 5, 3), torch.zeros(3, 4, dtype=torch.int64))
