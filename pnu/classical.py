"""Upsamplers without training, to stand beside the networks: APSS projection, Poisson surface, midpoints.

Each is a module without weights that `pnu.upsample(points, normals, model=...)` takes like a network:

    dense = pnu.upsample(points, normals, ratio=4, model=classical.method("apss"))
"""

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from pnu import surfaces
from pnu.io import Mesh
from pnu.ops.apss import apss_project
from pnu.ops.mesh import vertex_normals
from pnu.ops.nearest import knn, nearest
from pnu.ops.sampling import farthest_points_large
from pnu.ops.surface import sample_poisson_disk
from pnu.runtime.progress import Progress


class APSS(nn.Module):
    """Random seeds around the points, projected onto their algebraic point set surface, then farthest points.

    A seed is a random convex combination of a point and two of its `reach` nearest, so that holes of the sampling get
    seeds too. Guennebaud and Gross 2007; `pnu.ops.apss` has the equations.

    Args:
        neighbours: of a sphere fit; few keep detail, many average noise.
        seeds: for each point wanted; half of them, evenly spread, are projected.
        reach: neighbours of a point that its seeds may lie between.
    """

    def __init__(self, neighbours: int = 10, seeds: int = 8, reach: int = 30) -> None:
        super().__init__()
        self.neighbours, self.seeds, self.reach = neighbours, seeds, reach

    def upsample_cloud(
        self, cloud: Tensor, count: int, *, batch_size: int | None, generator: torch.Generator, progress: Progress
    ) -> Tensor:
        """cloud (n, 6) -> (count, 6)."""
        cloud = cloud.cpu()
        progress("seeds", 0, 1)
        seeds = _between(cloud[:, :3], -(-self.seeds * count // len(cloud)), self.reach, generator)
        seeds = seeds[farthest_points_large(seeds, min(len(seeds), self.seeds * count // 2))]
        progress("seeds", 1, 1)
        progress("projection", 0, 1)
        projected = apss_project(seeds, cloud, min(self.neighbours, len(cloud)))
        progress("projection", 1, 1)
        return _spread(projected[_least_moved(seeds, projected, cloud, count)], count, progress)


class PoissonSurface(nn.Module):
    """Poisson-disk samples of the screened Poisson surface of the points and normals, by Open3D in a child process.

    Kazhdan and Hoppe 2013. What the surface makes up far from all points (bubbles around open borders) is cut off.

    Args:
        depth: of the octree; None: from the points' spacing.
    """

    FAR = 4.0  # in spacings

    def __init__(self, depth: int | None = None) -> None:
        super().__init__()
        self.depth = depth

    def upsample_cloud(
        self, cloud: Tensor, count: int, *, batch_size: int | None, generator: torch.Generator, progress: Progress
    ) -> Tensor:
        """cloud (n, 6) -> (count, 6)."""
        cloud = cloud.cpu()
        progress("Poisson surface", 0, 1)
        mesh = surfaces.reconstruct(cloud[:, :3].numpy(), cloud[:, 3:].numpy(), depth=self.depth).mesh
        progress("Poisson surface", 1, 1)
        mesh = _near(mesh, cloud[:, :3], self.FAR)
        rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
        points = sample_poisson_disk(mesh, count, rng)[:, :3]
        normals = surfaces.interpolate(mesh.vertices, vertex_normals(mesh), points, k=3)
        return torch.from_numpy(np.hstack([points, normals])).to(cloud)


class Midpoint(nn.Module):
    """Midpoints between each point and its nearest ones with the mean of their normals, then farthest points.

    Repeated where the points and midpoints of one pass are not enough.

    Args:
        neighbours: of each point; with 10, a pass has about seven points for each one.
    """

    def __init__(self, neighbours: int = 10) -> None:
        super().__init__()
        self.neighbours = neighbours

    def upsample_cloud(
        self, cloud: Tensor, count: int, *, batch_size: int | None, generator: torch.Generator, progress: Progress
    ) -> Tensor:
        """cloud (n, 6) -> (count, 6); nothing is random."""
        cloud = cloud.cpu()
        while True:
            near = knn(cloud[None, :, :3], cloud[None, :, :3], min(self.neighbours + 1, len(cloud))).idx[0]
            here = torch.arange(len(cloud))[:, None].expand_as(near)
            pairs = torch.stack([torch.minimum(here, near), torch.maximum(here, near)], -1).flatten(0, 1)
            pairs = pairs[pairs[:, 0] != pairs[:, 1]].unique(dim=0)
            middle = cloud[pairs].mean(1)
            opposite = middle[:, 3:].norm(dim=1, keepdim=True) < 1e-6
            normals = torch.where(opposite, cloud[pairs[:, 0], 3:], normalize(middle[:, 3:], dim=1))
            everything = torch.cat([cloud, torch.cat([middle[:, :3], normals], 1)])
            if len(everything) >= 1.5 * count:
                return _spread(everything, count, progress)
            cloud = _spread(everything, min(len(everything), 4 * len(cloud)), progress)


METHODS: dict[str, type[nn.Module]] = {"apss": APSS, "poisson": PoissonSurface, "midpoint": Midpoint}


def method(name: str) -> nn.Module:
    """A classical upsampler by name: apss, poisson or midpoint."""
    if name not in METHODS:
        raise ValueError(f"method={name}: expected one of {', '.join(METHODS)}")
    return METHODS[name]()


def _between(points: Tensor, each: int, reach: int, generator: torch.Generator) -> Tensor:
    """Random convex combinations of each point and two of its `reach` nearest others: (n, 3) -> (n each, 3)."""
    n = len(points)
    near = knn(points[None], points[None], min(reach, n)).idx[0]
    which = torch.randint(1, near.shape[1], (n, each, 2), generator=generator)
    corners = [torch.arange(n)[:, None].expand(n, each), *(near.gather(1, which[..., i]) for i in range(2))]
    weights = torch.rand(n, each, 3, generator=generator, dtype=points.dtype).clamp(min=1e-12).log()
    weights = weights / weights.sum(-1, keepdim=True)  # exponential variables over their sum: uniform in the triangle
    return sum(points[corner] * weights[..., i, None] for i, corner in enumerate(corners)).reshape(-1, 3)  # type: ignore[union-attr]


def _least_moved(seeds: Tensor, projected: Tensor, cloud: Tensor, count: int) -> Tensor:
    """Indices of the seeds that moved less than the local spacing of the cloud, and at least `count` of them."""
    points = cloud[None, :, :3]
    spacing = knn(points, points, min(9, len(cloud))).dist_sq[0, :, -1].sqrt()
    local = spacing[nearest(projected[None, :, :3], points).idx[0]]
    moved = (projected[:, :3] - seeds).norm(dim=1) / local.clamp(min=torch.finfo(local.dtype).tiny)
    kept = max(count, int((moved < 1).sum()))
    return moved.argsort()[:kept]


def _near(mesh: Mesh, points: Tensor, far: float) -> Mesh:
    """The faces of a mesh that have a corner within `far` spacings of the points."""
    spacing = float(knn(points[None], points[None], 2).dist_sq[0, :, 1].sqrt().mean())
    distance = nearest(torch.from_numpy(mesh.vertices)[None], points[None]).dist_sq[0].sqrt()
    close = (distance <= far * spacing).numpy()
    return Mesh(mesh.vertices, mesh.faces[close[mesh.faces].any(1)])


def _spread(cloud: Tensor, count: int, progress: Progress) -> Tensor:
    """Farthest points, exactly `count`."""
    stage = f"farthest points, {count} of {len(cloud)}"
    progress(stage, 0, 1)
    kept = cloud[farthest_points_large(cloud[:, :3], count)]
    progress(stage, 1, 1)
    return kept
