"""Even samples of the screened Poisson surface."""

import numpy as np
import torch
from torch import Tensor

from pnu import reconstruction
from pnu.geometry.mesh_sampling import sample_poisson_disk
from pnu.geometry.mesh_topology import vertex_normals
from pnu.geometry.neighbor_search import knn, nearest
from pnu.io import Mesh
from pnu.upsamplers.context import Context


class PoissonSurface:
    """Poisson-disk samples of the screened Poisson surface of the points and normals, by Open3D in a child process.

    Kazhdan and Hoppe 2013. What the surface makes up far from all points (bubbles around open borders) is cut off.

    Args:
        depth: of the octree; None: from the points' spacing.
    """

    FAR = 4.0  # in spacings

    def __init__(self, depth: int | None = None) -> None:
        self.depth = depth

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6)."""
        cloud = cloud.cpu()
        context.progress("Poisson surface", 0, 1)
        mesh = reconstruction.reconstruct(cloud[:, :3].numpy(), cloud[:, 3:].numpy(), depth=self.depth).mesh
        context.progress("Poisson surface", 1, 1)
        mesh = _near(mesh, cloud[:, :3], self.FAR)
        rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=context.generator)))
        points = sample_poisson_disk(mesh, count, rng)[:, :3]
        normals = reconstruction.interpolated_values(mesh.vertices, vertex_normals(mesh), points, k=3)
        return torch.from_numpy(np.hstack([points, normals])).to(cloud)


def _near(mesh: Mesh, points: Tensor, far: float) -> Mesh:
    """The faces of a mesh that have a corner within `far` spacings of the points."""
    spacing = float(knn(points[None], points[None], 2).dist_sq[0, :, 1].sqrt().mean())
    distance = nearest(torch.from_numpy(mesh.vertices)[None], points[None]).dist_sq[0].sqrt()
    close = (distance <= far * spacing).numpy()
    return Mesh(mesh.vertices, mesh.faces[close[mesh.faces].any(1)])
