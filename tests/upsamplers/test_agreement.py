"""Where overlapping predictions agree: what moves, where to, and what stays."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

import pnu
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.upsamplers.agreement import agreed, most_agreed


def plates(number: int, noise: float, seed: int = 0) -> np.ndarray:
    """Points with normals of two parallel squares, 0.05 apart, whose normals look away from each other."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (number, 3))
    upper = rng.random(number) < 0.5
    points[:, 2] = np.where(upper, 0.05, 0) + noise * rng.standard_normal(number)
    normals = np.where(upper, 1.0, -1.0)[:, None] * [0, 0, 1] + 0.1 * rng.standard_normal((number, 3))
    return np.hstack([points, normals])


def test_errors_across_the_surface_cancel_and_its_two_sides_stay_apart() -> None:
    predicted = plates(20000, 0.004)
    chosen = predicted[::4]
    found = agreed(chosen, predicted)
    inside = np.abs(chosen[:, :2]).max(1) < 0.9
    truth = np.where(chosen[:, 5] > 0, 0.05, 0)

    def off(cloud: np.ndarray) -> float:
        return float(np.abs(cloud[:, 2] - truth)[inside].mean())

    assert off(found) < 0.3 * off(chosen)
    tilt = np.degrees(np.arccos(np.abs(found[inside, 5]).clip(max=1))).mean()
    assert tilt < 0.3 * np.degrees(np.arctan(0.1 * np.sqrt(np.pi / 2)))
    assert np.linalg.norm(found[:, :2] - chosen[:, :2], axis=1).mean() < 0.001  # along the surface they stay
    assert np.allclose(np.linalg.norm(found[:, 3:], axis=1), 1)


def test_motion_and_order_of_the_predictions_change_nothing() -> None:
    predicted = plates(500, 0.004)
    found = agreed(predicted[:50], predicted)
    shuffled = predicted[np.random.default_rng(1).permutation(500)]
    np.testing.assert_allclose(agreed(predicted[:50], shuffled), found, atol=1e-12)
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    moved = np.hstack([predicted[:, :3] @ turn + [1, 2, 3], predicted[:, 3:] @ turn])
    np.testing.assert_allclose(agreed(moved[:50], moved)[:, :3], found[:, :3] @ turn + [1, 2, 3], atol=1e-9)


def test_compiled_and_plain_rounds_are_the_same(monkeypatch: pytest.MonkeyPatch, compiled: None) -> None:
    predicted = plates(5000, 0.01)
    predicted[:20, 3:], predicted[20:40] = 0, predicted[40:60]  # without a direction, and at one place
    fast = agreed(predicted[:3000], predicted)
    monkeypatch.setattr("pnu.upsamplers.agreement.KEPT", 700)
    np.testing.assert_array_equal(agreed(predicted[:3000], predicted), fast)
    monkeypatch.setenv("PNU_FAST", "0")
    np.testing.assert_allclose(agreed(predicted[:3000], predicted), fast, atol=1e-9)


def test_farthest_points_off_the_surface_leave_no_crowds() -> None:
    """They lie apart off it, and close together once they are on it."""
    predicted = plates(20000, 0.02)

    def closest(cloud: np.ndarray) -> np.ndarray:
        return np.sort(cKDTree(cloud[:, :3]).query(cloud[:, :3], 2)[0][:, 1])[:20]

    chosen = predicted[farthest_points_large(predicted[:, :3], 2000)]
    found = most_agreed(predicted, 2000)
    assert found.shape == (2000, 6)
    assert closest(found).mean() > 2 * closest(agreed(chosen, predicted)).mean()


@pytest.mark.parametrize("lost", [0, np.nan, np.inf])
def test_predictions_without_a_direction_move_nothing(lost: float) -> None:
    predicted = plates(500, 0.004)
    predicted[:100, 3:] = lost
    found = agreed(predicted, predicted)
    assert np.isfinite(found).all()
    assert np.array_equal(found[:100, :3], predicted[:100, :3])
    assert (np.linalg.norm(found[100:, 3:], axis=1) > 0.999).all()
    predicted[:, 3:] = lost
    assert np.array_equal(agreed(predicted, predicted)[:, :3], predicted[:, :3])


class Drawn(nn.Module):
    """Four points around each, all of them too far along the patch's x axis."""

    ratio, patch_size = 4, 64

    def __init__(self) -> None:
        super().__init__()
        self.places = nn.Parameter(0.05 * torch.randn(4, 2, generator=torch.Generator().manual_seed(0)))

    def forward(self, patch: Tensor) -> Tensor:
        normals = nn.functional.normalize(patch[..., 3:], dim=-1)
        across = nn.functional.normalize(torch.linalg.cross(normals, normals.roll(1, -1)), dim=-1)
        axes = torch.stack([across, torch.linalg.cross(normals, across)], -2)  # (B, n, 2, 3)
        points = patch[:, :, None, :3] + self.places @ axes + torch.tensor([0.03, 0, 0])
        return torch.cat([points, normals[:, :, None].expand_as(points)], -1).flatten(1, 2)


def test_orientations_of_patches_take_away_what_a_network_does_in_one() -> None:
    unit = np.random.default_rng(0).normal(size=(600, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)

    def off(merge: str) -> float:
        dense = pnu.upsample(unit, unit, model=Drawn(), merge=merge)
        assert dense.shape == (2400, 6)
        return float(np.abs(np.linalg.norm(dense[:, :3], axis=1) - 1).mean())

    assert off("agreed") < 0.5 * off("farthest")
    one = pnu.upsample(unit, unit, model=Drawn(), merge="agreed")
    order = np.random.default_rng(1).permutation(600)
    np.testing.assert_allclose(pnu.upsample(unit[order], unit[order], model=Drawn(), merge="agreed"), one, atol=1e-6)


def test_another_merge_is_refused() -> None:
    with pytest.raises(ValueError, match="merge=mean: expected farthest or agreed"):
        pnu.upsample(plates(20, 0), merge="mean")


def test_what_has_no_patches_refuses_to_merge_them() -> None:
    with pytest.raises(ValueError, match="merge=agreed: .* has no patches that overlap; leave it out"):
        pnu.upsample(plates(50, 0), model="midpoint", merge="agreed")
