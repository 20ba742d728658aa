"""The surface model: local frames, seeds, even spacing, the projection as a whole."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from pnu.data.shapes import make, unit_mesh
from pnu.geometry.even_spacing import repel, tangent_discs
from pnu.geometry.local_frames import feet, local_frames, tangent_basis
from pnu.geometry.mesh_sampling import sample_poisson_disk
from pnu.geometry.spacing import spacing
from pnu.geometry.transforms import rotation_matrix
from pnu.metrics.functional import uniformity
from pnu.networks.surface import Projector, Surface, discs_of_patches
from pnu.upsamplers import Context, SurfaceProjection
from pnu.upsamplers import surface_projection as procedure
from pnu.upsamplers.surface_projection import no_farther, reject_worst, slid, within_reach


def upsample(network: Surface, cloud: Tensor, count: int, **options: Any) -> Tensor:
    return SurfaceProjection(network).upsample_cloud(cloud, count, Context(**options))


def discs(points: Tensor, normals: Tensor, count: int, **options: int) -> Tensor:
    return torch.from_numpy(tangent_discs(points.numpy(), normals.numpy(), count, **options))


def repelled(points: Tensor, normals: Tensor, **options: int) -> Tensor:
    return torch.from_numpy(repel(points.double().numpy(), normals.double().numpy(), **options)).to(points)


def sphere(n: int, seed: int = 0) -> Tensor:
    """Random points of the unit sphere with their normals, (n, 6) float64."""
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    points = points / points.norm(dim=1, keepdim=True)
    return torch.cat([points, points], 1)


def wavy(n: int, seed: int = 0) -> Tensor:
    """Random points of a bumpy, curved patch with unit normals, (n, 6) float64."""
    x, y = torch.rand(2, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    z = 0.2 * torch.sin(3 * x) + 0.15 * x * y + 0.1 * y**2
    slope = torch.stack([-0.6 * torch.cos(3 * x) - 0.15 * y, -0.15 * x - 0.2 * y, torch.ones_like(x)], 1)
    return torch.cat([torch.stack([x, y, z], 1), slope / slope.norm(dim=1, keepdim=True)], 1)


def trained(seed: int = 0, **options: int) -> Surface:
    """A surface model whose last layer is not zero, as after training, in float64."""
    torch.manual_seed(seed)
    model = Surface(**options).double().eval()
    torch.nn.init.normal_(model.projector.out.weight, std=0.02)
    return model


def moved(cloud: Tensor, turn: Tensor, factor: float, shift: Tensor) -> Tensor:
    return torch.cat([factor * cloud[:, :3] @ turn.T + shift, cloud[:, 3:] @ turn.T], 1)


@pytest.fixture
def turn() -> Tensor:
    return rotation_matrix(1, generator=torch.Generator().manual_seed(3))[0].double()


def neighborhoods(cloud: Tensor, query: Tensor, k: int) -> tuple[Tensor, Tensor, Tensor]:
    near = cloud[torch.cdist(query[:, :3], cloud[:, :3]).topk(k, largest=False).indices]
    return near[..., :3] - query[:, None, :3], near[..., 3:], query[:, 3:]


def test_frame_finds_the_sphere() -> None:
    cloud = sphere(400)
    query = 1.05 * cloud[:50]
    frame = local_frames(*neighborhoods(cloud, torch.cat([query[:, :3], cloud[:50, 3:]], 1), 24))
    foot = query[:, :3] + frame.base
    torch.testing.assert_close(foot, cloud[:50, :3], atol=1e-9, rtol=0)
    torch.testing.assert_close(frame.axes[:, 2], cloud[:50, 3:], atol=1e-9, rtol=0)
    identity = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    torch.testing.assert_close(frame.axes @ frame.axes.mT, identity, atol=1e-12, rtol=0)
    # each neighbor's plane, bent evenly, passes through the foot: the sphere is exact
    torch.testing.assert_close(frame.features[..., 7], torch.zeros(50, 24, dtype=torch.float64), atol=1e-9, rtol=0)


def test_features_do_not_see_place_rotation_and_size(turn: Tensor) -> None:
    cloud = wavy(400)
    other = moved(cloud, turn, 250.0, torch.tensor([1e3, -2e3, 5.0], dtype=torch.float64))
    ours, theirs = (local_frames(*neighborhoods(c, c[:60], 24)) for c in (cloud, other))
    torch.testing.assert_close(theirs.features, ours.features, atol=1e-6, rtol=0)
    torch.testing.assert_close(theirs.spacing, 250 * ours.spacing)
    torch.testing.assert_close(theirs.axes, ours.axes @ turn.T, atol=1e-6, rtol=0)


def test_tangent_basis_is_orthonormal_for_every_axis() -> None:
    normals = torch.cat([torch.eye(3), -torch.eye(3), torch.nn.functional.normalize(torch.randn(20, 3), dim=1)])
    frame = torch.stack([*tangent_basis(normals), normals], 1)
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3).expand(26, 3, 3), atol=1e-6, rtol=0)


def test_discs_lie_in_tangent_planes_and_reach_the_ranked_neighbor() -> None:
    cloud = wavy(300)
    points, normals = cloud[:, :3], cloud[:, 3:]
    seeds = discs(points, normals, 9, rank=5)
    away = seeds - points[:, None]
    torch.testing.assert_close((away * normals[:, None]).sum(-1), torch.zeros(300, 9, dtype=torch.float64))
    reach = torch.cdist(points, points).sort(dim=1).values[:, 5]
    share = away.norm(dim=-1) / reach[:, None]
    assert share.max() <= 1 + 1e-9
    assert 0.45 < share.square().mean() < 0.55  # uniform by area


def test_seeds_fill_a_hole_between_the_points() -> None:
    ring = torch.linspace(0, 2 * torch.pi, 25, dtype=torch.float64)[:-1]
    points = torch.stack([ring.cos(), ring.sin(), torch.zeros_like(ring)], 1)
    normals = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand_as(points)
    seeds = discs(points, normals, 40, rank=20).flatten(0, 1)
    assert seeds.norm(dim=1).min() < 0.1


def test_repulsion_evens_out_a_sphere() -> None:
    cloud = sphere(1500)
    even_spacing = repelled(cloud[:, :3], cloud[:, 3:], steps=10)

    def unevenness(points: Tensor) -> float:
        near = torch.cdist(points, points).topk(2, largest=False).values[:, 1]
        return float(near.std() / near.mean())

    assert unevenness(even_spacing) < 0.5 * unevenness(cloud[:, :3])
    assert (even_spacing.norm(dim=1) - 1).abs().max() < 0.05


def test_repulsion_leaves_the_two_sides_of_a_sheet_alone() -> None:
    grid = torch.stack(torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij"), -1).reshape(-1, 2)
    side = torch.cat([grid, torch.zeros(64, 1)], 1)
    points = torch.cat([side, side + torch.tensor([0.1, 0, 1e-3])])
    up = torch.tensor([0.0, 0, 1]).expand(64, 3)
    alone, both = repelled(side, up, steps=1), repelled(points, torch.cat([up, -up]), steps=1)
    pushed = repelled(points, torch.cat([up, up]), steps=1)
    assert (both[:64] - side).norm(dim=1).max() <= (alone - side).norm(dim=1).max() + 0.2
    assert (pushed[:64] - side).norm(dim=1).median() > 3 * (both[:64] - side).norm(dim=1).median() + 1e-3


def test_projector_starts_at_the_sphere_fit() -> None:
    cloud = sphere(500)
    offsets, normals, hint = neighborhoods(cloud, torch.cat([0.97 * cloud[:40, :3], cloud[:40, 3:]], 1), 24)
    step, normal, _, _ = Projector().double()(offsets, normals, hint)
    torch.testing.assert_close((0.97 * cloud[:40, :3] + step).norm(dim=1), torch.ones(40, dtype=torch.float64))
    assert (normal * cloud[:40, 3:]).sum(1).min() > 0.99


def test_projection_turns_and_grows_with_the_cloud(turn: Tensor) -> None:
    model, cloud = trained(), wavy(500)
    query = torch.cat([cloud[:100, :3] + 0.02 * torch.randn(100, 3, dtype=torch.float64), cloud[:100, 3:]], 1)
    shift = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    ours = model.project(query[None], cloud[None])[0][0]
    theirs = model.project(moved(query, turn, 3.0, shift)[None], moved(cloud, turn, 3.0, shift)[None])[0][0]
    torch.testing.assert_close(theirs, moved(ours, turn, 3.0, shift), atol=1e-4, rtol=0)


def test_clouds_turn_and_grow(turn: Tensor) -> None:
    model, cloud = trained(), wavy(400)
    ours = upsample(model, cloud, 1200)
    theirs = upsample(model, moved(cloud, turn, 2.0, torch.ones(3, dtype=torch.float64)), 1200)
    expected = moved(ours, turn, 2.0, torch.ones(3, dtype=torch.float64))
    apart = torch.cdist(expected[:, :3], theirs[:, :3]).min(1).values
    # a near-tie of the farthest points may go either way
    assert (apart < 1e-4).double().mean() > 0.98


@pytest.mark.parametrize("count", [400, 401, 777, 1600, 3000])
def test_count_is_exact(count: int) -> None:
    dense = upsample(trained(), wavy(400), count)
    assert dense.shape == (count, 6)
    torch.testing.assert_close(dense[:, 3:].norm(dim=1), torch.ones(count, dtype=torch.float64))


@pytest.mark.parametrize("n", [16, 17, 40])
def test_small_clouds(n: int) -> None:
    dense = upsample(trained(neighbors=32, reach=48), sphere(n), 4 * n)
    assert dense.shape == (4 * n, 6)
    assert torch.isfinite(dense).all()


def test_batch_size_does_not_matter() -> None:
    model, cloud = trained(), wavy(300)
    whole, parts = (upsample(model, cloud, 900, batch_size=size) for size in (10_000, 37))
    torch.testing.assert_close(parts, whole, atol=1e-9, rtol=0)


def test_projector_is_the_same_with_and_without_gradient() -> None:
    torch.manual_seed(0)
    projector = Projector().double()
    torch.nn.init.normal_(projector.out.weight, std=0.3)
    around = neighborhoods(sphere(200), sphere(50), 24)
    with torch.no_grad():
        lean = projector(*around)
    for a, b in zip(lean, projector(*around), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


def test_feet_are_those_of_the_frames() -> None:
    around = neighborhoods(sphere(200), sphere(50) * 1.1, 12)
    step, normal = feet(*around)
    frame = local_frames(*around)
    torch.testing.assert_close(step, frame.base)
    torch.testing.assert_close(normal, frame.axes[:, 2])


def test_untrained_model_stays_on_a_sphere() -> None:
    dense = upsample(Surface(), sphere(600), 2400)
    assert (dense[:, :3].norm(dim=1) - 1).abs().max() < 1e-3
    assert (dense[:, :3] * dense[:, 3:]).sum(1).min() > 0.98


def test_outputs_carry_gradients_to_every_weight() -> None:
    model = trained(queries=20)
    outputs = model.outputs(torch.stack([wavy(200, seed) for seed in range(2)]))
    assert outputs["projected"].shape == (2, 2, 20, 6)
    assert outputs["query"].requires_grad is False
    assert torch.equal(outputs["prediction"], outputs["projected"][-1])
    (outputs["projected"].square().sum() + outputs["log_error"].sum()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.parameters())


def test_far_neighbors_are_thinned_out() -> None:
    ranks = Surface(neighbors=32, reach=48).ranks(1000)
    assert ranks[:16] == list(range(16))
    assert len(ranks) == len(set(ranks)) == 32
    assert ranks[-1] == 47
    assert Surface().ranks(10) == list(range(10))


def test_reach_below_neighbors_is_refused() -> None:
    with pytest.raises(ValueError, match=r"model\.reach=20: expected at least model\.neighbors=24"):
        Surface(neighbors=24, reach=20)


def test_parts_can_be_left_out() -> None:
    cloud = wavy(200)
    query = torch.cat([cloud[:30, :3] + 0.05 * cloud[:30, 3:], cloud[:30, 3:]], 1)
    offsets, normals, hint = neighborhoods(cloud, query, 24)
    frame = local_frames(offsets, normals, hint, sphere=False)
    assert not frame.base.any()
    torch.testing.assert_close(frame.axes[:, 2], hint)
    projector = Projector(attention=False)
    assert (projector.shares(torch.randn(5, 24, 3)) == 1 / 24).all()
    outputs = trained(rounds=1).outputs(cloud[None])
    assert outputs["projected"].shape[0] == 1


def test_most_doubtful_points_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    model, cloud = trained(), wavy(300)
    every: dict[str, tuple[Tensor, Tensor]] = {}
    model.reject = 0.01
    project = procedure.in_parts

    def spy(*clouds: Any, **options: Any) -> Any:
        found = project(*clouds, **options)
        every["last"] = torch.from_numpy(found[0]), torch.from_numpy(found[1])
        return found

    monkeypatch.setattr(procedure, "in_parts", spy)
    monkeypatch.setattr(procedure, "covering", lambda query, *others: query)
    dense = upsample(model, cloud, 600)
    points, error = every["last"]
    assert len(points) == 606
    kept = torch.isin(points[:, 0], dense[:, 0])
    assert kept.sum() == 600
    assert error[~kept].min() > error.median()
    dropped = points[~kept, :3]
    assert torch.pdist(dropped).min() > torch.cdist(dropped, points[:, :3]).sort(1).values[:, 4].min()


def test_of_doubtful_neighbors_the_worst_is_dropped() -> None:
    """A row of bad points does not become a hole, and a bad point elsewhere does not stay for their sake."""
    x, y = torch.meshgrid(torch.arange(20.0), torch.arange(20.0), indexing="ij")
    grid = torch.stack([x, y, torch.zeros_like(x)], -1).flatten(0, 1)
    error = torch.zeros(400)
    error[105:110], error[300] = torch.tensor([7.0, 8.0, 9.0, 8.5, 7.5]), 5.0
    stays = torch.from_numpy(reject_worst(grid.double().numpy(), error.numpy(), 398))
    assert sorted(set(range(400)) - set(stays.tolist())) == [107, 300]


@pytest.mark.parametrize("count", [0, 1, 5, 19, 20])
def test_count_is_exact_however_many_are_dropped(count: int) -> None:
    stays = torch.from_numpy(reject_worst(sphere(20)[:, :3].numpy(), np.arange(20.0)[::-1], count))
    assert len(stays) == count
    assert stays.equal(stays.unique())


def test_some_crops_in_training_get_normals_of_the_network_s_own() -> None:
    network = trained(neighbors=8, reach=8, queries=8, refining=0.5)
    patch = torch.stack([wavy(60, seed) for seed in range(4)])
    refined = network.with_some_refined(patch)
    changed = (refined != patch).any(2)
    assert not changed[:2].any()
    assert changed[2:, :30].all()
    assert not changed[2:, 30:].any()
    torch.testing.assert_close(refined[..., :3], patch[..., :3], rtol=0, atol=0)
    once, _, _ = network.project(patch[2:3, :30], patch[2:3])
    torch.testing.assert_close(refined[2:3, :30, 3:], once[..., 3:])
    assert trained(neighbors=8, reach=8, queries=8).with_some_refined(patch) is patch


def test_normals_of_bare_clouds_are_refined_before_the_work() -> None:
    cloud, seen = wavy(300), []
    network = trained(neighbors=8, reach=8, passes=2)
    rough = torch.cat(
        [cloud[:, :3], torch.nn.functional.normalize(cloud[:, 3:] + 0.3 * torch.sin(9 * cloud[:, :3]))], 1
    )
    found = upsample(network, rough, 600, progress=lambda stage, *_: seen.append(stage))
    assert [f"normals, pass {n}" in seen for n in (1, 2, 3, 4, 5)] == [True, True, True, True, False]
    network.passes = 0
    refined = rough
    for _ in range(2 + procedure.MORE):
        refined = torch.cat([cloud[:, :3], network.project(refined[None], refined[None])[0][0, :, 3:]], 1)
    torch.testing.assert_close(upsample(network, refined, 600), found, atol=1e-6, rtol=0)


def test_noisy_points_are_smoothed_first() -> None:
    """Of a cloud that is noisy beside its spacing, and of no other."""
    model, stages = Surface(), set()
    for noise in (0.0, 0.02):
        cloud = sphere(800)
        shift = torch.randn(800, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        cloud[:, :3] += noise * shift
        seen: set[str] = set()
        dense = upsample(model, cloud, 1600, progress=lambda stage, done, total, seen=seen: seen.add(stage))
        assert ("smoothing, the points are noisy" in seen) == (noise > 0)
        stages |= seen
        assert float((dense[:, :3].norm(dim=1) - 1).abs().mean()) < max(0.5 * noise, 0.002)
    assert {"projection", "refinement 1", "refinement 2"} <= stages


def test_noisy_points_that_lie_evenly_stay_where_they_are_smoothed() -> None:
    """So that no place that was measured lies bare; random points would leave the result uneven."""
    model, noise = Surface(), torch.randn(400, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for even in (True, False):
        cloud = sphere(4000)
        cloud = cloud[procedure.farthest_points_large(cloud[:, :3].numpy(), 400)] if even else cloud[:400]
        cloud[:, :3] += 0.03 * noise
        smooth = SurfaceProjection(model).smoothed(cloud.numpy(), Context())
        dense = upsample(model, cloud, 1600).numpy()
        stay = cKDTree(dense[:, :3]).query(smooth[:, :3])[0] < 1e-9
        assert stay.all() if even else not stay.any()
        np.testing.assert_allclose(np.linalg.norm(dense[:, 3:], axis=1), 1)
        assert upsample(model, cloud, 200).shape == (200, 6)  # fewer than there are


def test_bent_and_thin_parts_get_as_many_points_for_their_surface_as_flat_ones() -> None:
    """Seeds around points of a limb stand off it, where they take more room: with few to choose from it is .075."""
    mesh, random = unit_mesh(make("person")), np.random.default_rng(0)
    cloud, truth = torch.from_numpy(sample_poisson_disk(mesh, 800, random)), sample_poisson_disk(mesh, 6000, random)
    dense = upsample(Surface(), cloud, 3200, keep=True)
    assert float(uniformity(dense[:, :3], truth[:, :3], share=0.03)) < 0.06


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize(
    ("settings", "staying", "elsewhere"),
    [
        ({}, (3, 2), (2, 1.15)),
        ({"candidates": 2.5}, (2.5, 2), (2.5, 1.15)),
        ({"candidates": 4, "shortlist": 1.5}, (4, 1.5), (4, 1.5)),
    ],
)
def test_numbers_that_are_given_count_everywhere(
    settings: dict[str, float], staying: tuple[float, float], elsewhere: tuple[float, float], keep: bool
) -> None:
    """Of candidates and of the shortlist; those that are not depend on whether points stay."""
    totals: dict[str, int] = {}
    upsample(
        Surface(**settings), sphere(300), 900, keep=keep, progress=lambda stage, _, total: totals.update({stage: total})
    )
    new = 900 - keep * 300
    assert (totals["spheres"] / new, totals["projection"] / new) == (staying if keep else elsewhere)


@pytest.mark.parametrize("name", ["rounds", "seeds", "candidates", "shortlist", "refinements"])
def test_less_than_one_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"model\.{name}=0: expected at least 1"):
        Surface(**{name: 0})


def test_a_negative_share_of_rejected_points_is_refused() -> None:
    with pytest.raises(ValueError, match=r"model\.reject=-0\.1: expected a share"):
        Surface(reject=-0.1)


def test_along_the_surface_points_go_a_share_of_the_way() -> None:
    query, normal = np.array([[1, 1, 1, 1, 0, 0.0]]), [0.6, 0, 0.8]
    refined = np.array([[1 + 0.6 * 2 + 0.8, 4, 1 + 0.8 * 2 - 0.6, *normal]])  # 2 along the normal, (1, 3) across
    np.testing.assert_array_equal(slid(query, refined, 1), refined)
    half = [[1 + 0.6 * 2 + 0.4, 2.5, 1 + 0.8 * 2 - 0.3, *normal]]
    np.testing.assert_allclose(slid(query, refined, 0.5), half, atol=1e-15)
    np.testing.assert_allclose(slid(query, refined, 0), [[2.2, 1, 2.6, *normal]], atol=1e-15)
    with pytest.raises(ValueError, match=r"model\.slide=1\.1: expected a share from 0 to 1"):
        Surface(slide=1.1)


@pytest.mark.parametrize("n", [5, 90])
def test_seeds_laid_at_once_are_those_laid_patch_by_patch(n: int) -> None:
    """As on a GPU; few points too, and a nearest neighbor straight above its point."""
    generator = torch.Generator().manual_seed(1)
    patch = torch.cat([torch.randn(3, n, 3, generator=generator), torch.randn(3, n, 3, generator=generator)], -1)
    patch[..., 3:] = nn.functional.normalize(patch[..., 3:], dim=-1)
    patch[0, 1, :3] = patch[0, 0, :3] + 1e-3 * patch[0, 0, 3:]
    found = discs_of_patches(patch, 3, first=4)
    for discs, one in zip(found.numpy(), patch.numpy(), strict=True):
        np.testing.assert_allclose(discs, tangent_discs(one[:, :3], one[:, 3:], 3, first=4), atol=2e-5)


def test_training_seeds_are_spread_and_pushed_outward() -> None:
    patch = sphere(300).float()[None]
    patch = patch[:, (patch[0, :, :3] - patch[0, 0, :3]).norm(dim=1).argsort()]
    seeds, push = Surface(queries=20).training_seeds(patch)
    assert seeds.shape == push.shape == (1, 20, 6)
    assert (push[..., 3:] == 0).all()
    apart = torch.cdist(seeds[0, :, :3], seeds[0, :, :3]).fill_diagonal_(torch.inf).amin(1)
    all_discs = discs(patch[0, :, :3], patch[0, :, 3:], 3, first=20).flatten(0, 1)
    crowded = torch.cdist(all_discs, all_discs).fill_diagonal_(torch.inf).amin(1)
    assert apart.min() > 2 * crowded.min()
    parents = seeds[0, :, :3] - push[0, :, :3] / 0.1
    assert torch.cdist(parents, patch[0, :20, :3]).amin(1).max() < 1e-4


def test_more_seeds_than_a_crop_can_bear_are_refused() -> None:
    patch = sphere(16).float()[None]
    assert Surface(queries=48).outputs(patch)["prediction"].shape == (1, 48, 6)
    with pytest.raises(ValueError, match=r"model\.queries=49: expected at most 3 times .* points=16"):
        Surface(queries=49).outputs(patch)


def test_every_stage_of_a_large_run_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    from pnu.geometry import even_spacing, farthest_sampling

    monkeypatch.setattr(procedure, "BATCHES", 1)
    monkeypatch.setattr(farthest_sampling, "LARGE", 2000)
    monkeypatch.setattr(farthest_sampling, "LARGE_BLOCK", 1000)
    monkeypatch.setattr(even_spacing, "ROWS", 1000)
    steps: dict[str, list[tuple[int, int]]] = {}
    upsample(Surface(), sphere(600), 2400, progress=lambda stage, *step: steps.setdefault(stage, []).append(step))
    stages = ["seeds", "spheres", "shortlist", "projection", "thinning", "even spacing", "refinement 1", "refinement 2"]
    assert list(steps)[: len(stages)] == stages
    for stage, told in steps.items():
        done, total = zip(*told, strict=True)
        assert len(set(done)) > 4 or stage.startswith("places without points"), stage
        assert max(done) == done[-1] == total[-1]


@pytest.mark.slow
def test_no_holes_where_points_were_rejected() -> None:
    """Points of the true surface and the nearest point made, in spacings of the points made."""
    from bench.scale import wavy_sphere
    from pnu.upsamplers.whole_clouds import upsample

    cloud = wavy_sphere(10_000)
    dense = cKDTree(upsample(cloud[:, :3], cloud[:, 3:], model="surface")[:, :3])
    apart = spacing(dense.data)
    truth = wavy_sphere(400_000)[:, :3]
    assert dense.query(truth)[0].max() < 1.3 * apart
    assert cKDTree(cloud[:, :3]).query(truth)[0].max() > 2 * apart  # of the input, which is random


def test_no_point_moves_farther_than_the_limit() -> None:
    moved = no_farther(0.1, np.zeros((3, 3)), np.array([[0.05, 0, 0], [0, 0.3, 0.4], [0, 0, 0]]))
    np.testing.assert_allclose(moved, [[0.05, 0, 0], [0, 0.06, 0.08], [0, 0, 0]], atol=1e-15)


def test_what_lies_far_from_an_even_cloud_is_left_out() -> None:
    """Over a grid of spacing 1: at half of it, at 1.5, at 2, at 2 of a surer one; no more than there are too many."""
    cloud = np.stack([*np.meshgrid(np.arange(9.0), np.arange(9.0)), np.zeros((9, 9))], -1).reshape(-1, 3)
    points = np.array([[4, 4, 0.5], [4, 4, 1.5], [3, 4, 2], [5, 4, 2]])
    error = np.array([-7.0, -7, -7, -15])  # 8 a spacing makes 1.5 of -7 and 1.06
    np.testing.assert_array_equal(within_reach(points, error, cloud, 1), [0, 3])
    np.testing.assert_array_equal(within_reach(points, error, cloud, 3), [0, 1, 3])  # the farthest goes first
    np.testing.assert_array_equal(within_reach(points, error, cloud, 4), [0, 1, 2, 3])
