"""Weighted sums of rows and their gradient."""

import pytest
import torch

from pnu.fast.combine import combine


@pytest.mark.parametrize(("q", "k"), [(50, 1), (50, 3), (1, 4)])
@pytest.mark.parametrize("weighted", [False, True])
def test_equals_gathered_sums(q: int, k: int, weighted: bool) -> None:
    torch.manual_seed(0)
    features = torch.randn(20, 7, requires_grad=True)
    idx = torch.randint(0, 15, (q, k))  # rows 15 to 19 are never taken
    weight = torch.rand(q, k) if weighted else None
    found = combine(features, idx, weight)
    rows = features[idx]
    expected = (rows if weight is None else rows * weight[..., None]).sum(1)
    torch.testing.assert_close(found, expected)
    gradient = torch.randn_like(found)
    (of_found,) = torch.autograd.grad(found, features, gradient)
    (of_expected,) = torch.autograd.grad(expected, features, gradient)
    torch.testing.assert_close(of_found, of_expected)
    assert of_found[15:].abs().max() == 0


def test_float64_gradient() -> None:
    features, idx = torch.randn(6, 2, dtype=torch.float64, requires_grad=True), torch.randint(0, 6, (5, 3))
    weight = torch.rand(5, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda f: combine(f, idx, weight), features)


def test_gradient_is_repeatable() -> None:
    features, idx = torch.randn(30, 16, requires_grad=True), torch.randint(0, 30, (5000, 1))
    gradient = torch.randn(5000, 16)
    first, second = (torch.autograd.grad(combine(features, idx), features, gradient)[0] for _ in range(2))
    assert torch.equal(first, second)
