"""Poisson surfaces: exact bodies, orientation, trimming, a child that fails, errors against the truth."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pnu import reconstruction
from pnu.geometry.mesh_sampling import signed_volume
from pnu.geometry.mesh_topology import open_edges, vertex_normals
from pnu.io import Mesh
from pnu.reconstruction import poisson_process, screened_poisson


def sphere_points(n: int, seed: int = 0) -> np.ndarray:
    """Uniform on the unit sphere, with normals, (n, 6)."""
    points = np.random.default_rng(seed).normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.hstack([points, points])


def torus_points(n: int, tube: float = 0.4) -> np.ndarray:
    """Uniform by area on the torus with radii 1 and `tube`."""
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, 2 * np.pi, (2, 4 * n))
    kept = rng.uniform(0, 1 + tube, 4 * n) < 1 + tube * np.cos(v)
    u, v = u[kept][:n], v[kept][:n]
    normal = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], 1)
    return np.hstack([np.stack([np.cos(u), np.sin(u), 0 * u], 1) + tube * normal, normal])


def box_points(n: int, sides: tuple[float, float, float] = (2.0, 1.6, 1.2)) -> np.ndarray:
    rng = np.random.default_rng(2)
    half = np.array(sides) / 2
    area = np.repeat(half.prod() / half, 2)
    face = rng.choice(6, n, p=area / area.sum())
    points, normals = rng.uniform(-half, half, (n, 3)), np.zeros((n, 3))
    sign = np.where(face % 2, 1.0, -1.0)
    points[np.arange(n), face // 2] = sign * half[face // 2]
    normals[np.arange(n), face // 2] = sign
    return np.hstack([points, normals])


def icosphere(levels: int = 4) -> Mesh:
    """An octahedron cut up and blown into the unit sphere."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    corners = vertices[faces]
    for _ in range(levels):
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), index.reshape(-1, 3))


@pytest.mark.parametrize(
    ("cloud", "volume", "tolerance"),
    [
        (sphere_points(5000), 4 / 3 * np.pi, 0.01),
        pytest.param(torus_points(5000), 2 * np.pi**2 * 0.4**2, 0.01, marks=pytest.mark.slow),
        pytest.param(box_points(5000), 2.0 * 1.6 * 1.2, 0.02, marks=pytest.mark.slow),
    ],
    ids=["sphere", "torus", "box"],
)
def test_exact_points_give_the_exact_volume(cloud: np.ndarray, volume: float, tolerance: float) -> None:
    surface = reconstruction.reconstruct(cloud[:, :3], cloud[:, 3:])
    assert signed_volume(surface.mesh) == pytest.approx(volume, rel=tolerance)
    assert open_edges(surface.mesh) == 0
    assert not surface.inside_out
    assert surface.warnings() == []


@pytest.mark.slow
def test_inward_normals_are_noticed_in_any_frame_and_the_surface_turned() -> None:
    cloud = sphere_points(1500)
    away = np.array([5e5, 4e6, -30])
    surface = reconstruction.reconstruct(100 * cloud[:, :3] + away, -7 * cloud[:, 3:])
    assert surface.inside_out
    assert "inward" in surface.warnings()[0]
    assert signed_volume(surface.mesh) == pytest.approx(4 / 3 * np.pi * 1e6, rel=0.02)
    np.testing.assert_allclose(surface.mesh.vertices.mean(0), away, atol=3)


@pytest.mark.slow
def test_a_room_that_was_seen_from_within_stays_as_it_was_seen() -> None:
    cloud = sphere_points(1500)
    surface = reconstruction.reconstruct(cloud[:, :3], -cloud[:, 3:], outward=False)
    assert surface.warnings() == []
    assert signed_volume(surface.mesh) == pytest.approx(-4 / 3 * np.pi, rel=0.02)


def test_contradicting_normals_are_noticed() -> None:
    cloud = sphere_points(1500)
    cloud[np.random.default_rng(0).random(1500) < 0.2, 3:] *= -1
    surface = reconstruction.reconstruct(cloud[:, :3], cloud[:, 3:])
    assert surface.contradicted == pytest.approx(0.2, abs=0.05)
    assert any("contradict the surface" in text for text in surface.warnings())


@pytest.mark.slow
def test_trimming_removes_the_bubble_around_an_open_surface() -> None:
    cloud = sphere_points(4000)
    half = cloud[cloud[:, 2] > 0]
    surface = reconstruction.reconstruct(half[:, :3], half[:, 3:])
    below = surface.mesh.vertices[:, 2].min()
    trimmed = reconstruction.trim(surface, 0.1)
    assert below < -0.1
    assert surface.made_up > 0.01
    assert trimmed.mesh.vertices[:, 2].min() > 0.5 * below
    assert 0.85 * len(surface.mesh.vertices) < len(trimmed.mesh.vertices) <= 0.9 * len(surface.mesh.vertices)
    assert trimmed.mesh.faces.max() == len(trimmed.mesh.vertices) - 1
    assert len(np.unique(trimmed.mesh.faces)) == len(trimmed.mesh.vertices) == len(trimmed.density)
    same = reconstruction.trim(surface, 0)
    assert len(same.mesh.faces) == len(surface.mesh.faces)
    with pytest.raises(ValueError, match=r"trim=1: expected a share"):
        reconstruction.trim(surface, 1)


@pytest.mark.slow
def test_same_input_same_mesh() -> None:
    cloud = sphere_points(500)
    first, second = (reconstruction.reconstruct(cloud[:, :3], cloud[:, 3:]) for _ in range(2))
    np.testing.assert_array_equal(first.mesh.vertices, second.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.faces, second.mesh.faces)


def test_depth_follows_the_spacing() -> None:
    depths = [reconstruction.octree_depth(sphere_points(n)[:, :3]) for n in (500, 2000, 8000, 32000)]
    assert depths == [depths[0] + i for i in range(4)]
    assert 4 <= depths[0] <= 6
    assert reconstruction.octree_depth(1e3 * sphere_points(2000)[:, :3] + 7) == depths[1]


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", r"depth=6 was killed by SIGSEGV.*depth=5"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", r"SIGKILL; the memory may not suffice"),
        ("import time; time.sleep(30)", r"took longer than timeout=0.5 seconds"),
        ("raise RuntimeError('no luck')", r"failed with code 1 \(RuntimeError: no luck\)"),
        ("import sys; print('libX', file=sys.stderr); sys.exit(3)",
         r"open3d, .*, cannot be imported here \(libX\); (run as root: apt-get|install it again)"),
        ("pass", r"failed with code 0"),
    ],
)  # fmt: skip
def test_child_may_fail_without_loss(
    script: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = tmp_path / "child.py"
    fake.write_text(script)
    monkeypatch.setattr(poisson_process, "__file__", str(fake))
    cloud = sphere_points(200)
    with pytest.raises(ValueError, match=message) as caught:
        reconstruction.reconstruct(cloud[:, :3], cloud[:, 3:], depth=6, timeout=30 if "sleep" not in script else 0.5)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_missing_open3d_has_its_own_exit_code(tmp_path: Path) -> None:
    (tmp_path / "open3d.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from pnu.reconstruction import poisson_process as child; "
    )
    run = subprocess.run(
        [sys.executable, "-c", code + "child.main('', '')"], capture_output=True, text=True, check=False
    )
    assert run.returncode == poisson_process.CANNOT_IMPORT
    assert "libGL.so.1" in screened_poisson.failure(run.returncode, run.stderr, 8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": 0}, "depth=0: expected 1 to 16"),
        ({"normals": np.zeros((200, 3))}, "has no normals; Poisson"),
        ({"points": np.full((200, 3), np.nan)}, "200 of 200 points left out: NaN"),
        ({"points": np.ones((200, 3))}, "all 200 points are equal"),
    ],
)
def test_bad_input(change: dict, message: str) -> None:
    cloud = sphere_points(200)
    with pytest.raises(ValueError, match=message):
        reconstruction.reconstruct(**{"points": cloud[:, :3], "normals": cloud[:, 3:]} | change)


def test_errors_of_a_larger_sphere_are_its_distance() -> None:
    truth = icosphere()
    mesh = Mesh(1.1 * truth.vertices, truth.faces)
    errors = reconstruction.surface_errors(mesh, truth, rng=np.random.default_rng(0), samples=2000)
    np.testing.assert_allclose(errors.distance, 0.1, atol=2e-3)
    np.testing.assert_allclose(errors.from_truth, 0.1, atol=3e-3)
    assert errors.normal_deg.max() < 6
    summary = errors.summary()
    assert summary["to_truth_mean"] == pytest.approx(0.1, abs=1e-3)
    assert summary["to_truth_rms"] == pytest.approx(np.sqrt((errors.distance**2).mean()))
    assert summary["to_truth_max"] == errors.distance.max()
    assert summary["flipped"] == 0
    assert json.loads(json.dumps(summary)) == summary
    assert "100." in errors.table()
    turned = reconstruction.surface_errors(
        Mesh(mesh.vertices, mesh.faces[:, ::-1]), truth, rng=np.random.default_rng(0)
    )
    assert turned.summary()["flipped"] == 1


def test_errors_in_both_directions_see_a_missing_half() -> None:
    truth = icosphere()
    upper = truth.faces[(truth.vertices[truth.faces, 2] >= 0).all(1)]
    errors = reconstruction.surface_errors(
        Mesh(truth.vertices, upper), truth, rng=np.random.default_rng(0), samples=2000
    )
    assert errors.distance.max() < 1e-9
    assert errors.from_truth.max() == pytest.approx(np.sqrt(2), abs=0.05)  # from the lower pole to the equator


def test_error_colors() -> None:
    errors = reconstruction.SurfaceErrors(np.array([0.0, 1, 2]), np.zeros(3), np.zeros(3), 1.0)
    red, _, blue = errors.colors(limit=2).astype(int)
    assert red.argmax() == 0
    assert blue.argmax() == 2
    flat = reconstruction.SurfaceErrors(np.zeros(3), np.zeros(3), np.zeros(3), 1.0)
    assert (flat.colors()[:, 0] > 150).all()  # no error at all: red, and no division by zero


def test_frames_are_compared() -> None:
    truth, points = icosphere(), sphere_points(500)[:, :3]
    reconstruction.check_frame(points, truth)
    reconstruction.check_frame(points + np.random.default_rng(0).normal(0, 0.02, points.shape), truth)
    reconstruction.check_frame(points[points[:, 2] > 0.5], truth)  # a part of it
    with pytest.raises(ValueError, match=r"truth: is not in the frame of cloud.*99\.8 times as large"):
        reconstruction.check_frame(100 * points, truth)
    with pytest.raises(ValueError, match=r"middles 0\.496 apart"):
        reconstruction.check_frame(points + np.array([0, 0, 0.5]), truth)


def test_open_edges() -> None:
    ball = icosphere(1)
    assert open_edges(ball) == 0
    assert open_edges(Mesh(ball.vertices, ball.faces[1:])) == 3
    turned = np.concatenate([ball.faces[:1, ::-1], ball.faces[1:]])
    assert open_edges(Mesh(ball.vertices, turned)) == 3
    loose = Mesh(ball.vertices[ball.faces].reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3))
    assert open_edges(loose) == 0


def test_vertex_normals() -> None:
    ball = icosphere(3)
    cosine = (vertex_normals(ball) * ball.vertices).sum(1)
    assert cosine.min() > np.cos(np.radians(3))
    alone = Mesh(np.vstack([ball.vertices, [9, 9, 9]]), ball.faces)
    np.testing.assert_array_equal(vertex_normals(alone)[-1], 0)


def test_interpolate() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]])
    values = np.arange(10.0).reshape(5, 2)
    np.testing.assert_allclose(reconstruction.interpolated_values(points, values, points), values, atol=1e-6)
    middle = reconstruction.interpolated_values(points, values, np.array([[0.5, 0, 0]]), k=2)
    np.testing.assert_allclose(middle, [[1, 2]], atol=1e-6)
