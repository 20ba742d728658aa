"""The unit sphere frame."""

import pytest
import torch
from torch import Tensor

from pnu.geometry.unit_sphere import unit_sphere_frame

BOTH = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def cloud(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def test_by_hand() -> None:
    frame = unit_sphere_frame(torch.tensor([[[0.0, 0, 0], [4, 0, 0], [2, 0, 0], [2, 0, 0]]]))
    assert frame.center.tolist() == [[[2, 0, 0]]]
    assert frame.scale.tolist() == [[[2]]]
    assert frame.to_unit(torch.tensor([[[4.0, 2, 0, 0, 1, 0]]])).tolist() == [[[1, 1, 0, 0, 1, 0]]]


@BOTH
def test_unit_and_back(dtype: torch.dtype) -> None:
    points = cloud(3, 50, 6, dtype=dtype) * 7 + 30
    frame = unit_sphere_frame(points)
    unit = frame.to_unit(points)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    assert unit[..., :3].mean(1).abs().max() < tolerance
    torch.testing.assert_close(unit[..., :3].norm(dim=-1).amax(1), torch.ones(3, dtype=dtype))
    assert torch.equal(unit[..., 3:], points[..., 3:])
    torch.testing.assert_close(frame.from_unit(unit), points)
    torch.testing.assert_close(frame.from_unit(frame.to_unit(points[..., :3])), points[..., :3])


def test_each_cloud_has_its_own_frame_and_the_frame_moves_along() -> None:
    points = cloud(2, 20, 3)
    one, two = unit_sphere_frame(points), unit_sphere_frame(points * 3 + 5)
    torch.testing.assert_close(two.center, one.center * 3 + 5)
    torch.testing.assert_close(two.scale, one.scale * 3)
    torch.testing.assert_close(two.to_unit(points * 3 + 5), one.to_unit(points))
    torch.testing.assert_close(unit_sphere_frame(points[1:]).center[0], one.center[1])


@BOTH
@pytest.mark.parametrize("value", [0.0, 0.1, 1e6, float("nan"), float("inf")])
def test_clouds_without_extent(value: float, dtype: torch.dtype) -> None:
    points = cloud(2, 30, 3, dtype=dtype)
    points[1] = value
    with pytest.raises(ValueError, match="points: expected finite points that are not all equal"):
        unit_sphere_frame(points)


def test_one_point_at_infinity() -> None:
    points = cloud(1, 30, 3)
    points[0, 3, 1] = torch.inf
    with pytest.raises(ValueError, match="points: expected finite points"):
        unit_sphere_frame(points)
