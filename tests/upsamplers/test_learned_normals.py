"""Normals that the surface model finds: nearer to the truth than plane fits, and equivariant like them."""

import numpy as np
import pytest
import torch

import pnu
from pnu.data import shapes
from pnu.geometry.cloud_normals import settled_normals
from pnu.geometry.mesh_sampling import sample_area
from pnu.geometry.transforms import rotation_matrix
from pnu.upsamplers.learned_normals import learned_normals


def cloud(n: int = 1000, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(3)
    found = sample_area(shapes.make("bracket"), n, rng)
    found[:, :3] += noise * rng.standard_normal((n, 3))
    return found


def degrees(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.abs((found * true).sum(1)).clip(0, 1))).mean())


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_nearer_to_the_truth_than_plane_fits(noise: float) -> None:
    """On a shape that the weights were trained on; docs/metrics.md has others."""
    shape = cloud(n=800, noise=noise)
    planes = settled_normals(shape[:, :3], None).normals
    assert degrees(pnu.normals(shape[:, :3]), shape[:, 3:]) < 0.93 * degrees(planes, shape[:, 3:])


def test_turn_with_the_cloud_and_look_to_the_side_they_had() -> None:
    shape = cloud()
    points, rough = shape[:, :3], shape[:, 3:] + 0.2 * np.sin(9 * shape[:, :3])
    rough /= np.linalg.norm(rough, axis=1, keepdims=True)
    found = learned_normals(points, rough)
    turn = rotation_matrix(1, generator=torch.Generator().manual_seed(3))[0].double().numpy()
    np.testing.assert_allclose(learned_normals(points @ turn.T, rough @ turn.T), found @ turn.T, atol=2e-3, rtol=0)
    for side in (1, -1):
        assert ((learned_normals(points, side * rough) * side * rough).sum(1) > 0).mean() > 0.99


def test_given_normals_and_sides_stay() -> None:
    shape = cloud()
    some = np.where(np.arange(len(shape))[:, None] % 2 == 0, shape[:, 3:], np.nan)
    found = pnu.normals(shape[:, :3], some)
    np.testing.assert_allclose(found[::2], shape[::2, 3:], atol=1e-12)
    assert ((found * shape[:, 3:]).sum(1) > 0).mean() > 0.97
