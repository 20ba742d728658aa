"""Loss terms: the released values, hand-computed clouds, SciPy, gradients, options."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from pnu.fast import accelerate, terms
from pnu.geometry.assignment import assign
from pnu.geometry.neighbor_features import gather
from pnu.losses import compound as losses
from pnu.losses.compound import CompoundLoss, Matches, search

TERMS = ("cd", "point_knn", "normal", "normal_orth", "normal_knn")


def clouds(clouds: int, m: int, n: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    prediction = torch.randn(clouds, m, 6, generator=generator, dtype=dtype)
    return prediction, torch.randn(clouds, n, 6, generator=generator, dtype=dtype)


@pytest.fixture(scope="session")
def released(shared: Path) -> dict[str, np.ndarray]:
    return dict(np.load(shared / "reference/released_reference.npz"))


def test_released_values(released: dict[str, np.ndarray]) -> None:
    prediction, target = (torch.from_numpy(released[f"loss_{name}"]) for name in ("prediction", "target"))
    expected = {name: float(released[name]) for name in TERMS[1:]}
    expected["cd"] = float(released["chamfer_target_to_pred"] + released["chamfer_pred_to_target"])
    expected["loss"] = float(released["total"])
    found = CompoundLoss()(prediction, target)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name].item() == pytest.approx(value, rel=1e-6), name


def test_exact_ties_differ_from_released_at_one_point(released: dict[str, np.ndarray]) -> None:
    prediction, target = (torch.from_numpy(released[f"loss_{name}"]) for name in ("prediction", "target"))
    rounded, exact = search(prediction, target, 15), search(prediction, target, 15, released_rounding=False)
    differ = rounded.nearest_prediction != exact.nearest_prediction
    assert differ.sum() == 1
    distance_sq = [
        (target[..., :3] - gather(prediction[..., :3], m.nearest_prediction)).double().square().sum(-1)[differ]
        for m in (rounded, exact)
    ]
    assert 0 < distance_sq[0] - distance_sq[1] < 1e-7
    found = CompoundLoss(near_ties="exact")(prediction, target)["normal"].item()
    assert found == pytest.approx(float(released["normal"]), rel=1e-4)


def test_by_hand() -> None:
    """Three predictions on a line, two targets above it."""
    prediction = torch.tensor([[[0.0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 2], [3, 0, 0, 1, 0, 0]]])
    target = torch.tensor([[[0.0, 0, 1, 0, 0, 1], [3, 0, 2, 0, 0, 1]]])
    found = CompoundLoss(k=1, w1=1, w2=10, w3=100, w4=1000, w5=10000)(prediction, target)
    expected = {
        "cd": (1 + 2 + 4) / 3 + (1 + 4) / 2,
        "point_knn": (1 + 1 + 4) / 3,
        "normal": (0 + 2) / 2,  # (0 0 1) to (0 0 1), and (0 0 1) to (1 0 0)
        "normal_orth": (0 + 0 + 1) / 3,  # only the third normal lies along the line
        "normal_knn": (1 + 1 + 5) / 3,
    }
    for name, value in expected.items():
        assert found[name].item() == pytest.approx(value), name
    weighted = sum(value * 10**i for i, value in enumerate(expected.values()))
    assert found["loss"].item() == pytest.approx(weighted)
    summed = CompoundLoss(k=1, reduction="sum")(prediction, target)
    assert [summed[name].item() for name in TERMS] == pytest.approx([7 + 5, 6, 2, 1, 7])
    other = CompoundLoss(k=1, normal_pairs="prediction", orth="signed", point_knn_in="target")(prediction, target)
    assert other["normal"].item() == pytest.approx((0 + 1 + 2) / 3)
    assert other["normal_orth"].item() == pytest.approx((0 + 0 + 1) / 3)
    assert other["point_knn"].item() == pytest.approx((1 + 2 + 4) / 3)
    swapped = prediction.clone()
    swapped[0, 2, 3] = -1
    assert CompoundLoss(k=1, orth="signed")(swapped, target)["normal_orth"].item() == pytest.approx(-1 / 3)
    unit = CompoundLoss(k=1, unit_normals=True)(prediction, target)
    assert unit["normal_knn"].item() == pytest.approx((0 + 0 + 2) / 3)
    assert CompoundLoss(k=1, point_term="emd")(target, target)["emd"].item() == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_against_scipy(reduction: str) -> None:
    prediction, target = clouds(3, 70, 90)
    k = 6
    expected: dict[str, list[float]] = {name: [] for name in TERMS}
    total = np.mean if reduction == "mean" else np.sum
    for p, t in zip(prediction.numpy(), target.numpy(), strict=True):
        to_target, _ = cKDTree(t[:, :3]).query(p[:, :3])
        to_prediction, nearest = cKDTree(p[:, :3]).query(t[:, :3])
        distance, idx = cKDTree(p[:, :3]).query(p[:, :3], k + 1)
        offset = p[:, None, :3] - p[idx[:, 1:], :3]
        normals = np.broadcast_to(p[:, None, 3:], offset.shape)
        cosine = (offset * normals).sum(-1) / np.linalg.norm(offset, axis=-1) / np.linalg.norm(normals, axis=-1)
        expected["cd"].append(total(to_target**2) + total(to_prediction**2))
        expected["point_knn"].append(total(distance[:, 1:] ** 2))
        expected["normal"].append(total(((t[:, 3:] - p[nearest, 3:]) ** 2).sum(-1)))
        expected["normal_orth"].append(total(np.abs(cosine)))
        expected["normal_knn"].append(total(((normals - p[idx[:, 1:], 3:]) ** 2).sum(-1)))
    found = CompoundLoss(k=k, reduction=reduction)(prediction, target)  # type: ignore[arg-type]
    for name in TERMS:
        assert found[name].item() == pytest.approx(np.mean(expected[name])), name


def around(prediction: Tensor, matches: Matches) -> Tensor:
    return gather(prediction, matches.neighbors)


@pytest.mark.parametrize(
    "term",
    [
        lambda p, t, m: losses.chamfer(p, t, m),
        lambda p, t, m: losses.point_knn(p, around(p, m), "sum"),
        lambda p, t, m: losses.normal(p, t, m),
        lambda p, t, m: losses.normal(p, t, m, "sum", "prediction"),
        lambda p, t, m: losses.normal_orth(p, around(p, m)),
        lambda p, t, m: losses.normal_orth(p, around(p, m), "mean", False),
        lambda p, t, m: losses.normal_knn(p, around(p, m)),
    ],
)
def test_gradients(term: Callable[[Tensor, Tensor, Matches], Tensor]) -> None:
    """Of each term, with the neighbors held."""
    prediction, target = clouds(2, 12, 9)
    matches = search(prediction, target, 4)
    assert torch.autograd.gradcheck(lambda p: term(p, target, matches), prediction.requires_grad_())


@pytest.mark.parametrize("absolute", [True, False])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_fast_loss_equals_the_plain_one(
    monkeypatch: pytest.MonkeyPatch,
    absolute: bool,
    reduction: Literal["mean", "sum"],
    dtype: torch.dtype,
    tolerance: float,
) -> None:
    """Values and gradients of the three neighborhood terms in one pass, also of degenerate points."""
    monkeypatch.setattr(terms, "PIECE", 20)
    prediction, _ = clouds(3, 50, 1)
    prediction[0, 1, :3] = prediction[0, 0, :3]
    prediction[1, 2, 3:] = 0
    prediction = prediction.to(dtype).requires_grad_()
    idx = search(prediction, prediction, 6).neighbors
    loss = CompoundLoss(reduction=reduction, orth="absolute" if absolute else "signed")
    expected = loss.neighborhood_terms(prediction, idx)
    found = accelerate(copy.deepcopy(loss)).neighborhood_terms(prediction, idx)
    assert list(found) == list(expected) == ["point_knn", "normal_orth", "normal_knn"]
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=tolerance, atol=tolerance)
        (of_found,) = torch.autograd.grad(found[name], prediction, retain_graph=True)
        (of_expected,) = torch.autograd.grad(value, prediction, retain_graph=True)
        torch.testing.assert_close(of_found, of_expected, rtol=tolerance, atol=tolerance)


def test_gradient_of_the_whole_loss() -> None:
    prediction, target = clouds(2, 20, 30)
    prediction.requires_grad_()
    loss = CompoundLoss(k=3, w4=0.1, w5=0.2)
    (whole,) = torch.autograd.grad(loss(prediction, target)["loss"], prediction)
    terms = loss(prediction, target)
    parts = [w * torch.autograd.grad(terms[name], prediction, retain_graph=True)[0] for name, w in loss.weights.items()]
    torch.testing.assert_close(whole, sum(parts))


def test_coincident_points_and_zero_normals() -> None:
    prediction = torch.zeros(1, 30, 6, requires_grad=True)
    terms = CompoundLoss()(prediction, torch.ones(1, 40, 6))
    terms["loss"].backward()
    assert terms["normal_orth"].item() == 0
    assert prediction.grad is not None
    assert prediction.grad.isfinite().all()


def test_weight_zero_is_reported_and_not_followed() -> None:
    prediction, target = clouds(1, 20, 20)
    prediction.requires_grad_()
    terms = CompoundLoss(w1=0, w2=0, w4=0, w5=0, k=4)(prediction, target)
    assert terms["loss"].item() == pytest.approx(0.05 * terms["normal"].item())
    assert all(terms[name] > 0 for name in TERMS)
    terms["loss"].backward()
    assert prediction.grad is not None
    assert prediction.grad[..., :3].abs().max() == 0
    nothing = CompoundLoss(0, 0, 0, 0, 0, k=4)(prediction, target)["loss"]
    nothing.backward()
    assert nothing.item() == 0


def test_points_alone() -> None:
    prediction, target = clouds(2, 30, 30)
    found, whole = CompoundLoss()(prediction[..., :3], target), CompoundLoss()(prediction, target)
    assert set(found) == {"cd", "point_knn", "loss"}
    assert found["cd"] == whole["cd"]
    assert found["loss"].item() == pytest.approx(whole["cd"].item() + 0.1 * whole["point_knn"].item())


def test_order_and_position_do_not_matter() -> None:
    prediction, target = clouds(2, 40, 50)
    before = CompoundLoss()(prediction, target)
    shift = torch.tensor([3.0, -2, 5, 0, 0, 0], dtype=torch.float64)
    after = CompoundLoss()(prediction[:, torch.randperm(40)] + shift, target[:, torch.randperm(50)] + shift)
    for name, value in before.items():
        assert after[name].item() == pytest.approx(value.item()), name


@pytest.mark.parametrize(
    ("n", "spread", "excess"), [(1, 1.0, 1e-6), (2, 1.0, 0.05), (300, 0.02, 0.05), (300, 10.0, 0.12)]
)
def test_assignment_is_nearly_shortest(n: int, spread: float, excess: float) -> None:
    generator = torch.Generator().manual_seed(0)
    source = torch.rand(2, n, 3, generator=generator)
    target = (source + spread * torch.randn(2, n, 3, generator=generator))[:, torch.randperm(n, generator=generator)]
    idx = assign(source, target)
    assert torch.equal(idx.sort(-1).values, torch.arange(n).expand(2, -1))
    for a, b, i in zip(source, target, idx, strict=True):
        distances = cdist(a.numpy(), b.numpy())
        least = distances[linear_sum_assignment(distances)].mean()
        assert least * (1 - 1e-6) <= (a - b[i]).norm(dim=-1).mean() <= least * (1 + excess)


def test_emd_of_a_permutation_is_zero() -> None:
    points = torch.rand(1, 200, 3, requires_grad=True)
    value = losses.emd(points, points.detach()[:, torch.randperm(200)])
    assert value.item() < 1e-6
    value.backward()
    assert points.grad is not None
    assert points.grad.isfinite().all()


def test_emd_replaces_chamfer() -> None:
    prediction, target = clouds(2, 30, 30)
    found = CompoundLoss(point_term="emd", w1=2, w2=0, w3=0, w4=0, w5=0)(prediction, target)
    assert found["loss"].item() == pytest.approx(2 * found["emd"].item())
    assert found["cd"] == CompoundLoss()(prediction, target)["cd"]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"reduction": "max"}, "loss.reduction: expected one of mean, sum, found 'max'"),
        ({"point_term": "cd"}, "loss.point_term: expected one of chamfer, emd, found 'cd'"),
        ({"point_knn_in": "truth"}, "loss.point_knn_in: expected one of prediction, target"),
        ({"normal_pairs": 3}, "loss.normal_pairs: expected one of target, prediction, found 3"),
        ({"orth": "none"}, "loss.orth: expected one of absolute, signed"),
        ({"near_ties": ""}, "loss.near_ties: expected one of released, exact"),
        ({"k": 0}, "loss.k: expected at least 1 neighbor, found 0"),
    ],
)
def test_bad_options(options: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        CompoundLoss(**options)  # type: ignore[arg-type]


def test_bad_clouds() -> None:
    with pytest.raises(ValueError, match=r"loss.k: expected 1 to 9 \(predicted points - 1\), found 15"):
        CompoundLoss()(*clouds(1, 10, 40))
    with pytest.raises(ValueError, match=r"emd: expected two batches of clouds of equal size, .* \(1, 20, 3\) and"):
        CompoundLoss(point_term="emd")(*clouds(1, 20, 40))
