"""Points over the holes of a cloud: the paper's future work."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.mesh_sampling import face_areas, sample_poisson_disk
from pnu.geometry.mesh_topology import vertex_normals
from pnu.geometry.spacing import spacing
from pnu.io import Mesh
from pnu.reconstruction.screened_poisson import BOX, reconstruct

Array = NDArray[np.float64]

OPEN = 1.5  # spacings from all points, from which on a vertex of the surface lies over a hole
ROOM = 0.7  # spacings that new points keep from those there are


def fill_holes(cloud: Array, radius: float, *, timeout: float = 600, seed: int = 0, name: str = "cloud") -> Array:
    """Points with unit normals (k, 6) over the holes of a dense cloud (m, 6) that are narrower than a radius.

    A screened Poisson surface through the cloud continues it smoothly over its holes. Where it lies far from all
    points, in a piece with points all round and none of it farther from them than `radius`, it is sampled as densely
    as the cloud. Larger holes and open borders stay open.

    Args:
        cloud: evenly spread, normals of one side.
        radius: > 0, in the cloud's unit.
        timeout: seconds that the surface may take.
        seed: of the samples.
        name: of the cloud in messages.

    Raises:
        ValueError: no such radius, or no surface.
    """
    if not 0 < radius < np.inf:
        raise ValueError(f"holes={radius:g}: expected a radius above 0 in the unit of the points")
    box = BOX + 2 * min(radius / max(np.ptp(cloud[:, :3], axis=0).max(), 1e-300), 1.0)  # a lid may stand out of it
    mesh = reconstruct(cloud[:, :3], cloud[:, 3:], box=box, timeout=timeout, name=name).mesh
    tree, even = kd_tree(cloud[:, :3]), spacing(cloud[:, :3])
    lids, supported = hole_faces(mesh, tree.query(mesh.vertices)[0], OPEN * even, radius)
    areas = face_areas(mesh)
    count = round(areas[lids].sum() / max(areas[supported].sum(), 1e-300) * len(cloud))
    if not count:
        return np.empty((0, 6))
    points = sample_poisson_disk(Mesh(mesh.vertices, mesh.faces[lids]), count, np.random.default_rng(seed))[:, :3]
    points = points[tree.query(points)[0] > ROOM * even]
    normals = vertex_normals(mesh)[kd_tree(mesh.vertices).query(points)[1]]
    return np.hstack([points, normals])


def hole_faces(mesh: Mesh, distance: Array, far: float, radius: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which faces (f,) of a surface close a hole narrower than `radius`, and which lie near points.

    distance: (v,) of the vertices from the nearest point; those beyond `far` lie over a hole or beyond a border.
    """
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), 1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    unsupported = distance > far
    inner = edges[unsupported[edges].all(1)]
    n = len(mesh.vertices)
    piece = connected_components(coo_matrix((np.ones(len(inner), bool), inner.T), (n, n)), directed=False)[1]
    widest = np.zeros(n)
    np.maximum.at(widest, piece, distance)
    bordered = np.zeros(n, bool)
    bordered[piece[edges[uses == 1].ravel()]] = True  # the surface ends there: beyond a border, no hole
    closes = unsupported & (widest <= radius)[piece] & ~bordered[piece]
    return closes[mesh.faces].any(1), ~unsupported[mesh.faces].any(1)
