"""Algebraic point set surfaces: exact on spheres and planes, against a plain least squares fit, and the invariances."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from pnu.geometry import algebraic_sphere
from pnu.geometry.algebraic_sphere import apss_project, fit_sphere, project_to_sphere


def sphere(n: int, radius: float = 1.0, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> torch.Tensor:
    normals = normalize(torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=1)
    return torch.cat([radius * normals + torch.tensor(center), normals], dim=1)


def noise(n: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("radius", [1e-3, 1.0, 1e4])
def test_exact_on_a_sphere_anywhere(radius: float) -> None:
    center = (3.0, -1e3, 20.0)
    cloud = sphere(400, radius, center)
    found = apss_project(cloud[:, :3] + 0.05 * radius * noise(400), cloud, steps=1)
    offset = found[:, :3] - torch.tensor(center)
    assert torch.allclose(offset.norm(dim=1), torch.tensor(radius, dtype=torch.float64), rtol=1e-8)
    assert torch.allclose(found[:, 3:], normalize(offset, dim=1), atol=1e-8)


def test_exact_on_a_plane() -> None:
    points = torch.cat([noise(300)[:, :2], torch.full((300, 1), 7.0)], dim=1)
    cloud = torch.cat([points, torch.tensor([0.0, 0, 1]).expand(300, 3)], dim=1)
    query = points + 0.1 * noise(300, seed=2)
    found = apss_project(query, cloud)
    expected = torch.cat([query[:, :2], cloud[:, 2:3], cloud[:, 3:]], dim=1)
    assert torch.allclose(found, expected, atol=1e-12)


def test_fit_is_the_least_squares_fit_of_the_normals() -> None:
    points, weights = noise(12), torch.rand(12, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    normals = normalize(noise(12, seed=4), dim=1)
    u0, u, uq = fit_sphere(points, normals, weights)
    # Unknowns (u, uq): u + 2 uq p = n at every point, in all three coordinates, weighted.
    p, n, root = points.numpy(), normals.numpy(), np.repeat(np.sqrt(weights.numpy()), 3)
    rows = np.hstack([np.tile(np.eye(3), (12, 1)), 2 * p.reshape(-1, 1)])
    expected = np.linalg.lstsq(root[:, None] * rows, root * n.ravel(), rcond=None)[0]
    np.testing.assert_allclose([*u.tolist(), float(uq)], expected, rtol=1e-9)
    # u0 makes the weighted mean of the field zero at the points.
    field = u0 + points @ u + uq * points.square().sum(1)
    assert float((weights * field).sum()) == pytest.approx(0, abs=1e-12)


def test_projection_lands_on_the_sphere_at_the_nearest_point() -> None:
    center, radius = torch.tensor([[0.3, 0.4, 1.2]], dtype=torch.float64), 0.5
    uq = torch.tensor([2.0], dtype=torch.float64)
    u, u0 = -2 * uq * center, uq * (center.square().sum(1) - radius**2)
    step, normal = project_to_sphere(u0, u, uq)
    assert torch.allclose(step, center * (1 - radius / 1.3))
    assert torch.allclose(normal, -center / 1.3)
    flat_step, flat_normal = project_to_sphere(torch.tensor([-6.0]), torch.tensor([[0.0, 0, 2]]), torch.tensor([0.0]))
    assert flat_step.tolist() == [[0, 0, 3]]
    assert flat_normal.tolist() == [[0, 0, 1]]


def test_degenerate_neighborhoods_stay_finite() -> None:
    same = torch.tensor([[1.0, 2, 3, 0, 0, 1]], dtype=torch.float64).repeat(20, 1)  # one point twenty times: its plane
    assert apss_project(torch.tensor([[1.0, 2.5, 4]], dtype=torch.float64), same).tolist() == [[1, 2.5, 3, 0, 0, 1]]
    opposite = same * torch.tensor([1.0, 1, 1, 1, 1, -1])
    query = torch.tensor([[1.0, 2, 4]], dtype=torch.float64)
    assert torch.isfinite(apss_project(query, torch.cat([same, opposite])[::2].contiguous(), k=20)).all()
    assert torch.isfinite(apss_project(sphere(50)[:1, :3] * 0, sphere(50), k=50)).all()  # the center of the sphere


def test_moves_with_the_cloud() -> None:
    cloud = sphere(500)
    cloud[:, :3] += 0.05 * noise(500)
    cloud[:, 3:] = normalize(cloud[:, 3:] + 0.1 * noise(500, seed=5), dim=1)
    query = cloud[:, :3] + 0.05 * noise(500, seed=6)
    rotation = torch.linalg.qr(noise(3, seed=7))[0]
    shift = torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64)
    before = apss_project(query, cloud)
    moved = torch.cat([3 * cloud[:, :3] @ rotation.T + shift, cloud[:, 3:] @ rotation.T], dim=1)
    after = apss_project(3 * query @ rotation.T + shift, moved)
    assert torch.allclose(after[:, :3], 3 * before[:, :3] @ rotation.T + shift, atol=1e-8)
    assert torch.allclose(after[:, 3:], before[:, 3:] @ rotation.T, atol=1e-8)


def test_chunks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, query = sphere(300), sphere(300)[:, :3] + 0.1 * noise(300)
    whole = apss_project(query, cloud, 8)
    monkeypatch.setattr(algebraic_sphere, "CHUNK_NEIGHBORS", 8 * 37)
    torch.testing.assert_close(apss_project(query, cloud, 8), whole, rtol=0, atol=1e-12)


def test_single_precision_far_from_the_origin() -> None:
    cloud = sphere(300, center=(1000.0, 0.0, 0.0))
    found = apss_project(cloud[:, :3].float(), cloud.float())
    assert found.dtype == torch.float32
    assert torch.allclose(found[:, :3].double(), cloud[:, :3], atol=2e-4)  # float32 itself resolves 6e-5 there


def test_bad_input() -> None:
    cloud = sphere(20)
    with pytest.raises(ValueError, match=r"points: expected \(m, 3\), found \(20, 6\)"):
        apss_project(cloud, cloud)
    with pytest.raises(ValueError, match=r"cloud: expected points and normals \(n, 6\), found \(20, 3\)"):
        apss_project(cloud[:, :3], cloud[:, :3])
    with pytest.raises(ValueError, match=r"k: expected 4 to 20 neighbors .* found 21"):
        apss_project(cloud[:, :3], cloud, k=21)
