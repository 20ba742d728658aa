"""Closest points of a mesh through Open3D's ray casting scene: single precision, for comparison with public scripts."""

import numpy as np

from pnu.extras import needed
from pnu.io import Mesh


def closest_points(mesh: Mesh, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `pnu.geometry.mesh_sampling.closest_points`, queries (m, 3) -> points (m, 3), distance (m,), face (m,).

    The only difference beyond rounding: which face is named where several share the closest point. Needs open3d.
    """
    with needed("ray casting"):
        import open3d

    tensor = open3d.core.Tensor.from_numpy
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    found = scene.compute_closest_points(tensor(queries.astype(np.float32)))
    points = found["points"].numpy().astype(np.float64)
    return points, np.linalg.norm(queries - points, axis=1), found["primitive_ids"].numpy().astype(np.int64)
