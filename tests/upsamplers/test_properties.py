"""What must hold for `pnu.upsample` whatever the cloud, with the weights that ship.

Tolerances are in spacings, the median distance of an input point to its nearest other one. Which of the equally good
candidates are kept may differ after a rotation or another rounding; where the surface lies may not.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import pnu
from pnu import benchmark
from pnu.commands import picture, reconstruct
from pnu.commands.upsample import main as upsample_main
from pnu.data import shapes
from pnu.geometry.mesh_sampling import closest_points, sample_area, sample_poisson_disk
from pnu.io import read_cloud, read_mesh, write_cloud
from pnu.runtime.system_libraries import open3d_error
from pnu.upsamplers import surface_projection

Array = np.ndarray
MESH = shapes.make("mug")
CLOUD = sample_area(MESH, 250, np.random.default_rng(0))
POINTS, NORMALS = CLOUD[:, :3], CLOUD[:, 3:]
few = settings(max_examples=4, deadline=None, derandomize=True, database=None)


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def upsample(points: Array, normals: Array | None, ratio: float = 2, **options: Any) -> Array:
    return pnu.upsample(points, normals, ratio=ratio, model="surface", **options)


def spacing(points: Array) -> float:
    return float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def apart(a: Array, b: Array) -> float:
    """The greatest distance of a point of one cloud to the other."""
    return max(cKDTree(a[:, :3]).query(b[:, :3])[0].max(), cKDTree(b[:, :3]).query(a[:, :3])[0].max())


def error(dense: Array) -> float:
    """Mean distance to the true surface."""
    return float(closest_points(MESH, dense[:, :3])[1].mean())


@pytest.fixture(scope="module", params=["given", "estimated"])
def normals(request: pytest.FixtureRequest) -> Array | None:
    return NORMALS if request.param == "given" else None


@pytest.fixture(scope="module")
def dense(normals: Array | None) -> Array:
    return upsample(POINTS, normals)


def turned(normals: Array | None, rotation: Rotation) -> Array | None:
    return None if normals is None else rotation.apply(normals)


def same_surface(dense: Array, other: Array) -> None:
    assert apart(dense, other) < 2.5 * spacing(POINTS)
    assert error(other) == pytest.approx(error(dense), rel=0.25)
    nearest = cKDTree(dense[:, :3]).query(other[:, :3])[1]
    cosine = (dense[nearest, 3:] * other[:, 3:]).sum(1)
    assert np.median(cosine) > np.cos(np.radians(8))
    assert (cosine < 0).mean() < 0.03


def test_order(dense: Array, normals: Array | None) -> None:
    order = np.random.default_rng(1).permutation(len(POINTS))
    shuffled = upsample(POINTS[order], None if normals is None else normals[order])
    np.testing.assert_array_equal(shuffled, dense)


def test_duplicates(dense: Array, normals: Array | None) -> None:
    more = np.r_[0 : len(POINTS), 0:50]
    repeated = upsample(POINTS[more], None if normals is None else normals[more])
    np.testing.assert_array_equal(repeated, dense)


def test_rigid_motion(dense: Array, normals: Array | None) -> None:
    rotation = Rotation.from_euler("xyz", [0.3, 1, 2])
    moved = upsample(rotation.apply(POINTS) + [3, -2, 9], turned(normals, rotation))
    back = np.hstack([rotation.inv().apply(moved[:, :3] - [3, -2, 9]), rotation.inv().apply(moved[:, 3:])])
    same_surface(dense, back)


@pytest.mark.slow
@few
@given(st.floats(-6, 6))
def test_scale(exponent: float) -> None:
    scale = 10**exponent
    scaled = upsample(POINTS * scale, NORMALS)
    scaled[:, :3] /= scale
    same_surface(upsample(POINTS, NORMALS), scaled)


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_scale_by_a_power_of_two(dense: Array, normals: Array | None, scale: float) -> None:
    scaled = upsample(POINTS * scale, normals)
    np.testing.assert_array_equal(scaled, dense * np.repeat([scale, 1], 3))


def test_millimetres_at_map_coordinates(dense: Array, normals: Array | None) -> None:
    """An object of two metres, given in metres, thousands of kilometres from the origin."""
    place = np.array([4_123_456.789, 5_312_345.678, 123.4])
    moved = upsample(POINTS + place, normals)
    same_surface(dense, moved - np.r_[place, 0, 0, 0])
    assert len(np.unique(np.round(moved[:, 0] % 1, 6))) > len(moved) / 2, "less than float64 somewhere on the way"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["ply", "xyz", "las", "laz", "pcd", "npy"])
def test_millimetres_at_map_coordinates_through_the_commands(tmp_path: Path, suffix: str) -> None:
    """A mug of ten centimetres: what is written and drawn is that of the mug at the origin."""
    place, scale = np.array([4_123_456.789, 5_312_345.678, 123.4]), 0.05
    write_cloud(tmp_path / f"scan.{suffix}", POINTS * scale + place, NORMALS)
    files = [tmp_path / name for name in (f"scan.{suffix}", f"dense.{suffix}", "mesh.ply")]
    scan, dense, mesh = files
    upsample_main([f"input={scan}", f"output={dense}", "run=surface", "quiet=true"])
    found = read_cloud(dense)
    assert error((found.points - place) / scale) < 1.05 * error(upsample(POINTS, NORMALS, ratio=4)) + 1e-4
    if not open3d_error():
        reconstruct.main([f"input={dense}", f"output={mesh}", "quiet=true"])
        assert error((read_mesh(mesh).vertices - place) / scale) < 0.02
    drawn = [str(path) for path in files if path.exists()]
    picture.main([f"inputs=[{','.join(drawn)}]", f"output={tmp_path / 'figure.png'}", "size=200", "quiet=true"])
    with Image.open(tmp_path / "figure.png") as figure:
        assert figure.height > 150, "the mug fills its panel"


@pytest.mark.parametrize("options", [{"batch_size": 33}, {"batch_size": 200}])
def test_batch_size(dense: Array, normals: Array | None, options: dict[str, int]) -> None:
    same_surface(dense, upsample(POINTS, normals, **options))


def test_threads(dense: Array, normals: Array | None) -> None:
    torch.set_num_threads(2)
    try:
        same_surface(dense, upsample(POINTS, normals))
    finally:
        torch.set_num_threads(1)


@pytest.mark.parametrize("far", [100.0, 1e6])
def test_two_distant_pieces(normals: Array | None, far: float) -> None:
    both = np.concatenate([POINTS, POINTS + [far, 0, 0]])
    dense = upsample(both, None if normals is None else np.tile(normals, (2, 1)))
    assert cKDTree(both).query(dense[:, :3])[0].max() < 5 * spacing(POINTS), "points between the pieces"
    assert (dense[:, 0] > far / 2).mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("given", [True, False])
def test_plane(given: bool) -> None:
    flat = np.random.default_rng(0).random((250, 3)) * [1, 1, 0]
    rotation = Rotation.from_euler("xyz", [0.3, 1, 2])
    dense = upsample(rotation.apply(flat), rotation.apply([[0, 0, 1.0]] * 250) if given else None)
    points, directions = rotation.inv().apply(dense[:, :3]), rotation.inv().apply(dense[:, 3:])
    assert np.abs(points[:, 2]).max() < 0.5 * spacing(flat)
    assert np.abs(directions[:, 2]).min() > 0.99
    assert np.ptp(np.sign(directions[:, 2])) == 0, "one side"
    beyond = np.maximum(-points[:, :2], points[:, :2] - 1).max(axis=1) / spacing(flat)
    assert (beyond > 4).mean() < 0.005
    assert beyond.max() < 5


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_line_is_no_surface(given: bool, scale: float) -> None:
    line = scale * np.linspace(0, 1, 50)[:, None] * [1, 2, 3.0] + 7 * scale
    with pytest.raises(ValueError, match="points: all 50 points lie on a line; expected points on a surface"):
        upsample(line, np.tile([3, 0, -1.0], (50, 1)) if given else None)


@few
@given(st.integers(0, 2**32), st.integers(16, 90), st.sampled_from([1.0, 1.7, 4.0]), st.booleans())
def test_any_cloud_gives_unit_normals_near_its_points(seed: int, n: int, ratio: float, given: bool) -> None:
    """Also points in no order at all, some of them far away or repeated."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-3, 3, size=3) * 10 ** rng.uniform(0, 2, size=(n, 1))
    directions = rng.normal(size=(n, 3)) if given else None
    dense = upsample(points, directions, ratio)
    assert dense.shape == (round(ratio * n), 6)
    np.testing.assert_allclose(np.linalg.norm(dense[:, 3:], axis=1), 1, atol=1e-6)
    size = np.ptp(points, axis=0).max()
    assert np.isfinite(dense).all()
    assert np.abs(dense[:, :3] - points.mean(0)).max() < 3 * size


def measured(names: list[str]) -> dict[str, dict[str, float]]:
    """Metrics of the clouds of two meshes, taken in this order."""
    meshes = {name: (lambda name=name: shapes.make(name)) for name in names}
    drawn = benchmark.mesh_cases(meshes, ["random"], points=200, truth_points=800, warn=lambda text: None)
    return {case.truth.shape: benchmark.measure(np.hstack([case.points, case.normals]), case.truth) for case in drawn}


@pytest.mark.parametrize(("shape", "ratio", "given"), [("mug", 2, True), ("horse", 4, False), ("urchin", 7.3, True)])
def test_every_point_given_has_one_within_half_a_spacing(shape: str, ratio: float, given: bool) -> None:
    cloud = sample_area(shapes.make(shape), 400, np.random.default_rng(5))
    dense = upsample(cloud[:, :3], cloud[:, 3:] if given else None, ratio, keep=False, outliers="keep")
    around = cKDTree(cloud[:, :3]).query(cloud[:, :3], 7)[0][:, 1:].mean(1)
    share = cKDTree(dense[:, :3]).query(cloud[:, :3])[0] / around
    assert (share > 0.5).mean() < 0.005  # a tip may end a little before its point
    assert share.max() < 0.7


@pytest.mark.parametrize(("shape", "noise"), [("queen", 0.003), ("horse", 0.006), ("queen", 0.01)])
def test_every_noisy_point_has_one_within_a_quarter_of_a_spacing_and_the_noise(shape: str, noise: float) -> None:
    rng = np.random.default_rng(5)
    points = sample_poisson_disk(shapes.make(shape), 1200, rng)[:, :3]
    points += rng.normal(scale=noise, size=points.shape)
    dense = pnu.upsample(points)
    around = cKDTree(points).query(points, 7)[0][:, 1:].mean(1)
    apart = cKDTree(dense[:, :3]).query(points)[0]
    assert (apart < 0.25 * around + noise).all()


def test_points_stay_also_where_thin_walls_look_like_noise() -> None:
    """Between fins rough normals see noise, refined ones do not: either way each point has one near."""
    points = sample_poisson_disk(shapes.make("heat_sink"), 1000, np.random.default_rng(5))[:, :3]
    dense = pnu.upsample(points)
    around = cKDTree(points).query(points, 7)[0][:, 1:].mean(1)
    assert (cKDTree(dense[:, :3]).query(points)[0] < 0.15 * around).all()


@pytest.mark.parametrize(("axis", "noise"), [(1.0, 0.02), (0.4, 0.01)])
def test_noise_shrinks_nothing(axis: float, noise: float) -> None:
    """A sphere, and an ellipsoid with tips: mean distance from the true surface, inside or outside, in noises."""
    size = np.array([1, axis, axis])
    solid = trimesh.creation.icosphere(5).apply_scale(size)
    points, _ = trimesh.sample.sample_surface(solid, 2500, seed=1)
    points = points + noise * np.random.default_rng(1).standard_normal(points.shape)
    dense = pnu.upsample(points)[:, :3]
    level = np.linalg.norm(dense / size, axis=1)  # 1 on the surface; its slope makes a distance of the difference
    outside = (level - 1) * level / np.linalg.norm(dense / size**2, axis=1)
    assert abs(outside.mean()) < 0.1 * noise
    assert abs(outside[np.abs(dense[:, 0]) > 0.9].mean()) < 0.2 * noise
    assert abs(np.abs(dense[:, 0]).max() - 1) < 0.6 * noise


def test_metrics_depend_neither_on_threads_nor_on_the_order_of_files() -> None:
    one = measured(["mug", "nut"])
    torch.set_num_threads(3)
    try:
        assert measured(["nut", "mug"]) == one
    finally:
        torch.set_num_threads(1)


def test_points_at_rest_are_not_refined_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most are after one refinement; the others make the same surface as if all were refined again."""
    totals: dict[str, int] = {}
    few = upsample(POINTS, NORMALS, 4, progress=lambda stage, done, total: totals.update({stage: total}))
    assert totals["refinement 2"] < 0.7 * totals["refinement 1"]
    monkeypatch.setattr(surface_projection, "AT_REST", -1.0)
    everything = upsample(POINTS, NORMALS, 4, progress=lambda stage, done, total: totals.update({stage: total}))
    assert totals["refinement 2"] == totals["refinement 1"]
    assert error(few) == pytest.approx(error(everything), rel=0.02)
    assert (cKDTree(everything[:, :3]).query(few[:, :3])[0] < 0.05 * spacing(POINTS)).mean() > 0.97
