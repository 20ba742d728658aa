"""PCPNet against the layer table of its paper; its loss by hand; neighborhoods that it learns from."""

import functools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from pnu.data.normal_patches import NormalDataModule, NormalPatches
from pnu.losses import NormalLoss
from pnu.networks.pcpnet import PCPNet, rotation
from pnu.training.lightning_module import UpsamplingModule
from tests.reconstruction.test_surfaces import icosphere
from tests.training.test_lit import Record, trainer


def tiny() -> PCPNet:
    torch.manual_seed(0)
    return PCPNet((8, 16), 0.05)


def neighborhoods(batch: int = 1, queries: int = 6, k: int = 16) -> Tensor:
    return torch.rand(batch, queries, k, 3, generator=torch.Generator().manual_seed(1))


def widths(module: nn.Module) -> list[tuple[int, int]]:
    return [(layer.in_features, layer.out_features) for layer in module.modules() if isinstance(layer, nn.Linear)]


def test_layer_table() -> None:
    model = PCPNet((16, 48, 128), 1.0)
    assert widths(model.turn) == [(3, 64), (64, 128), (128, 1024), (1024, 512), (512, 256), (256, 4)]
    assert widths(model.entry) == [(3, 64), (64, 64)]
    assert widths(model.transform) == [(64, 64), (64, 128), (128, 1024), (1024, 512), (512, 256), (256, 64 * 64)]
    assert widths(model.each) == [(64, 64), (64, 128), (128, 1024)]
    assert widths(model.joined) == [(3 * 1024, 512), (512, 256)]
    assert widths(model.normal) == [(256, 3)]
    assert widths(PCPNet((64,), 1.0).joined)[0] == (1024, 512)


def test_rotation_by_hand() -> None:
    quarter = torch.tensor([[math.sqrt(0.5), 0, 0, math.sqrt(0.5)], [2.0, 0, 0, 0]])  # about z; none
    expected = torch.stack([torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), torch.eye(3)])
    torch.testing.assert_close(rotation(quarter), expected)


def test_normals_neither_see_place_and_size_nor_the_order_within_a_scale() -> None:
    model, near = tiny().eval(), neighborhoods()
    found = model(near)
    assert found.shape == (1, 6, 6)
    assert torch.equal(found[..., :3], near[:, :, 0])
    torch.testing.assert_close(model(5 * near + 3)[..., 3:], found[..., 3:], atol=1e-4, rtol=1e-3)
    order = [0, *np.random.default_rng(0).permutation(range(1, 8)), *reversed(range(8, 16))]
    torch.testing.assert_close(model(near[:, :, order])[..., 3:], found[..., 3:])


def test_arguments() -> None:
    for options, message in (
        ({"neighbors": (4,)}, "expected ascending numbers from 8 on"),
        ({"neighbors": (16, 8)}, "expected ascending numbers from 8 on"),
        ({"width": 0}, "model.width=0: expected a share above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            PCPNet(**options)
    with pytest.raises(ValueError, match="neighbors=12: expected at least 16"):
        tiny()(neighborhoods(k=12))
    with pytest.raises(ValueError, match=r"data.kinds=\['noisy'\]: expected some of clean"):
        NormalDataModule(kinds=["noisy"])
    with pytest.raises(ValueError, match="expected 2 to points=100 queries and neighbors"):
        NormalDataModule(points=100)


def test_loss_by_hand() -> None:
    true = torch.tensor([[[0.0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1]]])
    found = torch.tensor([[[0.0, 0, 0, 0, 0, -1], [1, 0, 0, 0, 1, 0]]])
    assert float(NormalLoss()(found, true)["loss"]) == pytest.approx((0 + 2) / 2)
    assert float(NormalLoss(oriented=True)(found, true)["normal"]) == pytest.approx((4 + 2) / 2)


def test_gradients() -> None:
    model = tiny().double().eval()
    near = neighborhoods(queries=2).double().requires_grad_()
    true = torch.nn.functional.normalize(torch.rand(1, 2, 6, dtype=torch.float64), dim=-1)
    assert torch.autograd.gradcheck(lambda x: NormalLoss(True)(model(x), true)["loss"], near, fast_mode=True)
    torch.autograd.gradcheck(rotation, torch.rand(2, 4, dtype=torch.float64, requires_grad=True))


def patches() -> NormalPatches:
    ball = icosphere(3)
    return NormalPatches({"ball": ball}, 4, kinds=["clean"], points=200, queries=6, neighbors=16, seed=0)


def test_neighborhoods_are_drawn_by_seed_epoch_and_index() -> None:
    item, same, other = patches()[0, 1], patches()[0, 1], patches()[1, 1]
    assert torch.equal(item["input"], same["input"])
    assert not torch.equal(item["input"], other["input"])
    assert torch.equal(item["input"][:, 0], item["target"][:, :3])
    far = (item["input"] - item["input"][:, :1]).norm(dim=-1)
    assert bool((far.diff(dim=1) >= 0).all())
    outward = (item["target"][:, :3] * item["target"][:, 3:]).sum(1)
    assert float(outward.min()) > 0.9


def lowers_the_error(network: torch.nn.Module, tmp_path: Path) -> None:
    """Twenty steps take a fifth off the loss of a network of normals, and its validation is recorded."""
    record = Record()
    lit = UpsamplingModule(network, NormalLoss(), functools.partial(torch.optim.Adam, lr=1e-2))
    items = [patches()[0, i] for i in range(4)]
    load = functools.partial(DataLoader, items, batch_size=2)
    trainer(tmp_path, record, max_steps=20, max_epochs=-1).fit(lit, load(), load())
    values = record.values("train/loss")
    assert values[-1] < 0.8 * values[0]
    assert record.values("val/normal_unsigned_deg")


def test_a_training_lowers_the_error(tmp_path: Path) -> None:
    lowers_the_error(tiny(), tmp_path)
