"""The rivals' networks and losses: shapes, invariances, hand-computed values, one training step."""

import math

import pytest
import torch
from torch import Tensor, nn

from pnu import networks
from pnu.losses import EdgeAwareLoss, ParameterizationLoss, PyramidLoss, RepulsionLoss
from pnu.losses.rivals import surface_distance_sq, unsigned_sq
from pnu.networks.densepcr import DensePCR

NETWORKS = {"punet.PUNet": 3, "ecnet.ECNet": 3, "pugeo.PUGeo": 6}


def network(name: str, ratio: int = 4) -> nn.Module:
    torch.manual_seed(0)
    return networks.build_network({"_target_": f"pnu.networks.{name}", "ratio": ratio})


def patch(batch: int = 2, n: int = 128) -> Tensor:
    directions = torch.randn(batch, n, 3, generator=torch.Generator().manual_seed(1))
    directions = nn.functional.normalize(directions, dim=-1)
    return torch.cat([directions, directions], -1)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("ratio", [2, 4, 5])
def test_shapes(name: str, ratio: int) -> None:
    model = network(name, ratio)
    outputs = model.outputs(patch(n=64))
    assert outputs["prediction"].shape == (2, ratio * 64, NETWORKS[name])
    assert model.predicts_normals == (NETWORKS[name] == 6)
    if name == "ecnet.ECNet":
        assert outputs["edge_distance"].shape == (2, ratio * 64)


@pytest.mark.parametrize("name", NETWORKS)
def test_reads_points_alone(name: str) -> None:
    model = network(name).eval()
    points = patch()
    assert torch.equal(model(points), model(points[..., :3]))


@pytest.mark.parametrize("name", NETWORKS)
def test_bad_patches_and_ratios(name: str) -> None:
    with pytest.raises(ValueError, match="patch: expected"):
        network(name)(patch(n=30))
    with pytest.raises(ValueError, match="model.ratio: expected a whole number from 2 on, got 1"):
        network(name, 1)


def test_pugeo_does_not_depend_on_the_order_of_points() -> None:
    model, points = network("pugeo.PUGeo").eval(), patch(1)
    order = torch.randperm(128, generator=torch.Generator().manual_seed(0))
    one = model(points).unflatten(1, (128, 4))[:, order]
    torch.testing.assert_close(model(points[:, order]).unflatten(1, (128, 4)), one, atol=1e-5, rtol=1e-4)


def test_ecnet_adds_offsets_to_its_input() -> None:
    """With offsets of zero the output is the input, copied."""
    model, points = network("ecnet.ECNet"), patch()
    for parameter in model.offset[-1].parameters():
        nn.init.zeros_(parameter)
    assert torch.equal(model(points), points[..., :3].repeat(1, 4, 1))


def test_pugeo_maps_2d_samples_to_the_tangent_plane() -> None:
    """Without displacement, new points lie in the plane through the point that T spans."""
    model, points = network("pugeo.PUGeo"), patch()
    for parameter in model.refinement[-1].parameters():
        nn.init.zeros_(parameter)
    nn.init.zeros_(model.tangent[-1].weight)
    with torch.no_grad():
        model.tangent[-1].bias.copy_(torch.eye(3).flatten())
    outputs = model.outputs(points)
    offsets = outputs["prediction"][..., :3].unflatten(1, (128, 4)) - points[:, :, None, :3]
    torch.testing.assert_close(offsets[..., 2], torch.zeros(2, 128, 4), atol=1e-6, rtol=0)
    assert float(offsets[..., :2].detach().abs().mean()) > 0.01
    torch.testing.assert_close(outputs["coarse_normal"], torch.tensor([0.0, 0, 1]).expand(2, 128, 3))
    torch.testing.assert_close(outputs["prediction"][..., 3:], torch.tensor([0.0, 0, 1]).expand(2, 512, 3))


def test_repulsion_by_hand() -> None:
    """Three points in a row, one neighbor each: distances 0.1, 0.1 and 0.2; h is meant for 4096 points."""
    points = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]]], dtype=torch.float64)
    terms = RepulsionLoss(w_repulsion=0.5, h=0.02 * 3 / 4096, k=1)(points, points)
    expected = -(2 * 0.1 * math.exp(-0.01 / 0.02) + 0.2 * math.exp(-0.04 / 0.02)) / 3
    assert float(terms["repulsion"]) == pytest.approx(expected)
    assert float(terms["cd"]) == 0
    assert float(terms["loss"]) == pytest.approx(0.5 * expected)


def test_repulsion_with_emd() -> None:
    points = patch()[..., :3]
    assert float(RepulsionLoss("emd")(points, points)["emd"]) < 1e-6
    with pytest.raises(ValueError, match="loss.point_term: expected chamfer or emd, got 'x'"):
        RepulsionLoss("x")  # type: ignore[arg-type]


def test_surface_distance_by_hand() -> None:
    """A grid of spacing 0.1 in the plane z = 0: height counts, and what lies more than a spacing beyond the border."""
    axis = torch.arange(5, dtype=torch.float64) / 10
    grid = torch.cartesian_prod(axis, axis)
    target = torch.cat([grid, torch.zeros(25, 3), torch.ones(25, 1)], 1)[None]
    points = torch.tensor([[[0.2, 0.2, 0.05], [0.24, 0.2, -0.02], [0.7, 0.2, 0.0]]], dtype=torch.float64)
    nearest = torch.tensor([[12, 12, 22]])
    expected = torch.tensor([[0.05**2, 0.02**2, (0.3 - 0.1) ** 2]], dtype=torch.float64)
    torch.testing.assert_close(surface_distance_sq(points, target, nearest), expected)


def edge_case() -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    target = patch(1, 256).double()
    prediction = (target[:, ::2, :3] * 1.01).requires_grad_()
    edges = torch.tensor([[[0.0, 0, 1.0], [math.nan] * 3]], dtype=torch.float64)
    distance = torch.full((1, 128), 0.05, dtype=torch.float64, requires_grad=True)
    return prediction, target, {"edges": edges, "edge_distance": distance}


def test_edge_terms_by_hand() -> None:
    prediction, target, extra = edge_case()
    terms = EdgeAwareLoss(near=0.15, reach=0.5)(prediction.detach(), target, extra)
    true = (prediction[0].detach() - torch.tensor([0.0, 0, 1])).norm(dim=-1)
    assert float(terms["edge"]) == pytest.approx(float(true[true < 0.5].square().mean()))
    assert float(terms["edge_distance"].detach()) == pytest.approx(float((true.clamp(max=0.5) - 0.05).square().mean()))
    assert float(terms["surface"]) == pytest.approx(0.01**2, rel=0.05)


def test_repulsion_of_edge_aware_loss_by_hand() -> None:
    """A square of side 0.1 with h = 0.12 for four points: both neighbors are within, the diagonal is not."""
    corners = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]]], dtype=torch.float64)
    cloud = torch.cat([corners, torch.tensor([0.0, 0, 1]).expand(1, 4, 3)], -1)
    extra = {"edges": torch.full((1, 1, 3), math.nan).double(), "edge_distance": torch.ones(1, 4).double()}
    terms = EdgeAwareLoss(h=0.12 / 32, k=3)(corners, cloud, extra)
    assert float(terms["repulsion"]) == pytest.approx(2 / 3 * (0.12**2 - 0.1**2))


def test_patch_without_edges_has_no_edge_term() -> None:
    prediction, target, extra = edge_case()
    terms = EdgeAwareLoss()(prediction, target, extra | {"edges": torch.full((1, 2, 3), math.nan).double()})
    assert float(terms["edge"].detach()) == 0
    assert math.isfinite(float(terms["loss"].detach()))


def test_losses_say_what_they_need() -> None:
    points = patch()
    with pytest.raises(ValueError, match="EdgeAwareLoss needs edges in the data"):
        EdgeAwareLoss()(points, points, {})
    with pytest.raises(ValueError, match="ParameterizationLoss needs a network that gives coarse_normal"):
        ParameterizationLoss()(points, points, {})


def test_normals_count_without_sign() -> None:
    a, b = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0])
    assert [float(unsigned_sq(a, x)) for x in (a, -a, b)] == [0, 0, 2]
    cloud = patch()
    flipped = torch.cat([cloud[..., :3], -cloud[..., 3:]], -1)
    terms = ParameterizationLoss()(flipped, cloud, {"input": cloud, "coarse_normal": -cloud[..., 3:]})
    assert float(terms["loss"]) == pytest.approx(0, abs=1e-9)


def test_gradients() -> None:
    prediction, target, extra = edge_case()
    parts = (prediction, extra["edge_distance"])
    assert torch.autograd.gradcheck(
        lambda p, d: EdgeAwareLoss()(p, target, extra | {"edge_distance": d})["loss"], parts, fast_mode=True
    )
    assert torch.autograd.gradcheck(lambda p: RepulsionLoss()(p, target)["loss"], prediction, fast_mode=True)


@pytest.mark.parametrize(
    ("name", "loss"),
    [("punet.PUNet", RepulsionLoss()), ("ecnet.ECNet", EdgeAwareLoss()), ("pugeo.PUGeo", ParameterizationLoss())],
)
def test_training_steps_lower_the_loss(name: str, loss: nn.Module) -> None:
    model = network(name)
    optimizer = torch.optim.Adam(model.parameters(), 1e-3)
    batch = {"input": patch(), "edges": torch.full((2, 4, 3), math.nan)}
    values = []
    for _ in range(8):
        outputs = model.outputs(batch["input"])
        value = loss(outputs["prediction"], patch(n=512), {**batch, **outputs})["loss"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        values.append(float(value.detach()))
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in model.parameters())
    assert values[-1] < 0.9 * values[0]


def stages() -> DensePCR:
    torch.manual_seed(0)
    return DensePCR()


def test_densepcr_against_its_layer_table() -> None:
    model = stages()
    widths = [[m for m in stage.modules() if isinstance(m, nn.Linear)] for stage in model.stages]
    found = [[(layer.in_features, layer.out_features) for layer in layers] for layers in widths]
    assert (
        found
        == [[(3, 32), (32, 64), (64, 64), (3, 32), (32, 32), (32, 64), (133, 64), (64, 128), (128, 128), (128, 3)]] * 2
    )
    outputs = model.outputs(patch(n=64))
    assert (outputs["coarse"].shape, outputs["prediction"].shape) == ((2, 256, 3), (2, 1024, 3))
    assert "coarse" not in DensePCR(4).outputs(patch(n=64))
    with pytest.raises(ValueError, match="model.ratio: expected 4 or 16, one or two stages, got 8"):
        DensePCR(8)
    with pytest.raises(ValueError, match="patch: expected"):
        model(patch(n=30))


def test_densepcr_sees_point_cloud_neighborhood_and_grid() -> None:
    stage, seen = stages().stages[0], []
    stage.dense.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    points = patch(1, 64)[..., :3]
    stage(points)
    (rows,) = seen
    assert torch.equal(rows[0, 4 * 7 + 2, :3], points[0, 7])
    assert torch.equal(rows[0, 0, 3:67], rows[0, -1, 3:67])  # the cloud's feature is that of all
    grid = torch.tensor([[-0.1, -0.1], [-0.1, 0.1], [0.1, -0.1], [0.1, 0.1]])
    torch.testing.assert_close(rows[0, 28:32, -2:], grid)


def test_pyramid_loss_by_hand() -> None:
    target = torch.zeros(1, 2, 3, dtype=torch.float64)
    moved = target + torch.tensor([0.0, 0, 1])
    terms = PyramidLoss(w_coarse=0.5)(moved, target, {"coarse": target + torch.tensor([0.0, 0, 2])})
    assert {name: float(value) for name, value in terms.items()} == {"cd": 2, "cd_coarse": 8, "loss": 6}
    assert float(PyramidLoss()(moved, target)["loss"]) == 2
    dense = patch(1, 32)[..., :3].double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p: PyramidLoss()(p, patch(1, 16).double(), {"coarse": p[:, :8]})["loss"], dense, fast_mode=True
    )
