"""Rotations, scales and affine maps of points with normals."""

import pytest
import torch
from torch import Tensor

from pnu.geometry.transforms import affine, rotate, rotation_matrix, scale, small_rotation, translate


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cloud(clouds: int = 2, n: int = 9) -> Tensor:
    points = torch.randn(clouds, n, 6, generator=generator(), dtype=torch.float64)
    points[..., 3:] = torch.nn.functional.normalize(points[..., 3:], dim=-1)
    return points


def assert_rotations(rotation: Tensor) -> None:
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).to(rotation).expand_as(rotation))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(len(rotation)).to(rotation))


def test_rotations_are_uniform() -> None:
    rotation = rotation_matrix(20_000, generator=generator(), dtype=torch.float64)
    assert_rotations(rotation)
    # Haar measure: an image of an axis is uniform on the sphere, the trace has mean 0 and mean square 1
    assert rotation.mean(0).abs().max() < 0.02
    assert (rotation.square().mean(0) - 1 / 3).abs().max() < 0.02
    trace = rotation.diagonal(dim1=1, dim2=2).sum(1)
    assert abs(trace.mean().item()) < 0.03
    assert abs(trace.square().mean().item() - 1) < 0.03
    # the angle's density is (1 - cos) / pi: below 90 degrees lie (pi/2 - 1) / pi = 18.2 %
    assert abs((trace > 1).double().mean().item() - 0.1817) < 0.01


def test_small_rotations_are_small() -> None:
    rotation = small_rotation(5000, 0.03, 0.09, generator=generator(), dtype=torch.float64)
    assert_rotations(rotation)
    angle = torch.arccos((rotation.diagonal(dim1=1, dim2=2).sum(1).clamp(max=3) - 1) / 2)
    assert angle.max() < 0.09 * 3**0.5 + 0.01
    # the mean of the length of three normal deviates is sigma sqrt(8 / pi)
    assert angle.mean().item() == pytest.approx(0.03 * (8 / torch.pi) ** 0.5, rel=0.03)
    clipped = small_rotation(1000, 10.0, 0.01, generator=generator(), dtype=torch.float64)
    assert (torch.arccos((clipped.diagonal(dim1=1, dim2=2).sum(1).clamp(max=3) - 1) / 2) < 0.018).all()
    assert torch.equal(small_rotation(2, 0.0, 0.1, generator=generator()), torch.eye(3).expand(2, 3, 3))


def test_same_generator_same_rotation() -> None:
    assert torch.equal(rotation_matrix(3, generator=generator(4)), rotation_matrix(3, generator=generator(4)))
    assert not torch.equal(rotation_matrix(3, generator=generator(4)), rotation_matrix(3, generator=generator(5)))


def test_rotate_by_hand() -> None:
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z, x goes to y
    assert rotate(torch.tensor([[[2.0, 0, 5, 0, 1, 0]]]), quarter).tolist() == [[[0, 2, 5, -1, 0, 0]]]
    assert rotate(torch.tensor([[[2.0, 0, 5]]]), quarter[None]).tolist() == [[[0, 2, 5]]]


def test_scale_and_translate_by_hand() -> None:
    points = torch.tensor([[[1.0, 2, 3, 0, 0, 1]], [[1, 2, 3, 0, 1, 0]]])
    assert scale(points, 2.0).tolist() == [[[2, 4, 6, 0, 0, 1]], [[2, 4, 6, 0, 1, 0]]]
    assert scale(points, torch.tensor([2.0, 3.0]))[1].tolist() == [[3, 6, 9, 0, 1, 0]]
    assert translate(points, torch.tensor([1.0, 0, -1]))[0].tolist() == [[2, 2, 2, 0, 0, 1]]
    assert translate(points, torch.eye(3)[:2])[1].tolist() == [[1, 3, 3, 0, 1, 0]]


def test_affine_of_a_rotation_is_the_rotation() -> None:
    points, rotation = cloud(), rotation_matrix(2, generator=generator(1), dtype=torch.float64)
    torch.testing.assert_close(affine(points, rotation), rotate(points, rotation))
    torch.testing.assert_close(affine(points[..., :3], rotation), rotate(points, rotation)[..., :3])


def test_normals_of_an_ellipsoid() -> None:
    normals = torch.nn.functional.normalize(cloud(1, 200)[..., :3], dim=-1)
    axes = torch.tensor([2.0, 0.5, 1.0], dtype=torch.float64)
    sphere = torch.cat([normals, normals], -1)
    ellipsoid = affine(sphere, torch.diag(axes))
    points = ellipsoid[..., :3]
    gradient = torch.nn.functional.normalize(points / axes**2, dim=-1)  # of x^2/4 + 4 y^2 + z^2
    torch.testing.assert_close(ellipsoid[..., 3:], gradient)


def test_normals_stay_perpendicular_under_shear_and_reflection() -> None:
    generator_ = generator(2)
    matrix = torch.randn(4, 3, 3, generator=generator_, dtype=torch.float64)
    points = cloud(4)
    normals = points[..., 3:]
    tangent = torch.linalg.cross(normals, torch.randn(4, 9, 3, generator=generator_, dtype=torch.float64))
    moved = affine(points, matrix)[..., 3:]
    assert (moved * (tangent @ matrix.mT)).sum(-1).abs().max() < 1e-12
    torch.testing.assert_close(moved.norm(dim=-1), torch.ones(4, 9, dtype=torch.float64))
    # outward stays outward: the image of a step along the normal has a positive share of the new normal
    assert bool((((normals @ matrix.mT) * moved).sum(-1) > 0).all())
    assert bool((torch.linalg.det(matrix) < 0).any())


def test_affine_has_a_gradient() -> None:
    points = cloud(1, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: affine(p, torch.diag(torch.tensor([1.0, 2, 3]).double())), points)


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="matrix: expected invertible 3 x 3 matrices, found a singular one"):
        affine(cloud(), torch.zeros(3, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="factor: expected positive numbers, found -2; a mirror image is an affine"):
        scale(cloud(), -2.0)
