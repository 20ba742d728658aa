"""Nesti-Net: Fisher vectors by hand, the layer table of its paper, its loss by hand, what it does not see."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from pnu.benchmark import normal_task
from pnu.losses import NormalLoss
from pnu.networks.fisher_vectors import fisher_vectors, grid_centers, normalized_vectors
from pnu.networks.nestinet import Halving, NestiNet, local_means
from tests.networks.test_pcpnet import lowers_the_error, neighborhoods
from tests.reconstruction.test_surfaces import icosphere


def tiny(**options: object) -> NestiNet:
    torch.manual_seed(0)
    return NestiNet(**{"neighbors": (8, 16), "grid": 2, "experts": 3, "width": 0.04} | options)  # type: ignore[arg-type]


def vectors(points: list[list[float]], size: int) -> Tensor:
    return fisher_vectors(torch.tensor([points], dtype=torch.float64), size)[0]


def test_a_point_under_one_gaussian_by_hand() -> None:
    """w = 1, s = 1: the share is 1, the weight's gradient 0, the mean's p, the deviation's (p^2 - 1) / sqrt(2)."""
    root = math.sqrt(2)
    mean, deviation = [0.5, 0, -1], [-0.75 / root, -1 / root, 0]
    expected = torch.tensor([[0, 0, *3 * mean, *3 * deviation]], dtype=torch.float64)
    torch.testing.assert_close(vectors([[0.5, 0, -1]], 1), expected)


def test_two_points_under_one_gaussian_by_hand() -> None:
    root = math.sqrt(2)
    expected = [0, 0, 0.5, 0, 0, 1, 0, 0, 0, 0, 0, -0.5 / root, -1 / root, -1 / root]
    expected += [0, -1 / root, -1 / root, -1 / root, -1 / root, -1 / root]
    found = vectors([[0, 0, 0], [1, 0, 0]], 1)
    torch.testing.assert_close(found, torch.tensor([expected], dtype=torch.float64))


def test_a_point_between_eight_gaussians_by_hand() -> None:
    """w = 1/8, s = 1/2, means at -1/2 and 1/2. At x = 1/4 the densities of both halves have the ratio e."""
    assert grid_centers(2)[[0, 1, 4]].tolist() == [[-0.5, -0.5, -0.5], [-0.5, -0.5, 0.5], [0.5, -0.5, -0.5]]
    found = vectors([[0.25, 0, 0]], 2)
    near = math.e / (1 + math.e) / 4  # share of each of four; apart by -1/2 deviations in x, by 1 in y and z
    root = math.sqrt(8)
    expected = [(near - 1 / 8) * root] * 2 + [near * -0.5 * root, near * root, near * root] * 3
    expected += [near * -0.75 * 2, 0, 0] * 3
    torch.testing.assert_close(found[4], torch.tensor(expected, dtype=torch.float64))


def test_invariances_of_fisher_vectors() -> None:
    cloud = torch.rand(2, 7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    found = fisher_vectors(cloud, 3)
    assert found.shape == (2, 27, 20)
    torch.testing.assert_close(fisher_vectors(cloud[:, [3, 1, 6, 0, 2, 5, 4]], 3), found)
    torch.testing.assert_close(fisher_vectors(torch.cat([cloud, cloud], 1), 3), found)
    mirrored = fisher_vectors(cloud * torch.tensor([-1, 1, 1]), 3).unflatten(1, (3, 3, 3)).flip(1).flatten(1, 3)
    sign = torch.ones(20, dtype=torch.float64)
    sign[[2, 5, 8]] = -1
    order = list(range(20))
    order[5], order[8] = 8, 5  # a maximum along x becomes the minimum
    torch.testing.assert_close(mirrored, (found * sign)[..., order])
    rooted = normalized_vectors(found)
    torch.testing.assert_close(rooted.norm(dim=1), torch.ones(2, 20, dtype=torch.float64))
    assert torch.equal(rooted.sign(), found.sign())
    assert torch.equal(normalized_vectors(torch.zeros(1, 8, 20)), torch.zeros(1, 8, 20))


def test_layer_table() -> None:
    """At the paper's sizes, without memory for its weights."""
    with torch.device("meta"):
        model = NestiNet((128, 256, 512), grid=8, experts=7, width=1.0)
    assert model.scales_of == [(0,), (0,), (1,), (1,), (2,), (2,), (0, 1, 2)]

    def convolutions(module: nn.Module) -> list[tuple[int, int, int]]:
        layers = [layer for layer in module.modules() if isinstance(layer, nn.Conv3d)]
        return [(layer.in_channels, layer.out_channels, layer.kernel_size[0]) for layer in layers]

    def widths(module: nn.Module) -> list[tuple[int, int]]:
        return [(layer.in_features, layer.out_features) for layer in module.modules() if isinstance(layer, nn.Linear)]

    def expected(*modules: tuple[int, int, int]) -> list[tuple[int, int, int]]:
        return [(channels, channels // 2, kernel) for channels, *kernels in modules for kernel in kernels]

    first = [(128, 3, 5), (256, 3, 5)]
    last = [(512, 2, 4), (512, 2, 4), (512, 1, 2)]
    assert convolutions(model.gate) == expected(*first, (256, 3, 5), *last)
    inputs = [(60, 128), (384, 256), (768, 256), (768, 512), (1536, 512), (1536, 512)]
    assert widths(model.gate) == [
        *(pair for pair in inputs for _ in range(2)), (1536, 1024), (1024, 256), (256, 128), (128, 7),
    ]  # fmt: skip
    assert convolutions(model.experts[0]) == expected(*first, (256, 2, 4), (512, 2, 4))
    inputs = [(20, 128), (384, 256), (768, 256), (768, 512)]
    assert widths(model.experts[5]) == [
        *(pair for pair in inputs for _ in range(2)), (1536, 512), (512, 128), (128, 64), (64, 3),
    ]  # fmt: skip
    joint = widths(model.experts[6])
    assert joint[:4] == [(60, 42), (60, 42), (126, 256), (126, 256)]  # a third of 128: channels come in pairs
    assert joint[4:] == widths(model.experts[5])[4:]


def test_pooling_by_hand() -> None:
    line = torch.arange(3.0)[None, :, None, None, None].expand(1, 3, 3, 3, 1)
    assert local_means(line, 3)[0, :, 0, 0, 0].tolist() == pytest.approx([0.5, 1, 1.5])
    assert local_means(line, 2)[0, :, 1, 1, 0].tolist() == pytest.approx([0.5, 1.5, 2])
    assert Halving(3)(line)[0, :, 0, 0, 0].tolist() == [1, 2]
    assert Halving(2)(line)[0, :, 0, 0, 0].tolist() == [1, 2]
    assert Halving(2)(line[:, :1, :1, :1]).shape == (1, 1, 1, 1, 1)


@pytest.mark.parametrize("grid", [2, 3, 5])
def test_normals_neither_see_place_and_size_nor_the_order_within_a_scale(grid: int) -> None:
    model, near = tiny(grid=grid).eval(), neighborhoods()
    found = model(near)
    assert found.shape == (1, 6, 6)
    assert torch.equal(found[..., :3], near[:, :, 0])
    torch.testing.assert_close(found[..., 3:].norm(dim=-1), torch.ones(1, 6))
    torch.testing.assert_close(model(5 * near + 3)[..., 3:], found[..., 3:], atol=1e-3, rtol=1e-3)
    order = [0, *np.random.default_rng(0).permutation(range(1, 8)), *reversed(range(8, 16))]
    torch.testing.assert_close(model(near[:, :, order])[..., 3:], found[..., 3:], atol=1e-4, rtol=1e-3)


def test_the_expert_of_the_largest_share_speaks() -> None:
    model, near = tiny().eval(), neighborhoods(2)
    found = model.outputs(near)
    assert found["expert_normals"].shape == (2, 6, 3, 3)
    torch.testing.assert_close(found["shares"].sum(-1), torch.ones(2, 6))
    best = found["shares"].argmax(-1)
    expected = nn.functional.normalize(
        found["expert_normals"].gather(2, best[..., None, None].expand(2, 6, 1, 3)), dim=-1
    )
    torch.testing.assert_close(found["prediction"][..., 3:], expected[:, :, 0])
    torch.testing.assert_close(model(near), found["prediction"])


def test_loss_by_hand() -> None:
    """Of two experts one is right but for the sign and the length, one is off by 30 degrees: 3/4 0 + 1/4 2 sin 30."""
    true = torch.tensor([[[0.0, 0, 0, 0, 0, 1]]])
    experts = torch.tensor([[[[0.0, 0, -2], [0.5, 0, math.sqrt(0.75)]]]])
    extra = {"expert_normals": experts, "shares": torch.tensor([[[0.75, 0.25]]])}
    assert float(NormalLoss()(true, true, extra)["loss"]) == pytest.approx(0.25)
    apart_sq = 0.25 + (1 - math.sqrt(0.75)) ** 2
    assert float(NormalLoss(oriented=True)(true, true, extra)["normal"]) == pytest.approx(0.75 * 4 + 0.25 * apart_sq)


def test_gradients() -> None:
    cloud = torch.rand(1, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) * 1.4 - 0.7
    assert torch.autograd.gradcheck(lambda x: fisher_vectors(x, 2), cloud.requires_grad_())
    model, near = tiny().double().eval(), neighborhoods(queries=2).double()
    true = nn.functional.normalize(torch.rand(1, 2, 6, dtype=torch.float64), dim=-1)

    def loss(x: Tensor) -> Tensor:
        found = model.outputs(x)
        value: Tensor = NormalLoss()(found["prediction"], true, found)["loss"]
        return value

    assert torch.autograd.gradcheck(loss, near.requires_grad_(), fast_mode=True)
    loss(near).backward()
    assert all(parameter.grad is not None and bool(parameter.grad.any()) for parameter in model.gate[2].parameters())


def test_arguments() -> None:
    for options, message in (
        ({"neighbors": (4,)}, "model.neighbors=.4.: expected ascending numbers from 8 on"),
        ({"grid": 9}, "model.grid=9: expected 2 to 8"),
        ({"experts": 0}, "model.experts=0: expected 1 or more"),
        ({"width": 2}, "model.width=2: expected a share above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            tiny(**options)
    with pytest.raises(ValueError, match="neighbors=12: expected at least 16"):
        tiny()(neighborhoods(k=12))
    assert tiny(experts=1).scales_of == [(0, 1)]


@pytest.mark.slow
def test_a_training_lowers_the_error(tmp_path: Path) -> None:
    lowers_the_error(tiny(width=0.06), tmp_path)


def test_as_a_row_of_the_task() -> None:
    points = icosphere(2).vertices
    found = normal_task.network_estimator(tiny().eval(), "tiny", at_once=100)(points)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-6)
