"""Clouds in tiles: exactly as many points as without, the same whoever makes them, and no border to be seen."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bench.scenes import scanned_room
from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area
from pnu.geometry.normal_estimation import estimate_normals
from pnu.io import read_cloud, write_cloud
from pnu.upsamplers import tile_seams, tile_work
from pnu.upsamplers.tile_plan import Keys, Plan, planned
from pnu.upsamplers.tile_seams import evened_out, exactly
from pnu.upsamplers.whole_clouds import output_count, ratio_of_spacing, upsample

KEYS = Keys("", 2.5, None, "auto", False, "auto", None, None, None, None, "auto", "auto", "auto", "surface")


def sheet(n: int, seed: int = 0) -> np.ndarray:
    """Points (n, 3) of a wavy sheet of unit spacing."""
    xy = np.random.default_rng(seed).uniform(0, n**0.5, (n, 2))
    return np.column_stack([xy, np.sin(xy[:, 0] / 9) + np.cos(xy[:, 1] / 7)])


def ball(n: int) -> np.ndarray:
    points = np.random.default_rng(1).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def plan_of(folder: Path, points: np.ndarray, size: int, normals: np.ndarray | None = None, **keys: object) -> Plan:
    folder.mkdir(exist_ok=True)
    path = folder / "cloud.npy"
    if not path.exists():
        write_cloud(path, points, normals)
    return planned(folder, KEYS._replace(input=str(path), **keys), size)  # type: ignore[arg-type]


def make(plan: Plan, order: Sequence[int] | None = None) -> np.ndarray:
    """All of it in this process, tiles in an order, (m, 6)."""
    order = plan.tiles if order is None else order
    for number in order:
        tile_work.prepared(plan, number)
    whole = tile_work.whole_of(plan)
    with tile_work.working(tile_work.run_of(plan)) as upsampler:
        for number in order:
            tile_work.made(plan, number, whole, upsampler)
        for number in plan.tiles:
            tile_seams.seamed(plan, number, whole, upsampler)
    tile_seams.write_tiles(plan, whole, str(plan.folder / "out.npy"))
    dense: np.ndarray = np.load(plan.folder / "out.npy")
    return dense


@pytest.mark.slow
def test_as_many_points_as_without_tiles_and_the_same_in_any_order(tmp_path: Path) -> None:
    points = sheet(601)
    points[7] = points[3]
    points[5, 1], points[9, 2] = np.nan, np.inf
    plan = plan_of(tmp_path / "a", points, 200)
    assert plan.facts.points == 598 == len(read_cloud(plan.keys.input).points)
    assert plan.facts.notes == list(read_cloud(plan.keys.input).notes)
    assert len(plan.tiles) == 4
    dense = make(plan)
    assert dense.shape == (1495, 6)
    assert len(np.unique(dense[:, :3], axis=0)) == 1495
    np.testing.assert_allclose(np.linalg.norm(dense[:, 3:], axis=1), 1, atol=1e-9)
    other = make(plan_of(tmp_path / "b", points, 200), [2, 0, 3, 1])
    np.testing.assert_array_equal(other, dense)
    for name in ("made_00002.npy", "cloud_00001.npy", "share_00001.json", "seam_00003.npy"):  # as after an interruption
        (plan.folder / name).unlink()
    np.testing.assert_array_equal(make(plan), dense)


def test_beside_borders_the_network_looks_at_the_points_as_inside(tmp_path: Path) -> None:
    """With the normals that it found itself, and what points tell; kept, or found again."""
    plan = plan_of(tmp_path, sheet(600), 320)
    kept = make(plan)
    rows, near = np.load(plan.path("cloud", 0)), np.load(plan.path("border", 0))
    with tile_work.working(tile_work.run_of(plan)) as upsampler:
        assert near.shape[1] == 6 + upsampler.network.messages > 6
        cloud, _ = tile_work.in_unit_sphere(rows["point"], rows["normal"])
        assert np.abs(near[:, 3:6] - cloud[cKDTree(cloud[:, :3]).query(near[:, :3])[1], 3:]).max() > 1e-3
    for number in plan.tiles:
        plan.path("border", number).unlink()
        plan.path("seam", number).unlink()
    np.testing.assert_allclose(make(plan), kept, atol=1e-3)


def test_borders_have_the_spacing_of_the_inside(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, sheet(2400), 600, normals=np.tile([0.0, 0.0, 1.0], (2400, 1)), ratio=2)
    dense = make(plan)
    spaces = cKDTree(dense[:, :3]).query(dense[:, :3], k=7)[0][:, 1:]
    home = plan.cells.of_points(dense[:, :3])
    depth = np.concatenate([plan.cells.depth(dense[home == i, :3], i) for i in plan.tiles])
    spaces = np.concatenate([spaces[home == i] for i in plan.tiles])
    inner = ((dense[:, :2] > 2) & (dense[:, :2] < 47)).all(1)
    inner = np.concatenate([inner[home == i] for i in plan.tiles])
    border, inside = spaces[inner & (depth < 1)], spaces[inner & (depth > 5)]
    assert len(border) > 150
    np.testing.assert_allclose(border.mean(), inside.mean(), rtol=0.03)
    np.testing.assert_allclose(border[:, 0].mean(), inside[:, 0].mean(), rtol=0.05)
    np.testing.assert_allclose(border[:, 0].std(), inside[:, 0].std(), rtol=0.2)
    low, usual = (np.quantile(spaces[:, 0], 0.01) for spaces in (border, inside))
    assert low > 0.7 * usual
    across = home[cKDTree(dense[:, :3]).query(dense[:, :3], k=2)[1]] @ [1, -1] != 0
    assert across.sum() > 20
    nearest = cKDTree(dense[:, :3]).query(dense[:, :3], k=2)[0][:, 1]
    assert nearest[across].min() > nearest[~across].min() > 0.2 * np.median(nearest)
    made = sum(len(np.load(plan.path("made", i))) for i in plan.tiles)
    np.testing.assert_allclose(made, 4800, rtol=0.03)  # so that few are left over


@pytest.mark.slow
def test_sides_agree_between_tiles(tmp_path: Path) -> None:
    dense = make(plan_of(tmp_path / "closed", 3 * ball(400), 220, ratio=1.5))  # by a coarse cloud of the whole: outward
    assert ((dense[:, :3] * dense[:, 3:]).sum(1) > 0).all()
    dense = make(plan_of(tmp_path / "inward", 3 * ball(400), 220, ratio=1.5, side="in"))
    assert ((dense[:, :3] * dense[:, 3:]).sum(1) < 0).all()
    dense = make(plan_of(tmp_path / "seen", 3 * ball(400) + 7, 220, ratio=1.5, viewpoint="7,7,7"))
    assert (((dense[:, :3] - 7) * dense[:, 3:]).sum(1) < 0).all()
    (tmp_path / "way.xyz").write_text("7 7 7\n7.5 7 7\n")
    dense = make(plan_of(tmp_path / "way", 3 * ball(400) + 7, 220, ratio=1.5, viewpoint=str(tmp_path / "way.xyz")))
    assert (((dense[:, :3] - 7) * dense[:, 3:]).sum(1) < 0).all()
    for up, sign in (("z", 1), ("-z", -1)):
        dense = make(plan_of(tmp_path / up, sheet(200), 110, ratio=1.5, up=up))
        assert (sign * dense[:, 5] > 0).all()


@pytest.mark.slow
def test_a_coarse_cloud_looks_to_the_scanner_that_the_whole_tells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pnu.upsamplers.tile_plan.COARSE", 1350)
    points, normals = scanned_room(np.array([2, 2.4, 1.5]))
    coarse = np.load(plan_of(tmp_path, points, 2000).folder / "coarse.npy")
    assert len(coarse) == 1350
    near = cKDTree(points).query(coarse[:, :3])[1]
    assert ((coarse[:, 3:] * normals[near]).sum(1) > 0).mean() > 0.98


def test_given_normals_and_points_stay(tmp_path: Path) -> None:
    points = sheet(500)
    normals = np.column_stack([np.cos(points[:, 0] / 9) / 9, -np.sin(points[:, 1] / 7) / 7, np.full(500, -1.0)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::50] = 0
    plan = plan_of(tmp_path / "a", points, 130, normals, keep=True, ratio=2)
    assert plan.facts.missing == 10
    dense = make(plan)
    assert dense.shape == (1000, 6)
    assert (dense[:, 5] < 0).all()
    distance, row = cKDTree(dense[:, :3]).query(points)
    assert (distance == 0).all()
    given = np.arange(500) % 50 > 0
    np.testing.assert_allclose(dense[row[given], 3:], normals[given], rtol=0, atol=1e-15)


@pytest.mark.slow
def test_of_poor_normals_the_sides_alone_count(tmp_path: Path) -> None:
    """As without tiles: the network for clouds without normals, and the sides that are given."""
    points = sample_area(shapes.make("bracket"), 1500, np.random.default_rng(0))
    points, normals = points[:, :3], points[:, 3:]
    planes = estimate_normals(points, orient=False)
    inward = np.where((planes * normals).sum(1, keepdims=True) > 0, -planes, planes)
    plan = plan_of(tmp_path / "a", points, 600, inward, ratio=2)
    assert "planes" in plan.facts.poor
    assert tile_work.run_of(plan) == "surface_estimated"
    dense = make(plan)
    assert len(dense) == 3000
    near = cKDTree(points).query(dense[:, :3])[1]
    assert ((dense[:, 3:] * normals[near]).sum(1) < 0).mean() > 0.95
    keys = KEYS._replace(input=str(tmp_path / "a" / "cloud.npy"), normals="keep")
    believed = planned(tmp_path / "a", keys, 600)
    assert not believed.facts.poor
    assert tile_work.run_of(believed) == "surface"


@pytest.mark.slow
def test_lines_strays_and_attributes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    along, across = np.meshgrid(np.arange(0, 20, 0.1), np.arange(0, 20, 1.0))
    points = np.column_stack([along.ravel(), across.ravel(), 0.02 * rng.normal(size=along.size)])
    points = np.vstack([points, [[10.3, 10.3, 9]]])
    plan = plan_of(tmp_path, points, 2100, ratio=1)
    assert len(plan.tiles) == 2
    assert plan.facts.lined
    assert plan.facts.character == "scanned"
    assert tile_work.run_of(plan) == "surface_scans"
    dense = make(plan)
    assert len(dense) == len(points)
    assert np.abs(dense[:, 2]).max() < 1  # the stray one is gone
    assert tile_work.whole_of(plan).tiles[plan.cells.of_points(points[-1:])[0]].stray == 1


@pytest.mark.slow
def test_a_layer_of_noise_is_averaged(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 20, (24000, 2)), 0.2 * rng.normal(size=24000)])  # 1.5 spacings
    plan = plan_of(tmp_path, points, 13000, ratio=1)
    assert len(plan.tiles) == 2
    assert plan.facts.layered
    dense = make(plan)
    assert len(dense) == len(points)
    whole = upsample(points, ratio=1)
    assert np.abs(dense[:, 2]).mean() < 1.1 * np.abs(whole[:, 2]).mean()
    assert (np.abs(dense[:, 5]) > 0.9).mean() > 0.98


@pytest.mark.slow
def test_steps_of_depth_are_smoothed(tmp_path: Path) -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(0, 20, 0.15), np.arange(0, 20, 0.15)))
    true = 0.2 * x + np.sin(y / 4)
    points = np.column_stack([x, y, np.round(true / 0.4) * 0.4])
    plan = plan_of(tmp_path, points, 10000, ratio=1)
    assert len(plan.tiles) == 2
    assert plan.facts.steps == pytest.approx(0.4)
    (tmp_path / "keep").mkdir()
    assert plan_of(tmp_path / "keep", points, 10000, ratio=1, noise="keep").facts.steps is None
    dense = make(plan)
    off = np.abs(dense[:, 2] - 0.2 * dense[:, 0] - np.sin(dense[:, 1] / 4))
    assert off.mean() < 0.4 * np.abs(points[:, 2] - true).mean()


def test_density_follows_as_without_tiles(tmp_path: Path) -> None:
    points = sheet(900)
    points = points[(points[:, 0] < 15) | (np.arange(900) % 6 == 0)]
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    dense = make(plan_of(tmp_path, points, 200, normals, density="follow"))
    whole = upsample(points, normals, ratio=2.5, density="follow", keep=False)
    assert len(dense) == len(whole)
    np.testing.assert_allclose((dense[:, 0] < 15).mean(), (whole[:, 0] < 15).mean(), rtol=0.03)


def test_spacing_instead_of_a_ratio(tmp_path: Path) -> None:
    points = sheet(400)
    plan = plan_of(tmp_path, points, 110, spacing=0.8)
    for number in plan.tiles:
        tile_work.prepared(plan, number)
    assert tile_work.whole_of(plan).points == output_count(400, ratio_of_spacing(points, 0.8))
    with pytest.raises(ValueError, match=r"spacing=2: the points are nearer to each other"):
        tile_work.whole_of(plan_with(plan, spacing=2.0))


def plan_with(plan: Plan, **keys: object) -> Plan:
    return Plan(plan.folder, plan.keys._replace(**keys))  # type: ignore[arg-type]


def test_another_input_or_key_has_another_plan(tmp_path: Path) -> None:
    first = plan_of(tmp_path, sheet(100), 60)
    assert plan_of(tmp_path, sheet(100), 60).folder == first.folder
    assert plan_of(tmp_path, sheet(100), 60, ratio=3).folder != first.folder
    (first.folder / "plan.json").unlink()  # interrupted before it was complete
    assert plan_of(tmp_path, sheet(100), 60).facts == first.facts
    shutil.rmtree(first.folder)


def test_bad_clouds(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cloud.npy: holds 3 different points; at least 16 are needed"):
        plan_of(tmp_path / "few", sheet(3), 100)
    with pytest.raises(ValueError, match=r"cloud.npy: holds 0 points that can be used"):
        plan_of(tmp_path / "none", np.full((20, 3), np.nan), 100)
    assert not list((tmp_path / "few").glob("tiles_*"))
    with pytest.raises(ValueError, match=r"run=pnu: takes the cloud as a whole"):
        tile_work.loaded("pnu")


def test_points_push_each_other_apart_and_the_fixed_stay() -> None:
    x, y = np.meshgrid(np.arange(12.0), np.arange(12.0))
    cloud = np.column_stack([x.ravel(), y.ravel(), np.zeros((144, 1)), np.zeros((144, 2)), np.ones((144, 1))])
    cloud[[65, 66], 0] += [0.35, -0.35]
    moving = np.array([65, 66])
    order = np.concatenate([moving, np.setdiff1d(np.arange(144), moving)])
    moved = evened_out(cloud[order], 2)
    assert moved.shape == (2, 6)
    before, after = (np.linalg.norm(c[0, :3] - c[1, :3]) for c in (cloud[order], moved))
    assert before < 0.31
    assert after > 0.8
    assert (moved[:, 2] == 0).all()


def test_points_that_are_added_keep_apart() -> None:
    """From each other too, and from those of the tile beside."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 15, (225, 2)), np.zeros((225, 3)), np.ones(225)])
    tile, beside = points[points[:, 0] < 10], points[points[:, 0] >= 10]
    filled = exactly(tile, 0, len(tile) + 20, beside)
    everything = np.vstack([filled, beside])[:, :3]
    nearest = cKDTree(everything).query(filled[len(tile) :, :3], k=2)[0][:, 1]
    assert len(nearest) == 20
    assert nearest.min() > 0.5


def test_exactly_so_many() -> None:
    line = np.column_stack([[0, 1, 2, 2.1, 3, 4, 4.2, 5], *np.zeros((4, 8)), np.ones(8)])
    np.testing.assert_array_equal(exactly(line, 0, 8), line)
    assert 2.1 not in exactly(line, 4, 7)[:, 0] or 2 in exactly(line, 3, 7)[:, 0]
    assert len(exactly(line, 0, 6)) == 6
    assert (exactly(line, 4, 6)[:4] == line[:4]).all()
    more = exactly(line, 0, 10)
    assert len(np.unique(more[:, 0])) == 10
    np.testing.assert_array_equal(more[:8], line)


@pytest.mark.slow
def test_what_is_strewn_all_around_goes_and_does_not_turn_the_rest(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    sphere = rng.standard_normal((24000, 3))
    sphere *= 10 / np.linalg.norm(sphere, axis=1, keepdims=True)
    points = np.vstack([sphere, rng.uniform(-12, 12, (8000, 3))])
    plan = plan_of(tmp_path, points, 20000, ratio=1)
    assert len(plan.tiles) > 1
    dense = make(plan)
    assert len(dense) == len(points)
    radius = np.linalg.norm(dense[:, :3], axis=1)
    assert np.abs(radius - 10).max() < 1
    assert ((dense[:, :3] * dense[:, 3:]).sum(1) > 0.9 * radius).mean() > 0.999
