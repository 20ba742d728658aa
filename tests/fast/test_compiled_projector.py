"""Compiled steps of the surface model against those of torch: frames, spheres, network, whole clouds."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import pnu
from pnu import weights
from pnu.fast.compiled_projector import compiled_projection, compiled_spheres
from pnu.geometry.local_frames import feet
from pnu.geometry.neighbor_search import Search
from pnu.networks import checkpoints
from pnu.networks.compiled_surface import read_compiled
from pnu.networks.surface import Projector, Surface

pytestmark = pytest.mark.usefixtures("compiled")


def bent(n: int, seed: int = 0) -> Tensor:
    """Points and normals (n, 6) of a bent sheet, in float64."""
    u, v = torch.rand(2, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 1.6 - 0.8
    normals = torch.stack([-0.8 * u + 0.2 * v, 0.6 * v + 0.2 * u, torch.ones_like(u)], 1)
    points = torch.stack([u, v, 0.4 * u * u - 0.3 * v * v - 0.2 * u * v], 1)
    return torch.cat([points, nn.functional.normalize(normals, dim=1)], 1)


def around(cloud: Tensor, m: int, k: int) -> tuple[Tensor, Tensor]:
    """Queries (m, 6) near a cloud and their k nearest points."""
    noise = torch.randn(m, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    query = cloud[torch.arange(m) % len(cloud)].clone()
    query[:, :3] += 0.02 * noise
    return query, Search(cloud[:, :3]).knn(query[:, :3], k).idx


def network(width: int, *, sphere: bool = True, attention: bool = True) -> Surface:
    """With weights at random in the last layer too."""
    with torch.random.fork_rng():
        torch.manual_seed(width)
        surface = Surface(width=width, sphere=sphere, attention=attention)
        for value in surface.projector.out.parameters():
            nn.init.normal_(value, std=0.1)
    return surface.eval().requires_grad_(False)


def assert_same_step(surface: Surface, query: Tensor, cloud: Tensor, idx: Tensor) -> None:
    compiled = compiled_projection(surface)
    assert compiled is not None
    found = torch.from_numpy(compiled(query.numpy(), cloud.numpy(), idx.numpy()))
    projected, log_error, spacing = surface.project(query[None], cloud[None], idx[None])
    torch.testing.assert_close(found[:, :3], projected[0, :, :3], rtol=0, atol=1e-6)
    torch.testing.assert_close(found[:, 3:6], projected[0, :, 3:], rtol=0, atol=1e-5)
    torch.testing.assert_close(found[:, 6].float(), log_error[0] + spacing[0].log(), rtol=0, atol=1e-4)


@pytest.mark.parametrize("attention", [True, False])
@pytest.mark.parametrize("sphere", [True, False])
@pytest.mark.parametrize(("width", "k"), [(64, 24), (64, 5), (32, 16), (20, 33), (8, 7), (100, 24)])
def test_projection_equals_the_networks(width: int, k: int, sphere: bool, attention: bool) -> None:
    cloud = bent(300)
    assert_same_step(network(width, sphere=sphere, attention=attention), *split(cloud, 101, k))


def split(cloud: Tensor, m: int, k: int) -> tuple[Tensor, Tensor, Tensor]:
    query, idx = around(cloud, m, k)
    return query, cloud, idx


@pytest.mark.parametrize("m", [1, 7, 8, 9, 16, 17])
def test_any_number_of_queries(m: int) -> None:
    assert_same_step(checkpoints.load("surface"), *split(bent(200), m, 24))


def test_flat_clouds_whose_points_repeat() -> None:
    """Spheres become planes. Frames that nothing decides are turned by rounding: the network is not asked."""
    cloud = bent(100).repeat(3, 1)
    cloud[:, 2], cloud[:, 3:] = 0, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert_same_feet(*split(cloud, 60, 12), tolerance=1e-4)  # few places beside each other far below the query


def test_clouds_of_one_place() -> None:
    cloud = bent(1).repeat(30, 1)
    query = cloud[:9].clone()
    assert_same_feet(query, cloud, torch.arange(24).expand(9, -1))
    query[:, 0] += 0.1
    assert_same_feet(query, cloud, torch.arange(24).expand(9, -1))


def test_normals_that_contradict_each_other() -> None:
    cloud = bent(300)
    cloud[::2, 3:] *= -1
    assert_same_feet(*split(cloud, 50, 12))


@pytest.mark.parametrize("k", [4, 12])
def test_spheres_equal_feet(k: int) -> None:
    assert_same_feet(*split(bent(300), 50, k))


def assert_same_feet(query: Tensor, cloud: Tensor, idx: Tensor, tolerance: float = 2e-5) -> None:
    compiled = compiled_spheres(torch.empty(0))
    assert compiled is not None
    near = cloud[idx].float()
    offsets = (cloud[idx][..., :3] - query[:, None, :3]).float()
    step, normal = feet(offsets, near[..., 3:], query[:, 3:].float())
    expected = torch.cat([query[:, :3] + step, normal, torch.zeros(len(query), 1)], 1)
    found = torch.from_numpy(compiled(query.numpy(), cloud.numpy(), idx.numpy()))
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("change", ["another class", "float64", "PNU_FAST=0"])
def test_what_kernels_do_not_know_is_left_to_torch(monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    class Other(Projector):
        """Whose steps may be others."""

    surface = network(16)
    assert compiled_projection(surface) is not None
    if change == "another class":
        surface.projector.__class__ = Other
    elif change == "float64":
        surface.double()
    else:
        monkeypatch.setenv("PNU_FAST", "0")
    assert compiled_projection(surface) is None


def test_whole_clouds_are_the_same_to_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = bent(400, seed=2).numpy()
    fast = pnu.upsample(cloud + [1e5, 0, 0, 0, 0, 0], ratio=4)
    monkeypatch.setenv("PNU_FAST", "0")
    plain = pnu.upsample(cloud + [1e5, 0, 0, 0, 0, 0], ratio=4)
    same = np.abs(fast - plain).max(1) < 1e-5
    assert same.mean() > 0.98  # a tie that falls otherwise moves a point and its neighbors


def test_threads_do_not_change_a_bit() -> None:
    cloud, before = bent(400, seed=3).numpy(), torch.get_num_threads()
    try:
        found = []
        for number in (1, 3):
            torch.set_num_threads(number)
            found.append(pnu.upsample(cloud, ratio=4))
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize(("share", "taken"), [(None, True), (2.5, True), (0.5, False), ("many", False)])
def test_only_settings_that_the_network_takes_are_read_without_torch(
    tmp_path: Path, share: object, taken: bool
) -> None:
    found = weights.read(weights.find("surface"))
    path = tmp_path / "a.safetensors"
    weights.write(path, found.model | {"candidates": share, "shortlist": share}, found.state)
    compiled = read_compiled(path)
    assert (compiled is not None) == taken
    assert compiled is None or compiled.candidates == compiled.shortlist == share
