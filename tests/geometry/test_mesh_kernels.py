"""Closest points of meshes as a Triton kernel, on a GPU or in Triton's interpreter, against doubles and Open3D."""

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pnu.data import shapes
from pnu.data.mesh_scene import MeshScene
from pnu.io import Mesh
from tests.ahead import machine_code_sizes

try:
    from pnu.geometry import mesh_kernels
except ImportError as error:  # no Triton
    pytest.skip(str(error), allow_module_level=True)

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
TRIANGLE = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))


def closest(meshes: list[Mesh], points: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    blocks = mesh_kernels.triangle_blocks(meshes).to(DEVICE)
    found, normals = mesh_kernels.closest_on_meshes(points.to(DEVICE), shape.to(DEVICE), blocks)
    return found.cpu(), normals.cpu()


def queries(mesh: Mesh, count: int, seed: int) -> Tensor:
    """So many each: beside one place of the surface, at any distance, on the surface, at vertices. (4 count, 3)."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count)]]
    on_surface = (corners * rng.dirichlet(np.ones(3), size=count)[..., None]).sum(1)
    near = on_surface[0] + 0.05 * rng.normal(size=(count, 3))
    far = rng.normal(size=(count, 3)) * 10 ** rng.uniform(-1, 1, (count, 1))
    return torch.from_numpy(np.concatenate([near, far, on_surface, corners[:, 0]])).float()


def distances(mesh: Mesh, points: Tensor) -> Tensor:
    """Distances of points from a mesh in double precision: to all sides, and to planes where the foot is inside."""
    corners = mesh.vertices[mesh.faces]
    sides = np.roll(corners, -1, 1) - corners
    normals = np.cross(sides[:, 0], sides[:, 1])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    away = points.double().numpy()[:, None, None] - corners
    along = ((away * sides).sum(-1) / (sides**2).sum(-1)).clip(0, 1)
    to_sides = np.linalg.norm(away - along[..., None] * sides, axis=-1).min(2)
    inside = ((away * np.cross(normals[:, None], sides)).sum(-1) >= 0).all(2)
    height = np.abs((away[:, :, 0] * normals).sum(-1))
    return torch.from_numpy(np.where(inside, height, to_sides).min(1))


def assert_is_closest(meshes: list[Mesh], points: Tensor, shape: Tensor) -> None:
    """Distances in single precision; Open3D's, which lose more at thin faces; and its normals where a query is straight
    above a face, so that the closest one is the only one."""
    found, normals = closest(meshes, points, shape)
    for row, mesh in enumerate(shape.tolist()):
        scene = MeshScene([meshes[mesh]])  # alone, since to far queries another mesh of a scene may be nearer
        truth, facing = scene.closest(points[row][None], torch.zeros(1, dtype=torch.int64))
        away, expected = (points[row] - found[row]).double(), points[row] - truth[0]
        torch.testing.assert_close(away.norm(dim=1), distances(meshes[mesh], points[row]), rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(away.norm(dim=1), expected.norm(dim=1).double(), rtol=1e-6, atol=1e-3)
        height = (expected * facing[0]).sum(1).abs()
        above = (height > 0.9999 * expected.norm(dim=1)) & (height > 1e-2)
        assert above.any()
        torch.testing.assert_close(normals[row][above], facing[0][above], rtol=0, atol=1e-3)
        torch.testing.assert_close(normals[row].norm(dim=1), torch.ones(len(points[row])))


def test_closest_points_of_a_batch_are_exact() -> None:
    """Meshes of few blocks and of many, in any order, one twice."""
    meshes = [shapes.make(name) for name in ("star_prism", "heat_sink")]
    shape = torch.tensor([1, 0, 1])
    points = torch.stack([queries(meshes[mesh], 7, seed) for seed, mesh in enumerate(shape.tolist())])
    assert_is_closest(meshes, points, shape)


@pytest.mark.slow
def test_closest_points_of_large_meshes_are_exact() -> None:
    """Its blocks are more than are looked at together."""
    names = ("cup", "bracket", "impeller")
    meshes = [shapes.make(name) for name in names]
    assert max(len(mesh.faces) for mesh in meshes) > mesh_kernels.BLOCK * mesh_kernels.CHUNK
    points = torch.stack([queries(mesh, 30, seed) for seed, mesh in enumerate(meshes)])
    assert_is_closest(meshes, points, torch.arange(3))


def test_a_triangle_by_hand() -> None:
    """Inside from both sides, on it, beyond each side, beyond each corner."""
    table = [
        ([0.2, 0.3, 0.5], [0.2, 0.3, 0]), ([0.2, 0.3, -2], [0.2, 0.3, 0]), ([0.25, 0.25, 0], [0.25, 0.25, 0]),
        ([0.4, -1, 1], [0.4, 0, 0]), ([-3, 0.7, 0], [0, 0.7, 0]), ([1, 1, 0.5], [0.5, 0.5, 0]),
        ([-1, -2, 3], [0, 0, 0]), ([3, 0.5, -1], [1, 0, 0]), ([0.5, 4, 0], [0, 1, 0]),
    ]  # fmt: skip
    points, expected = torch.tensor(table).float().unbind(1)
    found, normals = closest([TRIANGLE], points[None], torch.tensor([0]))
    torch.testing.assert_close(found[0], expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(normals[0], torch.tensor([0.0, 0, 1]).expand(9, 3))


def test_triangles_without_area_are_lines_and_points() -> None:
    """With none of them anything is divided by zero; copies of a face change nothing."""
    point = Mesh(np.array([[1.0, 2, 3]]), np.array([[0, 0, 0]]))
    line = Mesh(np.array([[0.0, 0, 0], [3, 0, 0], [1, 0, 0]]), np.array([[0, 1, 2], [0, 0, 1]]))
    copies = Mesh(
        np.concatenate([TRIANGLE.vertices, [[0.5, 0, 0]]]), np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2], [0, 1, 2]])
    )
    points = torch.tensor([[2.0, 1, 1], [-1, 0, 0], [0.25, 0.25, 2], [5, 0, 4]])
    found, normals = closest([point, line, copies], points.expand(3, 4, 3), torch.arange(3))
    expected = torch.tensor([[[1, 2, 3]] * 4, [[2, 0, 0], [0, 0, 0], [0.25, 0, 0], [3, 0, 0]],
                             [[1, 0, 0], [0, 0, 0], [0.25, 0.25, 0], [1, 0, 0]]])  # fmt: skip
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    assert not normals[:2].any()
    assert normals[2, 2].tolist() == [0, 0, 1]
    assert not normals.isnan().any()


def test_a_thin_triangle_is_no_worse_than_a_thick_one() -> None:
    """Its height is a hundred-thousandth of its length, its plane oblique."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    mesh = Mesh(np.array([[-0.8, 0, 0], [0.8, 0, 0], [0.1, 1e-5, 0]]) @ turn, np.array([[0, 1, 2]]))
    points = torch.from_numpy(rng.normal(size=(1, 40, 3)) / 2).float()
    found, _ = closest([mesh], points, torch.tensor([0]))
    ends = torch.from_numpy(mesh.vertices)
    along = ((points[0].double() - ends[0]) @ (ends[1] - ends[0]) / 1.6**2).clip(0, 1)
    torch.testing.assert_close(found[0].double(), ends[0] + along[:, None] * (ends[1] - ends[0]), rtol=0, atol=1.2e-5)


def test_a_query_that_is_no_number_harms_no_other() -> None:
    mesh = shapes.make("star_prism")
    points = queries(mesh, 9, 0)[None]
    expected, _ = closest([mesh], points, torch.tensor([0]))
    broken = points.clone()
    broken[0, 3, 1], broken[0, 7], broken[0, 20] = torch.nan, torch.inf, 3e38
    found, normals = closest([mesh], broken, torch.tensor([0]))
    sound = torch.ones(points.shape[1], dtype=torch.bool)
    sound[[3, 7, 20]] = False
    torch.testing.assert_close(found[0, sound], expected[0, sound], rtol=0, atol=1e-5)
    assert found[0, ~sound].isnan().all()
    assert normals.isfinite().all()
    found, normals = closest([mesh], torch.full((1, 5, 3), torch.nan), torch.tensor([0]))
    assert found.isnan().all()
    assert normals.isfinite().all()


def test_blocks_hold_every_face_inside_their_spheres() -> None:
    meshes = [shapes.make("heat_sink"), TRIANGLE, shapes.make("wedge")]
    blocks = mesh_kernels.triangle_blocks(meshes)
    assert blocks.first.diff().tolist() == [-(-len(mesh.faces) // mesh_kernels.BLOCK) for mesh in meshes]
    corners = blocks.triangles.view(len(blocks.spheres), -1, 3).double()
    center, radius = blocks.spheres.double().split([3, 1], 1)
    assert ((corners - center[:, None]).norm(dim=2) <= radius).all()
    for first, stop, mesh in zip(blocks.first[:-1].tolist(), blocks.first[1:].tolist(), meshes, strict=True):
        rows = blocks.triangles[first * mesh_kernels.BLOCK : stop * mesh_kernels.BLOCK].numpy()
        given = mesh.vertices[mesh.faces].astype(np.float32).reshape(-1, 9)
        np.testing.assert_array_equal(np.unique(rows, axis=0), np.unique(given, axis=0))


def test_a_scene_takes_the_kernel_and_no_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it is there; what a GPU holds is kept, and left out of a pickle."""
    meshes = [shapes.make("star_prism"), shapes.make("heat_sink")]
    points, shape = torch.stack([queries(mesh, 6, 0) for mesh in meshes]).double(), torch.tensor([0, 1])
    points[points.norm(dim=2) > 1] /= 10
    expected = MeshScene(meshes).closest(points, shape)[0]
    if DEVICE == "cpu":
        monkeypatch.setattr("pnu.data.mesh_scene.gpu_kernels", lambda *_: mesh_kernels)
    monkeypatch.setitem(sys.modules, "open3d", None)
    scene = MeshScene(meshes)
    found, normals = scene.closest(points.to(DEVICE), shape.to(DEVICE))
    assert found.dtype == normals.dtype == torch.float64
    assert found.device.type == normals.device.type == DEVICE
    away, expected_away = (points - found.cpu()).norm(dim=2), (points - expected).norm(dim=2)
    torch.testing.assert_close(away, expected_away, rtol=0, atol=1e-3)  # what Open3D loses at thin faces
    held = scene.blocks
    scene.closest(points.to(DEVICE), shape.to(DEVICE))
    assert scene.blocks is held
    assert scene.scene is None
    assert pickle.loads(pickle.dumps(scene)).blocks is None


@pytest.mark.slow
@pytest.mark.parametrize("capability", [80, 90])
def test_the_kernel_compiles_for_a_gpu_that_is_not_here(capability: int, tmp_path: Path) -> None:
    sizes = machine_code_sizes(AHEAD, capability, tmp_path)
    assert len(sizes) == 1
    assert min(sizes) > 1000


AHEAD = """
from pnu.geometry import mesh_kernels as mesh

types = [FLOAT, INDEX, FLOAT, FLOAT, FLOAT, PLACE, FLOAT, FLOAT, NUMBER]
compiled(mesh._closest, types, ROWS=mesh.ROWS, BLOCK=mesh.BLOCK, CHUNK=mesh.CHUNK)
"""
