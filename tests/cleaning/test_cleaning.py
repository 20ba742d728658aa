"""Cleaning: stray points are found and taken out, scan lines are evened out, and it is said."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import pnu
from pnu.cleaning import clean_cloud
from pnu.cleaning.outliers import small_pieces, stray_points
from pnu.commands.upsample import main
from pnu.data import shapes
from pnu.data.scanner import KINDS, DepthCamera, Scanner, random_turn
from pnu.geometry.anisotropy import averaged, evenness, thinned_lines
from pnu.geometry.doubt_features import DOUBT_FEATURES
from pnu.geometry.mesh_sampling import sample_area
from pnu.geometry.outlier_features import FEATURES, NEIGHBORS, outlier_features
from pnu.geometry.sphere_directions import sphere_directions
from pnu.io import Cloud, read_cloud
from pnu.training.outlier_training import examples_of_doubt, examples_of_pictures, train_detector
from pnu.upsamplers.inference import weights_source


def sphere(n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).standard_normal((n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def with_strays(n: int = 2000, strays: int = 40) -> np.ndarray:
    """A unit sphere, then points inside it and around it, at least a tenth off."""
    rng = np.random.default_rng(1)
    radius = np.where(rng.random(strays) < 0.5, rng.uniform(0.2, 0.85, strays), rng.uniform(1.15, 2, strays))
    return np.vstack([sphere(n), radius[:, None] * sphere(strays, 2)])


def test_strays_of_a_sphere_are_found_and_nothing_else() -> None:
    stray = stray_points(with_strays())
    assert stray[2000:].mean() > 0.95
    assert stray[:2000].mean() < 0.005


@pytest.mark.parametrize("name", [*shapes.names()[::9], "walnut"])
def test_clean_clouds_lose_nothing(name: str) -> None:
    points = sample_area(shapes.make(name), 3000, np.random.default_rng(0))[:, :3]
    assert not stray_points(points).any()


def test_order_place_rotation_and_size_have_no_influence() -> None:
    points = with_strays()
    stray = stray_points(points)
    order = np.random.default_rng(0).permutation(len(points))
    assert (stray_points(points[order]) == stray[order]).all()
    turn = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    for moved in (1e6 * points, 1e-6 * points, points @ turn.T, points + [1000, 0, 0]):
        assert (stray_points(moved) != stray).mean() < 0.001


def test_one_point_a_million_away() -> None:
    points = np.vstack([sphere(500), [[1e6, 0, 0]]])
    assert stray_points(points).nonzero()[0].tolist() == [500]


def test_pieces_of_a_few_points_that_stand_apart() -> None:
    clump = [3, 0, 0] + 0.05 * sphere(8, 3)
    points = np.vstack([sphere(1000), clump])
    assert small_pieces(points).nonzero()[0].tolist() == list(range(1000, 1008))
    assert not small_pieces(np.vstack([sphere(1000), [3, 0, 0] + sphere(1000)])).any()


def test_local_outlier_factor_by_its_definition() -> None:
    points = with_strays(60, 4)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = np.argsort(apart, axis=1)[:, 1:9]  # 8 neighbors
    far = np.take_along_axis(apart, near[:, -1:], 1)[:, 0]
    reach = np.maximum(np.take_along_axis(apart, near, 1), far[near]).mean(1)
    factor = np.log(reach * np.array([(1 / reach[list(rows)]).mean() for rows in near]))
    found = outlier_features(points)
    assert found.shape == (64, FEATURES)
    np.testing.assert_allclose(found[:, -6], factor, atol=1e-5)


def test_features_of_fewer_points_than_neighbors() -> None:
    found = outlier_features(sphere(NEIGHBORS // 2))
    assert found.shape == (NEIGHBORS // 2, FEATURES)
    assert np.isfinite(found).all()


def lines(across: int = 24, along: int = 240, noise: float = 0.0) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, 1, along), np.linspace(0, 1, across))
    return np.stack([u.ravel(), v.ravel(), noise * np.random.default_rng(0).standard_normal(u.size)], 1)


def thick_sphere(n: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Points around the unit sphere, and the true ones."""
    rng = np.random.default_rng(0)
    true = rng.normal(size=(n, 3))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    return true + noise * rng.normal(size=true.shape), true


@pytest.mark.slow
def test_a_layer_of_noise_becomes_a_surface() -> None:
    points, true = thick_sphere(60000, 0.02)
    cleaned = clean_cloud(Cloud(points, None, {}))
    assert " means stand for " in cleaned.cloud.notes[-1]
    assert cleaned.character == "noisy"
    dense = pnu.upsample(points, ratio=1)
    assert len(dense) == 60000
    radius = np.linalg.norm(dense[:, :3], axis=1)
    assert np.abs(radius - 1).mean() < 0.002  # 0.0035 with noise=keep
    cosine = (dense[:, :3] / radius[:, None] * dense[:, 3:]).sum(1)
    assert (cosine < 0).mean() < 0.001  # 0.08 with noise=keep
    assert np.degrees(np.arccos(np.abs(cosine).clip(0, 1))).mean() < 2  # 3.7
    normals = pnu.normals(points)
    assert normals.shape == points.shape
    assert ((normals * true).sum(1) > 0.9).mean() > 0.99


def test_a_layer_of_noise_may_stay() -> None:
    points, _ = thick_sphere(12000, 0.05)
    means = clean_cloud(Cloud(points, None, {}), outliers="keep")
    assert len(means.cloud.points) < 10000
    assert "means stand for 12000 points (noise=keep)" in means.cloud.notes[-1]
    kept = clean_cloud(Cloud(points, None, {}), outliers="keep", noise="keep")
    np.testing.assert_array_equal(kept.cloud.points, points)
    with pytest.raises(ValueError, match="noise=never: expected auto or keep"):
        clean_cloud(Cloud(points, None, {}), noise="never")  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_layer_with_normals_keeps_their_means() -> None:
    points, true = thick_sphere(20000, 0.05)
    found = clean_cloud(Cloud(points, true, {})).cloud
    assert found.normals is not None
    assert len(found.points) < 12000
    assert (found.normals * found.points).sum(1).min() > 0.9 * 0.8
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1)


def test_lines_are_thinned_to_their_distance() -> None:
    points = lines()
    assert evenness(points) < 0.2 < 0.5 < evenness(sphere(2000))
    rows = thinned_lines(points)
    assert rows is not None
    assert evenness(points[rows]) > 0.5
    nearest = cKDTree(points[rows]).query(points[rows], 2)[0][:, 1]
    assert np.median(nearest) > 1.9 / 239  # along the lines; before: 1/239
    assert thinned_lines(sphere(2000)) is None


def test_the_mean_of_a_line_s_points_has_less_noise() -> None:
    points = lines(noise=0.002)
    rows = thinned_lines(points)
    assert rows is not None
    assert averaged(points, rows)[:, 2].std() < 0.8 * points[rows, 2].std()


def test_clean_cloud_says_what_it_did_and_keeps_what_it_is_told_to() -> None:
    points = with_strays()
    cloud = Cloud(points, None, {"row": np.arange(len(points))})
    cleaned = clean_cloud(cloud)
    assert set(cleaned.stray) | set(cleaned.cloud.attributes["row"]) == set(range(len(points)))
    assert f"{len(cleaned.stray)} of 2040 points left out: stray" in cleaned.cloud.notes[-1]
    kept = clean_cloud(cloud, outliers="keep", lines="keep")
    assert (kept.cloud.points == points).all()
    assert not len(kept.stray)
    with pytest.raises(ValueError, match="outliers=away: expected auto or keep"):
        clean_cloud(cloud, outliers="away")  # type: ignore[arg-type]


def test_strays_do_not_multiply() -> None:
    points = with_strays(1000, 20)
    dense = pnu.upsample(points, ratio=4)
    assert dense.shape == (4080, 6)
    assert np.abs(np.linalg.norm(dense[:, :3], axis=1) - 1).max() < 0.05
    kept = pnu.upsample(points, ratio=4, outliers="keep")
    assert (np.abs(np.linalg.norm(kept[:, :3], axis=1) - 1) > 0.05).sum() > 20


def test_the_command_says_it_and_writes_what_it_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savetxt("cloud.xyz", with_strays(1000, 20))
    main(["input=cloud.xyz", "output=dense.ply", "removed=removed.ply"])
    said = capsys.readouterr().out
    removed = read_cloud(tmp_path / "removed.ply", minimum=1).points
    assert f"{len(removed)} of 1020 points left out: stray" in said
    assert "removed.ply" in said
    assert (np.abs(np.linalg.norm(removed, axis=1) - 1) > 0.1).mean() > 0.9
    assert len(read_cloud(tmp_path / "dense.ply").points) == 4080


@pytest.mark.parametrize("kind", KINDS)
def test_scans_have_the_truth_beside_them(kind: str) -> None:
    scanner = Scanner(shapes.make(shapes.names()[0]))
    scan, again = (KINDS[kind](scanner, np.random.default_rng(3)) for _ in range(2))
    assert (scan.points == again.points).all()
    assert len(scan.points) == len(scan.clean) == len(scan.sensor) == len(scan.stray) > 500
    off = np.linalg.norm(scan.points - scan.clean[:, :3], axis=1)[~scan.stray]
    assert 0.0005 < np.median(off) < 0.01
    if kind in ("orbit", "oneview", "depth", "lines"):
        toward = scan.sensor - scan.clean[:, :3]
        assert ((toward * scan.clean[:, 3:]).sum(1) > 0).all()  # a sensor sees the side that faces it


@pytest.mark.parametrize("name", ["teddy", pytest.param("bracket", marks=pytest.mark.slow)])
def test_steps_of_depth_become_the_surface_that_runs_through_them(name: str) -> None:
    scan = KINDS["depth"](Scanner(shapes.make(name)), np.random.default_rng(3))
    cleaned = clean_cloud(Cloud(scan.points, None, {}), outliers="keep")
    assert "each point moved by half a step at most" in cleaned.cloud.notes[0]
    off, raw = (
        np.abs(((points - scan.clean[:, :3]) * scan.clean[:, 3:]).sum(1)).mean()
        for points in (cleaned.cloud.points, scan.points)
    )
    assert off < 0.6 * raw
    kept = clean_cloud(Cloud(scan.points, None, {}), outliers="keep", noise="keep").cloud
    np.testing.assert_array_equal(kept.points, scan.points)
    normals = pnu.normals(scan.points)
    assert np.degrees(np.arccos((normals * scan.clean[:, 3:]).sum(1).clip(-1, 1))).mean() < 10


@pytest.mark.slow
def test_scanned_clouds_take_weights_of_their_own() -> None:
    cleaned = clean_cloud(Cloud(lines(noise=0.001), None, {}))
    assert cleaned.character == "scanned"
    assert weights_source("surface", None, cleaned.character) == "surface_scans"
    assert weights_source("surface", None) == "surface_estimated"
    dense = pnu.upsample(lines(noise=0.001), ratio=1)
    inside = (np.abs(dense[:, :2] - 0.5) < 0.45).all(1)
    assert np.abs(dense[inside, 2]).mean() < 0.0006  # of 0.0008


def test_noisy_clouds_take_weights_of_their_own() -> None:
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(4200, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    noisy = unit + 0.03 * rng.normal(size=unit.shape)
    assert clean_cloud(Cloud(noisy[:2000], None, {})).character == "clean"  # they would smooth over parts of so few
    assert clean_cloud(Cloud(unit, None, {})).character == "clean"
    assert clean_cloud(Cloud(noisy, unit, {})).character == "clean"  # where normals are given they tell
    cleaned = clean_cloud(Cloud(noisy, None, {}))
    assert cleaned.character == "noisy"
    assert weights_source("surface", None, cleaned.character) == "surface_noisy"
    assert weights_source("surface", unit, "noisy") == "surface"
    off = {name: off_sphere(pnu.upsample(noisy, ratio=2, model=name)) for name in ("surface", "surface_estimated")}
    assert off["surface"] < 0.95 * off["surface_estimated"]


def off_sphere(dense: np.ndarray) -> float:
    """Mean distance of a cloud from the unit sphere."""
    return float(np.abs(np.linalg.norm(dense[:, :3], axis=1) - 1).mean())


def test_normals_that_contradict_each_other_are_turned_their_axes_kept() -> None:
    points = sphere(2000)
    wrong = (points[:, 0] > 0.3) & (points[:, 1] > 0.2)
    given = np.where(wrong[:, None], -points, points)
    given[::7] *= -1
    cleaned = clean_cloud(Cloud(points, given, {})).cloud
    assert cleaned.normals is not None
    assert ((cleaned.normals * points).sum(1) > 0.999).all()
    assert "turned over" in cleaned.notes[-1]
    kept = clean_cloud(Cloud(points, given, {}), signs="keep").cloud
    assert kept.normals is given
    dense = pnu.upsample(points, given, ratio=2)
    assert ((dense[:, :3] * dense[:, 3:]).sum(1) > 0.9).all()


def test_tips_of_an_evenly_spread_cloud_stay() -> None:
    rod = np.linspace(1.1, 3, 20)[:, None] * [0.0, 0, 1]  # a spike on a ball: a row of points in the ball's spacing
    i = np.arange(1000) + 0.5
    z, angle = 1 - i / 500, np.pi * (1 + np.sqrt(5)) * i
    ball = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)
    assert not stray_points(np.vstack([ball, rod])).any()
    alone = np.array([[1.3, 0, 0], [-1.5, 0.2, 0], [0, 0, -2.0], [0, 1.4, 0.3]])
    np.testing.assert_array_equal(np.flatnonzero(stray_points(np.vstack([ball, rod, alone]))), np.arange(1020, 1024))


def test_strays_all_over_the_room_are_found() -> None:
    rng = np.random.default_rng(0)
    points = sample_area(shapes.make("teddy"), 3000, rng)[:, :3]
    strays = rng.uniform(-1.2, 1.2, (300, 3))
    far = cKDTree(points).query(strays)[0] > 0.1
    stray = stray_points(np.vstack([points, strays]))
    assert stray[:3000].sum() <= 3
    assert stray[3000:][far].mean() > 0.97


@pytest.mark.slow
def test_a_cloud_that_thins_out_keeps_its_thin_end() -> None:
    """Photogrammetry has few points where it sees little; between strays elsewhere they were taken for such."""
    mesh = shapes.make("horse")
    lost = []
    for seed in range(3):
        scan = KINDS["photo"](Scanner(mesh), np.random.default_rng(seed))
        good = ~scan.stray & (np.linalg.norm(scan.points - scan.clean[:, :3], axis=1) < 0.015)
        lost.append((stray_points(scan.points) & good).sum() / good.sum())
    assert np.mean(lost) < 0.0006


@pytest.mark.slow
@pytest.mark.parametrize(("in_place", "most"), [(True, 0.2), (False, 0.02)])
@pytest.mark.parametrize("name", ["person", "impeller"])
def test_torn_points_of_a_depth_camera_go_and_slanted_walls_stay(name: str, in_place: bool, most: float) -> None:
    torn = left = lost = 0
    camera = DepthCamera(2.6, 0.42, 110, 110, slant=0.1, step=0.004, torn=0.25, in_place=in_place)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scan = Scanner(shapes.make(name)).views(2.6 * sphere_directions(7, random_turn(rng))[:1], camera, rng)
        cleaned = clean_cloud(Cloud(scan.points, None, {}))
        assert cleaned.camera is not None
        assert cleaned.character == "scanned"
        assert "torn off at edges, as a camera at" in cleaned.cloud.notes[-1]
        gone = np.isin(np.arange(len(scan.points)), cleaned.stray)
        # those that are less off may lie on another surface
        far = scan.stray & (np.linalg.norm(scan.points - scan.clean[:, :3], axis=1) > 0.1)
        torn, left, lost = torn + far.sum(), left + (far & ~gone).sum(), lost + (gone & ~scan.stray).sum()
    assert torn > 100
    assert left < most * torn
    assert lost < 0.1 * torn


@pytest.mark.slow
def test_the_network_for_doubtful_points_is_trained_in_moments_on_a_shape() -> None:
    examples = examples_of_doubt([shapes.make("teddy")], 0)
    assert examples.features.shape == (len(examples.stray), DOUBT_FEATURES)
    network = train_detector(examples, steps=200)
    odds = network(examples.features).detach()
    stray = examples.stray.bool()
    assert (odds[stray].median() > odds[~stray].quantile(0.95)).item()


def test_the_network_for_pictures_is_trained_in_moments_on_a_shape() -> None:
    examples = examples_of_pictures([shapes.make("teddy")], 0)
    network = train_detector(examples, steps=60)
    odds = network(examples.features).detach()
    counts = examples.weight > 0
    stray = examples.stray.bool()
    assert (odds[stray].median() > odds[~stray & counts].quantile(0.98)).item()
