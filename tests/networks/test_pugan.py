"""PU-GAN's networks against the layer table of its paper, and its loss against values by hand."""

import math

import pytest
import torch
from torch import Tensor, nn

from pnu import networks
from pnu.losses import AdversarialLoss
from pnu.losses.adversarial import unevenness
from pnu.networks.pugan import (
    DenseBlock,
    DenseFeatures,
    Discriminator,
    Down,
    SelfAttention,
    Up,
    feature_neighbors,
    plane_grid,
)


def generator(ratio: int = 4) -> nn.Module:
    torch.manual_seed(0)
    return networks.build_network({"_target_": "pnu.networks.pugan.PUGAN", "ratio": ratio})


def sphere(batch: int, n: int, seed: int = 0) -> Tensor:
    return nn.functional.normalize(torch.randn(batch, n, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)


def widths(module: nn.Module) -> list[tuple[int, int]]:
    return [(layer.in_features, layer.out_features) for layer in module.modules() if isinstance(layer, nn.Linear)]


def test_layer_table() -> None:
    """Channels of the paper and of 3PU's feature extraction: 480 features, 128 in the expansion, r + 2 copies."""
    model = generator()
    assert widths(model.features.entry) == [(3, 24)]
    assert [widths(block) for block in model.features.blocks] == [
        [(48, 24), (48, 24), (72, 24)], *[[(96, 24), (72, 24), (96, 24)]] * 3,
    ]  # fmt: skip
    assert widths(model.features.reductions) == [(120, 48), (240, 48), (360, 48)]
    assert widths(model.expansion.entry) == [(480, 128)]
    attention = [(130, 32), (130, 32), (130, 130)]
    assert widths(model.expansion.up) == widths(model.expansion.up_error) == [*attention, (130, 256), (256, 128)]
    assert widths(model.expansion.down) == [(6 * 128, 256), (256, 128)]
    assert widths(model.regression) == [(128, 64), (64, 3)]
    assert widths(Discriminator()) == [
        (3, 32), (32, 64), (128, 32), (128, 32), (128, 128), (128, 128), (128, 256), (256, 256), (256, 64), (64, 1),
    ]  # fmt: skip
    with torch.no_grad():
        points = sphere(2, 64)
        assert DenseFeatures()(points).shape == (2, 64, 480)
        assert DenseBlock(48)(torch.rand(2, 20, 48)).shape == (2, 20, 120)
        assert model.expansion(torch.rand(2, 10, 480)).shape == (2, 60, 128)
        assert Discriminator()(points).shape == (2,)
    assert 0.5e6 < sum(p.numel() for p in model.parameters()) < 0.75e6


@pytest.mark.parametrize("ratio", [2, 4, 5])
def test_shapes(ratio: int) -> None:
    model = generator(ratio)
    with torch.no_grad():
        outputs = model.outputs(torch.cat([sphere(2, 64), sphere(2, 64)], -1))
    assert outputs["prediction"].shape == (2, ratio * 64, 3)
    with pytest.raises(ValueError, match="patch: expected"):
        model(sphere(1, 30))
    with pytest.raises(ValueError, match="model.ratio: expected a whole number from 2 on, got 1"):
        generator(1)


def test_copies_lie_beside_a_grid_and_are_put_side_by_side_again() -> None:
    grid = torch.tensor([[-0.2, -0.2], [-0.2, 0], [-0.2, 0.2], [0.2, -0.2], [0.2, 0], [0.2, 0.2]])
    torch.testing.assert_close(plane_grid(6), grid)
    assert plane_grid(5).shape == (5, 2)
    up, down = Up(3, 8), Down(3, 8)
    seen: list[Tensor] = []
    up.attention.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    down.mlp.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    x = torch.rand(1, 4, 8)
    up(x)
    torch.testing.assert_close(seen[0][0, 4 + 1], torch.cat([x[0, 1], plane_grid(3)[1]]))  # copy 1 of point 1
    copies = torch.rand(1, 12, 8)
    down(copies)
    torch.testing.assert_close(seen[1][0, 2], torch.cat([copies[0, 2], copies[0, 6], copies[0, 10]]))


def test_attention_by_hand() -> None:
    attention = SelfAttention(4)
    x = torch.tensor([[[1.0, 0, 0, 0], [0, 0, 0, 1]]])
    assert torch.equal(attention(x), x)  # gamma is 0 at first
    nn.init.ones_(attention.gamma)
    for layer in (attention.f[0], attention.g[0], attention.h[0]):
        nn.init.zeros_(layer.bias)
    nn.init.eye_(attention.h[0].weight)
    for layer in (attention.f[0], attention.g[0]):  # both read the first channel
        with torch.no_grad():
            layer.weight.copy_(torch.tensor([[1.0, 0, 0, 0]]))
    a = math.e / (math.e + 1)
    expected = torch.tensor([[[1 + a, 0, 0, 1 - a], [0.5, 0, 0, 1.5]]])
    torch.testing.assert_close(attention(x), expected)


def test_neighbors_in_feature_space() -> None:
    x = torch.tensor([[[0.0], [1.0], [3.0]]])
    assert feature_neighbors(x, 1).flatten().tolist() == [1, 0, 1]


def test_unevenness_by_hand() -> None:
    """Four points; a share of 0.25 has radius 0.5 and expects one. Two are 0.3 apart, the others alone."""
    points = torch.tensor([[[0.0, 0, 0], [0.3, 0, 0], [5, 0, 0], [0, 5, 0]]], dtype=torch.float64)
    lattice = math.sqrt(2 * math.pi * 0.25 / (2 * math.sqrt(3)))
    pair = (2 - 1) ** 2 / 1 * 2 * (0.3 - lattice) ** 2 / lattice
    assert float(unevenness(points, 4, [0.25])) == pytest.approx((2 * pair + 0 + 0) / 4)
    assert float(unevenness(points, 4, [0.01])) == 0  # each alone in its disk


def test_unevenness_sees_clusters() -> None:
    turns = torch.arange(1024) * 2.39996
    radius = ((torch.arange(1024) + 0.5) / 1024).sqrt()
    even = torch.stack([radius * turns.cos(), radius * turns.sin(), torch.zeros(1024)], 1)[None]
    clustered = even.clone()
    clustered[:, :512] *= 0.5
    assert float(unevenness(even)) < 0.3 * float(unevenness(clustered))


def constant(loss: AdversarialLoss, value: float) -> None:
    """The discriminator says the same of all."""
    last = loss.discriminator.judge[-1]
    nn.init.zeros_(last.weight)
    nn.init.constant_(last.bias, value)


def test_terms_and_weights() -> None:
    loss, points = AdversarialLoss(), sphere(2, 128)
    constant(loss, 0.4)
    terms = {name: float(value.detach()) for name, value in loss(points, points).items()}
    assert terms["adversarial"] == pytest.approx(0.6**2 / 2)
    assert terms["emd"] == pytest.approx(0, abs=1e-6)
    assert terms["loss"] == pytest.approx(
        0.5 * terms["adversarial"] + 10 * terms["uniform"] + 100 * terms["emd"] + terms["repulsion"]
    )
    assert float(loss.verdict(points, points).detach()) == pytest.approx((0.4**2 + 0.6**2) / 2)
    chamfer = AdversarialLoss("chamfer")(points, points)
    assert float(chamfer["cd"]) == 0
    assert "emd" not in chamfer
    with pytest.raises(ValueError, match="loss.point_term: expected emd or chamfer, found 'x'"):
        AdversarialLoss("x")  # type: ignore[arg-type]


def test_gradients() -> None:
    torch.manual_seed(0)
    points = sphere(1, 48).double().requires_grad_()
    target = sphere(1, 48, 1).double()
    loss = AdversarialLoss(seeds=8).double()
    assert torch.autograd.gradcheck(lambda p: loss(p, target)["loss"], points, fast_mode=True)
    assert torch.autograd.gradcheck(lambda p: unevenness(p, 8, [0.2]), points, fast_mode=True)
    prediction = points.detach().requires_grad_()
    loss.verdict(prediction, target).backward()
    assert prediction.grad is None  # the discriminator's step does not reach the generator
    assert all(p.grad is not None for p in loss.discriminator.parameters())
    block = DenseBlock(3).double()
    assert torch.autograd.gradcheck(
        block, torch.rand(1, 20, 3, dtype=torch.float64, requires_grad=True), fast_mode=True
    )
    attention = SelfAttention(8).double()
    nn.init.ones_(attention.gamma)
    assert torch.autograd.gradcheck(
        attention, torch.rand(1, 5, 8, dtype=torch.float64, requires_grad=True), fast_mode=True
    )
