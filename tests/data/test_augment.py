"""Augmentation: each part does what it says, to what it says, and nothing else."""

import pytest
import torch
from torch import Tensor

from pnu.data.augment import Augmentation

OFF = {"rotation": False, "scale": (1, 1), "shift": 0, "jitter_sigma": 0, "tilt_sigma": 0}


def sample() -> dict[str, Tensor]:
    points = torch.nn.functional.normalize(torch.randn(1, 200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    cloud = torch.cat([points, points], -1)  # a sphere: normals are the points
    return {"input": cloud[:, :50], "target": cloud, "edges": points[:, :7]}


def changed(seed: int = 1, **options: object) -> dict[str, Tensor]:
    return Augmentation(**(OFF | options))(sample(), torch.Generator().manual_seed(seed))


def test_everything_off_changes_nothing() -> None:
    for name, cloud in changed().items():
        assert torch.equal(cloud, sample()[name])


def test_rotation_turns_all_clouds_and_normals_alike() -> None:
    after = changed(rotation=True)
    rotation = torch.linalg.lstsq(sample()["target"][0, :, :3], after["target"][0, :, :3]).solution
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert not torch.allclose(rotation, torch.eye(3), atol=0.1)
    for name, cloud in sample().items():
        for part, turned in zip(cloud[0].split(3, -1), after[name][0].split(3, -1), strict=True):
            torch.testing.assert_close(turned, part @ rotation, atol=1e-5, rtol=0)


def test_scale_stays_in_its_range_and_leaves_normals() -> None:
    factors = []
    for seed in range(50):
        after = changed(seed, scale=(0.9, 1.1))
        radius = after["target"][0, :, :3].norm(dim=-1)
        factors.append(float(radius.mean()))
        torch.testing.assert_close(radius, radius.mean().expand(200))
        torch.testing.assert_close(after["input"][0, :, :3].norm(dim=-1), radius[:50])
        assert torch.equal(after["target"][..., 3:], sample()["target"][..., 3:])
    assert 0.9 <= min(factors) < 0.92
    assert 1.08 < max(factors) <= 1.1


def test_shift_is_one_offset_for_all() -> None:
    for seed in range(20):
        after = changed(seed, shift=0.1)
        offset = after["target"][0, 0, :3] - sample()["target"][0, 0, :3]
        assert float(offset.abs().max()) <= 0.1
        for name, cloud in sample().items():
            torch.testing.assert_close(after[name][..., :3], cloud[..., :3] + offset, atol=1e-6, rtol=0)


def test_jitter_moves_the_input_alone_half_of_the_time() -> None:
    moved = 0
    for seed in range(200):
        after = changed(seed, jitter_sigma=0.025)
        assert torch.equal(after["target"], sample()["target"])
        offset = after["input"][..., :3] - sample()["input"][..., :3]
        assert float(offset.abs().max()) <= 0.05 + 1e-6
        assert torch.equal(after["input"][..., 3:], sample()["input"][..., 3:])
        if offset.any():
            moved += 1
            assert 0.018 < float(offset.std()) < 0.03
    assert 70 < moved < 130


def test_small_rotation_turns_points_and_normals_of_the_input() -> None:
    turned = 0
    for seed in range(100):
        after = changed(seed, tilt_sigma=0.03)
        assert torch.equal(after["target"], sample()["target"])
        points, normals = after["input"][0].split(3, -1)
        torch.testing.assert_close(points, normals, atol=1e-6, rtol=0)
        angle = torch.acos((points * sample()["input"][0, :, :3]).sum(-1).clamp(-1, 1)).max()
        assert float(angle) < 3 * 0.09
        turned += bool(angle > 1e-3)
    assert 30 < turned < 70


def test_one_switch_does_not_change_the_other_parts() -> None:
    both = changed(rotation=True, shift=0.1)["target"][..., 3:]
    assert torch.equal(both, changed(rotation=True)["target"][..., 3:])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": (1.1, 0.9)}, "data.augmentation.scale: expected 0 < lowest <= highest"),
        ({"shift": -1}, "data.augmentation.shift: expected a number >= 0, found -1"),
        ({"input_probability": 2}, "data.augmentation.input_probability: expected 0 to 1, found 2"),
    ],
)
def test_bad_ranges(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Augmentation(**options)


def test_each_sample_of_a_batch_changes_in_its_own_way() -> None:
    one = sample()
    clouds = {name: cloud.repeat(8, 1, 1) for name, cloud in one.items()}
    after = Augmentation(shift=0)(clouds, torch.Generator().manual_seed(0))
    radius = after["target"][..., :3].norm(dim=-1)
    torch.testing.assert_close(radius, radius.mean(1, keepdim=True).expand(8, 200))  # scaled and turned
    assert len(radius.mean(1).unique()) == 8
    torch.testing.assert_close(after["target"][..., 3:], after["target"][..., :3] / radius[..., None])
    away = (after["input"] - after["target"][:, :50])[..., :3].norm(dim=-1).amax(1)
    assert 0 < int((away > 1e-6).sum()) < 8  # jitter and small rotations, of some inputs
