"""Given normals that are worse than what is found at work: of these the sides alone count."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import pnu
from pnu.cleaning import clean_cloud
from pnu.commands.upsample import main as upsample_main
from pnu.data import scanner, shapes
from pnu.geometry.cloud_normals import normals_on_sides
from pnu.geometry.mesh_sampling import closest_points, sample_area, sample_poisson_disk
from pnu.geometry.normal_estimation import estimate_normals
from pnu.io import Cloud, write_cloud
from pnu.upsamplers.context import Context
from pnu.upsamplers.inference import LoadedWeights
from pnu.upsamplers.poor_axes import poor_axes
from pnu.upsamplers.surface_projection import SurfaceProjection

Array = np.ndarray
MESH = shapes.make("bracket")
PLANES = "no better than planes fitted to neighbors"


def cloud(name: str = "bracket", n: int = 1200, noise: float = 0.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    found = sample_area(shapes.make(name), n, rng)
    return found[:, :3] + noise * rng.standard_normal((n, 3)), found[:, 3:]


def on_side(axes: Array, normals: Array) -> Array:
    return np.where((axes * normals).sum(1, keepdims=True) < 0, -axes, axes)


def fitted(points: Array, normals: Array, k: int = 16) -> Array:
    return on_side(estimate_normals(points, k, orient=False), normals)


def fitted_within(points: Array, normals: Array, radius: float) -> Array:
    """Of all neighbors within a radius, as many programs fit them."""
    axes = []
    for around in cKDTree(points).query_ball_point(points, radius):
        near = points[around] - points[around].mean(0)
        axes.append(np.linalg.eigh(near.T @ near)[1][:, 0])
    return on_side(np.array(axes), normals)


def tilted(normals: Array, degrees: float) -> Array:
    rng = np.random.default_rng(1)
    found = normals + np.radians(degrees) * rng.standard_normal(normals.shape)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def degrees(dense: Array) -> float:
    """Mean angle to the normals of the true faces."""
    faces = closest_points(MESH, dense[:, :3])[2]
    corners = MESH.vertices[MESH.faces[faces]]
    true = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.abs((dense[:, 3:] * true).sum(1)).clip(0, 1))).mean())


def off(dense: Array) -> float:
    """Mean distance from the true surface."""
    return float(closest_points(MESH, dense[:, :3])[1].mean())


@pytest.mark.parametrize("noise", [0.0, 0.004, 0.01])
@pytest.mark.parametrize("name", ["bracket", "mug", "head"])
def test_true_normals_are_good(name: str, noise: float) -> None:
    points, normals = cloud(name, noise=noise)
    assert poor_axes(points, normals) == ""
    assert poor_axes(points, tilted(normals, 2)) == ""


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_plane_fits_are_poor_whatever_their_neighbors(noise: float) -> None:
    points, normals = cloud(noise=noise)
    for k in (8, 10, 16, 30, 50):
        assert poor_axes(points, fitted(points, normals, k)) == PLANES
    apart = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    for radius in (4, 6):
        assert poor_axes(points, fitted_within(points, normals, radius * apart)) == PLANES


@pytest.mark.slow
@pytest.mark.parametrize(("n", "noise"), [(300, 0.0), (1000, 0.0), (5000, 0.0), (5000, 0.006)])
def test_true_normals_are_told_from_plane_fits_on_all_shapes(n: int, noise: float) -> None:
    for name in shapes.names():
        points, normals = cloud(name, n, noise)
        assert poor_axes(points, normals) == "", name
        assert poor_axes(points, fitted(points, normals)) == PLANES, name


def test_rough_ones_are_poor() -> None:
    points, normals = cloud()
    for much in (12, 20):
        assert poor_axes(points, tilted(normals, much)) == "rough"


def test_neither_order_nor_place_rotation_and_size_nor_some_that_are_missing_have_an_influence() -> None:
    points, normals = cloud()
    order = np.random.default_rng(2).permutation(len(points))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    for axes, why in ((normals, ""), (fitted(points, normals), PLANES), (tilted(normals, 20), "rough")):
        assert poor_axes(points, axes) == why
        assert poor_axes(points[order], axes[order]) == why
        assert poor_axes(100 * points @ turn.T + [5e5, 5e6, 300], axes @ turn.T) == why
        some = axes.copy()
        some[::7] = np.nan
        assert poor_axes(points, some) == why
    assert poor_axes(points[:40], fitted(points, normals)[:40]) == ""  # too few to judge
    assert poor_axes(points, np.full_like(points, np.nan)) == ""


@pytest.mark.slow
def test_of_poor_ones_the_sides_alone_count() -> None:
    """Bare points give as much; before, plane fits were believed, and what was made of them lay twice as far off."""
    points, normals = cloud(n=800)
    given = fitted(points, normals)
    believed, bare = pnu.upsample(points, given, ratio=2, signs="keep"), pnu.upsample(points, ratio=2)
    dense = pnu.upsample(points, given, ratio=2)
    assert off(dense) < 0.6 * off(believed)
    assert degrees(dense) < 0.8 * degrees(believed)
    assert off(dense) < 1.1 * off(bare)
    inward = pnu.upsample(points, -given, ratio=2)
    assert off(inward) < 1.3 * off(dense)  # the network knows the outside better
    near = cKDTree(points).query(inward[:, :3])[1]
    assert ((inward[:, 3:] * normals[near]).sum(1) < 0).mean() > 0.95


def test_rough_ones_do_no_harm() -> None:
    points, normals = cloud()
    given = tilted(normals, 15)
    assert off(pnu.upsample(points, given)) < 0.8 * off(pnu.upsample(points, given, signs="keep"))


def test_true_ones_are_used() -> None:
    points, normals = cloud()
    np.testing.assert_array_equal(pnu.upsample(points, normals), pnu.upsample(points, normals, signs="keep"))


@pytest.mark.slow
def test_the_command_says_so_and_can_be_told_otherwise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = sample_poisson_disk(MESH, 600, np.random.default_rng(0))
    points, normals = found[:, :3], found[:, 3:]
    path, dense = tmp_path / "scan.ply", tmp_path / "dense.ply"
    write_cloud(path, points, fitted(points, normals))
    said = f"of 600 given the sides alone are taken, their axes are found anew, they are {PLANES}"
    for keys, anew, run in (
        ([], True, "_estimated"),
        (["viewpoint=0,0,9"], True, "_estimated"),
        (["normals=keep"], False, ""),
    ):
        upsample_main([f"input={path}", f"output={dense}", "quiet=false", *keys])
        text = capsys.readouterr().out
        assert (said in text) == anew, text
        assert f"run:    surface{run} " in text


def test_smoothing_keeps_given_normals_and_moves_points_along_them() -> None:
    """As far as noise may have moved them. Of 1 % a third is left, with true normals; 0.4 after one round."""
    points, normals = cloud(n=1000)
    noisy = points + 0.01 * np.random.default_rng(1).standard_normal(points.shape)
    network = LoadedWeights("surface").network(normals, device="cpu")
    smooth = SurfaceProjection(network).smoothed(np.hstack([noisy, normals]), Context())
    np.testing.assert_array_equal(smooth[:, 3:], normals)
    step = smooth[:, :3] - noisy
    np.testing.assert_allclose(np.cross(step, normals), 0, atol=1e-14)
    assert np.linalg.norm(step, axis=1).max() < 0.04
    assert off(smooth) < 0.35 * off(np.hstack([noisy, normals]))


def test_sides_that_a_closed_shape_shows_to_be_wrong_are_not_taken() -> None:
    """Whole faces turned over, as by what follows neighbors over edges; but not what a sensor says, nor all of them."""
    points, normals = cloud(n=1500)
    given = fitted(points, normals)
    turned = np.where(normals[:, 2:] > 0.9, -given, given)
    assert 0.1 < (turned != given).any(1).mean() < 0.5

    def wrong(found: Array) -> float:
        return float(((found * normals).sum(1) < 0).mean())

    settled = normals_on_sides(points, turned)
    assert wrong(settled.normals) < 0.04
    assert "of them turned over; side: outward" in settled.words
    assert wrong(normals_on_sides(points, turned, sure=True).normals) > 0.08
    assert wrong(normals_on_sides(points, -given).normals) > 0.96  # a room
    few = normals_on_sides(points, given)
    assert wrong(few.normals) < 0.04
    assert not few.words
    dense = pnu.upsample(points, turned, ratio=2)
    near = cKDTree(points).query(dense[:, :3])[1]
    assert ((dense[:, 3:] * normals[near]).sum(1) < 0).mean() < 0.05


def test_of_an_open_surface_the_sides_stay() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (900, 2)), np.zeros(900)])
    points[:, 2] = 0.2 * np.sin(3 * points[:, 0])
    down = fitted(points, np.tile([0.0, 0.0, -1.0], (900, 1)))
    settled = normals_on_sides(points, down)
    assert (settled.normals[:, 2] < 0).all()
    assert not settled.words


@pytest.mark.parametrize("kind", ["oneview", "lines"])
def test_scans_with_plane_fits_are_treated_like_bare_ones(kind: str) -> None:
    """A camera is looked for, and says the sides; of what is fitted to lines nothing is taken."""
    scan = getattr(scanner, kind)(scanner.Scanner(MESH), np.random.default_rng(0))
    bare = clean_cloud(Cloud(scan.points, None, {}))
    found = clean_cloud(Cloud(scan.points, estimate_normals(scan.points, orient=False), {}), doubts=lambda *_: PLANES)
    np.testing.assert_array_equal(found.cloud.points, bare.cloud.points)
    assert found.cloud.normals is None
    assert found.character == bare.character == "scanned"
    assert (found.camera is None) == (bare.camera is None) == (kind == "lines")
    assert any("axes are found anew" in note for note in found.cloud.notes)
