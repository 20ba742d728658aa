"""Clutter: what is strewn all around a surface goes, however much it is, and sparse places and trees stay."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pnu
from pnu.cleaning.outliers import stray_points
from pnu.commands.reconstruct import main as reconstruct_command
from pnu.data import shapes
from pnu.geometry.clutter import FEWEST, clutter_points
from pnu.geometry.mesh_sampling import sample_area
from pnu.io import read_mesh

FAR = 0.06  # from a unit sphere of 4000 points: about two of their distances


def sphere(n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).standard_normal((n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def strewn(kind: str, n: int) -> np.ndarray:
    """Points (n, 3) in a box, in a ball, thinning out from the middle, beside a unit sphere."""
    rng = np.random.default_rng(2)
    if kind == "box":
        return rng.uniform(-1.5, 1.5, (n, 3))
    if kind == "ball":
        return 2 * rng.random((n, 1)) ** (1 / 3) * sphere(n, 3)
    return sphere(n, 4) + 0.2 * rng.standard_normal((n, 3)) if kind == "halo" else rng.standard_normal((n, 3))


def off(points: np.ndarray) -> np.ndarray:
    """Distances (n,) from the unit sphere."""
    return np.abs(np.linalg.norm(points, axis=1) - 1)


@pytest.mark.parametrize("share", [0.15, 0.3, 0.5])
@pytest.mark.parametrize("kind", ["box", "ball", "middle", "halo"])
def test_what_is_strewn_goes_and_all_of_the_surface_stays(kind: str, share: float) -> None:
    count = round(4000 * share / (1 - share))
    points = np.vstack([sphere(4000), strewn(kind, count)])
    stray = stray_points(points)
    far = off(points) > FAR
    assert not stray[:4000].any()
    assert stray[far].mean() > (0.75 if kind == "halo" else 0.99)


def test_the_dense_cloud_lies_on_the_surface() -> None:
    dense = pnu.upsample(np.vstack([sphere(3000), strewn("box", 1500)]))
    assert dense.shape == (18000, 6)
    assert off(dense[:, :3]).max() < 0.1
    assert off(dense[:, :3]).mean() < 0.003


def test_normals_are_found_without_it() -> None:
    points = np.vstack([sphere(3000), strewn("box", 1000)])
    normals = pnu.normals(points)
    assert normals.shape == points.shape
    assert (normals[:3000] * points[:3000]).sum(1).mean() > 0.999


def test_the_surface_of_a_cloud_is_that_without_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savetxt(tmp_path / "cloud.xyz", np.vstack([sphere(3000), strewn("box", 1000)]))
    reconstruct_command([f"input={tmp_path}/cloud.xyz", f"output={tmp_path}/mesh.ply"])
    assert "of 4000 points left out: strewn all around (normals=keep)" in capsys.readouterr().out
    assert off(read_mesh(tmp_path / "mesh.ply").vertices).max() < 0.1


def thinning_out(points: np.ndarray, most: float) -> np.ndarray:
    """Points that get sparser along z, to one of so many."""
    height = (points[:, 2] - points[:, 2].min()) / np.ptp(points[:, 2])
    return points[np.random.default_rng(5).random(len(points)) < most**-height]


def grown() -> np.ndarray:
    """A hilly ground, 40 trees whose crowns fill space, and what grows beneath them, denser than the crowns."""
    rng = np.random.default_rng(6)
    ground = rng.uniform(0, 60, (30000, 2))
    parts = [np.column_stack([ground, 1.5 * np.sin(ground[:, 0] / 15) + np.cos(ground[:, 1] / 11)])]
    for _ in range(40):
        middle, radius = np.append(rng.uniform(0, 60, 2), rng.uniform(6, 18)), rng.uniform(1.5, 4)
        parts.append(middle + radius * rng.random((600, 1)) ** (1 / 3) * sphere(600, int(rng.integers(1000))))
        parts.append(middle + rng.uniform(-1, 1, (100, 3)) * [radius, radius, middle[2] / 2] - [0, 0, middle[2] / 2])
    return np.vstack(parts)


def vertices_of_a_lattice() -> np.ndarray:
    return np.unique(shapes.make("lattice_cube").vertices, axis=0)


NO_CLUTTER: dict[str, Callable[[], np.ndarray]] = {
    "even": lambda: sphere(5000),
    "noisy": lambda: sphere(5000) + 0.05 * np.random.default_rng(0).standard_normal((5000, 3)),
    "heavy tails": lambda: sphere(5000) + 0.005 * np.random.default_rng(0).standard_t(2, (5000, 3)),
    "few strays": lambda: np.vstack([sphere(5000), strewn("box", 100)]),
    "a full ball": lambda: strewn("ball", 5000),
    "trees": grown,
    "vertices": vertices_of_a_lattice,
    "few": lambda: np.vstack([sphere(FEWEST - 50), strewn("box", 49)]),
}


@pytest.mark.parametrize("kind", NO_CLUTTER)
def test_other_clouds_have_none(kind: str) -> None:
    assert not clutter_points(NO_CLUTTER[kind]()).any()


@pytest.mark.parametrize("name", ["bracket", "mug", "gyroid", "knot_3_4", "impeller", "heat_sink"])
def test_sparse_places_are_none(name: str) -> None:
    points = sample_area(shapes.make(name), 30000, np.random.default_rng(0))[:, :3]
    for most in (20, 150):
        assert not clutter_points(thinning_out(points, most)).any()


def test_order_place_rotation_and_size_have_no_influence() -> None:
    points = np.vstack([sphere(2000), strewn("box", 800)])
    found = clutter_points(points)
    assert 600 < found.sum() < 800
    order = np.random.default_rng(0).permutation(len(points))
    assert (clutter_points(points[order]) == found[order]).all()
    turn = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    for moved in (1e6 * points, 1e-6 * points, points @ turn.T, points + [1000, 0, 0]):
        assert (clutter_points(moved) != found).mean() < 0.001
