"""Where overlapping predictions agree: what moves, where to, and what stays."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

import pnu
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.upsamplers.agreement import agreeing_spheres, most_agreed, off_spheres
from pnu.upsamplers.context import Context


def plates(number: int, noise: float, seed: int = 0) -> np.ndarray:
    """Points with unit normals of two parallel squares, 0.05 apart, whose normals look away from each other."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (number, 3))
    upper = rng.random(number) < 0.5
    points[:, 2] = np.where(upper, 0.05, 0) + noise * rng.standard_normal(number)
    normals = np.where(upper, 1.0, -1.0)[:, None] * [0, 0, 1] + 0.1 * rng.standard_normal((number, 3))
    return np.hstack([points, normals / np.linalg.norm(normals, axis=1, keepdims=True)])


def ball(number: int, noise: float, seed: int = 0) -> np.ndarray:
    """Points around the unit sphere, with its normals."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((number, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.hstack([normals * (1 + noise * rng.standard_normal((number, 1))), normals])


def agreeing(predicted: np.ndarray, count: int) -> np.ndarray:
    return most_agreed(predicted, predicted[:: len(predicted) // 100], predicted[:0], count, Context(), "agreement")


def test_errors_across_the_surface_cancel_and_its_two_sides_stay_apart() -> None:
    predicted = plates(20000, 0.004)
    chosen, found = predicted[farthest_points_large(predicted[:, :3], 4000)], agreeing(predicted, 4000)

    def off(cloud: np.ndarray) -> float:
        inside = np.abs(cloud[:, :2]).max(1) < 0.9
        return float(np.abs(cloud[:, 2] - np.where(cloud[:, 5] > 0, 0.05, 0))[inside].mean())

    assert off(found) < 0.2 * off(chosen)
    inside = np.abs(found[:, :2]).max(1) < 0.9
    tilt = np.degrees(np.arccos(np.abs(found[inside, 5]).clip(max=1))).mean()
    assert tilt < 0.3 * np.degrees(np.arctan(0.1 * np.sqrt(np.pi / 2)))
    assert np.allclose(np.linalg.norm(found[:, 3:], axis=1), 1)


def test_a_bent_surface_is_not_flattened() -> None:
    """144 of 4000 points reach a fifth of the radius: their mean lies a hundredth inside, the sphere they fit not."""
    found = agreeing(ball(4000, 0), 1000)
    assert np.abs(np.linalg.norm(found[:, :3], axis=1) - 1).max() < 1e-6
    assert np.abs((found[:, 3:] * found[:, :3]).sum(1) - 1).max() < 1e-6
    noisy = np.linalg.norm(agreeing(ball(20000, 0.01), 1000)[:, :3], axis=1)
    assert abs(noisy.mean() - 1) < 0.0005


def test_motion_and_scale_and_order_of_the_predictions_change_nothing() -> None:
    predicted = ball(2000, 0.01)
    some = predicted[:50]
    found = agreeing_spheres(None, predicted)(some)
    shuffled = predicted[np.random.default_rng(1).permutation(2000)]
    np.testing.assert_allclose(agreeing_spheres(None, shuffled)(some), found, atol=1e-12)
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]

    def moved(cloud: np.ndarray) -> np.ndarray:
        return np.hstack([3 * cloud[:, :3] @ turn + [1, 2, 3], cloud[:, 3:6] @ turn])

    np.testing.assert_allclose(agreeing_spheres(None, moved(predicted))(moved(some))[:, :6], moved(found), atol=1e-6)


def test_compiled_and_plain_rounds_are_the_same(monkeypatch: pytest.MonkeyPatch, compiled: None) -> None:
    predicted = plates(5000, 0.01)
    predicted[20:40] = predicted[40:60]  # at one place
    fast = agreeing(predicted, 2000)
    monkeypatch.setattr("pnu.upsamplers.surface_projection.KEPT", 700)
    np.testing.assert_array_equal(agreeing(predicted, 2000), fast)
    monkeypatch.setenv("PNU_FAST", "0")
    np.testing.assert_allclose(agreeing(predicted, 2000), fast, atol=1e-6)


def test_farthest_points_off_the_surface_leave_no_crowds() -> None:
    """They lie apart off it, and close together once they are on it."""
    predicted = plates(20000, 0.02)

    def closest(cloud: np.ndarray) -> np.ndarray:
        return np.sort(cKDTree(cloud[:, :3]).query(cloud[:, :3], 2)[0][:, 1])[:20]

    chosen = predicted[farthest_points_large(predicted[:, :3], 2000)]
    chosen[:, 2] = np.where(chosen[:, 5] > 0, 0.05, 0)
    found = agreeing(predicted, 2000)
    assert found.shape == (2000, 6)
    assert closest(found).mean() > 2 * closest(chosen).mean()


def test_a_point_of_the_cloud_without_any_near_gets_one() -> None:
    """The predictions leave a gap around one of the cloud's points, wider than the spacing of these."""
    cloud = ball(600, 0)
    apart = np.linalg.norm(ball(20000, 0)[:, :3] - cloud[0, :3], axis=1)
    predicted = ball(20000, 0)[apart > 0.12]

    def bare(points: np.ndarray) -> float:
        return float(np.linalg.norm(points[:, :3] - cloud[0, :3], axis=1).min())

    spacing = np.sort(np.linalg.norm(cloud[:, :3] - cloud[0, :3], axis=1))[1:7].mean()
    assert bare(predicted) > 0.5 * spacing
    found = most_agreed(predicted, cloud, cloud[:0], 2400, Context(), "agreement")
    assert bare(found) < 0.5 * spacing
    assert np.abs(np.linalg.norm(found[:, :3], axis=1) - 1).max() < 1e-3


def test_what_lies_off_the_cloud_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Predictions agree on a bump beside the sphere that the cloud knows nothing of."""
    cloud, predicted = ball(1000, 0), ball(20000, 0.002)
    bump = np.arccos(predicted[:, 2].clip(-1, 1)) < 0.06
    predicted[bump, :3] *= 1.08
    off = off_spheres(np.array([[0, 0, 1.08, 0, 0, 1.0], [0, 0, -1.0, 0, 0, -1.0]]), cloud, Context())
    spacing = np.sort(np.linalg.norm(cloud[:, None, :3] - cloud[None, :, :3], axis=2), 1)[:, 1:7].mean()
    assert off[0] == pytest.approx(0.08 / spacing, rel=0.2)
    assert off[1] < 1e-3
    found = most_agreed(predicted, cloud, cloud[:0], 4000, Context(), "agreement")
    assert found.shape == (4000, 6)
    monkeypatch.setattr("pnu.upsamplers.agreement.REJECTED", 0.0)
    with_all = most_agreed(predicted, cloud, cloud[:0], 4000, Context(), "agreement")
    left, before = ((np.linalg.norm(each[:, :3], axis=1) > 1.04).sum() for each in (found, with_all))
    assert left < 0.5 * before


class Shifted(nn.Module):
    """Four points around each, all of a patch too far out or in, by another distance in each patch."""

    ratio, patch_size = 4, 64

    def __init__(self, columns: int = 6, length: float = 1.0) -> None:
        super().__init__()
        self.columns, self.length = columns, length
        self.places = nn.Parameter(0.05 * torch.randn(4, 2, generator=torch.Generator().manual_seed(0)))

    def forward(self, patch: Tensor) -> Tensor:
        normals = nn.functional.normalize(patch[..., 3:], dim=-1)
        across = nn.functional.normalize(torch.linalg.cross(normals, normals.roll(1, -1)), dim=-1)
        axes = torch.stack([across, torch.linalg.cross(normals, across)], -2)  # (B, n, 2, 3)
        off = 0.05 * (1000 * patch[:, :1, None, :1]).sin()
        points = patch[:, :, None, :3] + self.places @ axes + off * normals[:, :, None]
        found = torch.cat([points, self.length * normals[:, :, None].expand_as(points)], -1)
        return found[..., : self.columns].flatten(1, 2)


def test_sides_that_a_network_does_not_learn_are_those_of_the_input() -> None:
    class Unsided(Shifted):
        def forward(self, patch: Tensor) -> Tensor:
            found = super().forward(patch)
            side = (1e4 * found[..., :1]).sin().sign()
            return torch.cat([found[..., :3], side * found[..., 3:]], -1)

    unit = ball(600, 0)
    found, sided = (pnu.upsample(unit[:, :3], unit[:, 3:], model=m, merge="agreed") for m in (Unsided(), Shifted()))
    np.testing.assert_allclose(found, sided, atol=1e-9)
    assert ((found[:, 3:] * found[:, :3]).sum(1) > 0).all()


@pytest.mark.parametrize("columns", [6, 3])
def test_what_differs_from_patch_to_patch_goes(columns: int) -> None:
    unit = ball(600, 0)

    def merged(merge: str) -> np.ndarray:
        dense = pnu.upsample(unit[:, :3], unit[:, 3:], model=Shifted(columns), merge=merge)
        assert dense.shape == (2400, 6)
        return dense

    def off(cloud: np.ndarray) -> float:
        return float(np.abs(np.linalg.norm(cloud[:, :3], axis=1) - 1).mean())

    one = merged("agreed")
    assert off(one) < 0.6 * off(merged("farthest"))
    order = np.random.default_rng(1).permutation(600)
    again = pnu.upsample(unit[order, :3], unit[order, 3:], model=Shifted(columns), merge="agreed")
    np.testing.assert_allclose(again, one, atol=1e-6)


@pytest.mark.parametrize("columns", [6, 3])
@pytest.mark.parametrize("merge", ["farthest", "agreed"])
@pytest.mark.parametrize("ratio", [1, 3, 16])
def test_points_that_are_kept_come_first_and_others_between(merge: str, columns: int, ratio: int) -> None:
    unit = ball(300, 0)
    dense = pnu.upsample(unit[:, :3], unit[:, 3:], model=Shifted(columns), merge=merge, keep=True, ratio=ratio)
    assert dense.shape == (300 * ratio, 6)
    np.testing.assert_array_equal(dense[:300, :3], unit[:, :3])
    np.testing.assert_allclose(dense[:300, 3:], unit[:, 3:], atol=1e-12)
    if ratio > 1:
        apart = cKDTree(unit[:, :3]).query(dense[300:, :3])[0]
        new = pnu.upsample(unit[:, :3], unit[:, 3:], model=Shifted(columns), merge=merge, ratio=ratio)
        assert np.quantile(apart, 0.01) > 1.5 * np.quantile(cKDTree(unit[:, :3]).query(new[:, :3])[0], 0.01)


def test_parts_of_each_pass_are_kept_and_taken_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unit, options = ball(300, 0), {"model": Shifted(), "merge": "agreed", "ratio": 16}
    whole = pnu.upsample(unit[:, :3], unit[:, 3:], **options)
    np.testing.assert_array_equal(pnu.upsample(unit[:, :3], unit[:, 3:], parts=tmp_path, **options), whole)
    # apart, lest as many points of another pass be taken for them
    assert len({path.parent for path in tmp_path.rglob("agreement 1*")}) == 2
    monkeypatch.setattr(Shifted, "forward", None)
    np.testing.assert_array_equal(pnu.upsample(unit[:, :3], unit[:, 3:], parts=tmp_path, **options), whole)


@pytest.mark.parametrize("length", [0, np.nan, np.inf])
def test_predictions_without_a_direction_have_that_of_the_input(length: float) -> None:
    unit = ball(600, 0)
    lost = pnu.upsample(unit[:, :3], unit[:, 3:], model=Shifted(length=length), merge="agreed")
    assert np.isfinite(lost).all()
    assert ((lost[:, 3:] * lost[:, :3]).sum(1) > 0.9).all()


def test_another_merge_is_refused() -> None:
    with pytest.raises(ValueError, match="merge=mean: expected farthest or agreed"):
        pnu.upsample(plates(20, 0), merge="mean")


def test_what_has_no_patches_refuses_to_merge_them() -> None:
    with pytest.raises(ValueError, match="merge=agreed: .* has no patches that overlap; leave it out"):
        pnu.upsample(plates(50, 0), model="midpoint", merge="agreed")
