"""The true surfaces that training compares with: exact closest points on many meshes at once."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pnu.extras import needed
from pnu.geometry.neighbor_search import gpu_kernels
from pnu.io import Mesh

APART = 3.0  # between meshes of the unit sphere


class MeshScene:
    """Meshes of the unit sphere; single precision.

    On a GPU with Triton in blocks of triangles; elsewhere set side by side in a ray casting scene, which needs open3d.
    """

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self.meshes = list(meshes)
        side = int(np.ceil(len(self.meshes) ** (1 / 3)))
        cell = np.stack(np.unravel_index(np.arange(len(self.meshes)), (side, side, side)), 1)
        self.places = APART * (cell - (side - 1) / 2)
        self.scene: Any = None
        self.blocks: Any = None

    def closest(self, points: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Closest points of surfaces and their normals, (B, m, 3) each, for points (B, m, 3) of meshes `shape` (B,)."""
        if gpu_kernels(points):
            from pnu.geometry import mesh_kernels

            if self.blocks is None or self.blocks.first.device != points.device:
                self.blocks = mesh_kernels.triangle_blocks(self.meshes).to(points.device)
            surface, facing = mesh_kernels.closest_on_meshes(points, shape, self.blocks)
            return surface.to(points), facing.to(points)
        if self.scene is None:
            self.scene = ray_casting_scene(self.meshes, self.places)
        with needed("data: training the surface model"):
            import open3d

        places = self.places[shape.cpu().numpy()][:, None]
        query = (points.detach().cpu().double().numpy() + places).astype(np.float32)
        threads = torch.get_num_threads()
        found = self.scene.compute_closest_points(open3d.core.Tensor.from_numpy(query), nthreads=threads)
        closest = found["points"].numpy().astype(np.float64) - places
        normals = found["primitive_normals"].numpy()
        return torch.from_numpy(closest).to(points), torch.from_numpy(normals).to(points)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "scene": None, "blocks": None}  # made anew: a scene cannot be pickled


def ray_casting_scene(meshes: Sequence[Mesh], places: Iterable[np.ndarray]) -> Any:
    """A scene of Open3D with the meshes at their places (3,)."""
    with needed("data: training the surface model"):
        import open3d
    scene = open3d.t.geometry.RaycastingScene()
    for mesh, place in zip(meshes, places, strict=True):
        scene.add_triangles(
            open3d.core.Tensor.from_numpy((mesh.vertices + place).astype(np.float32)),
            open3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
        )
    return scene
