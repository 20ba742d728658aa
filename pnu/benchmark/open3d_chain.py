"""What users of Open3D do with a scan, as a method to compare with."""

from collections.abc import Callable

import numpy as np

from pnu.extras import needed

NEIGHBORS, DEVIATIONS = 16, 2.0  # of the outlier removal
DEPTH, TRIMMED = 8, 0.03  # of the octree; share of the vertices with the fewest points


def open3d_chain(ratio: float, seed: int = 0) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
    """A method: points (n, 3), normals (n, 3) or None -> round(ratio n) points with normals, (m, 6).

    Statistical outlier removal, normals of planes through 16 neighbors, consistent tangent planes (where no normals are
    given), screened Poisson reconstruction, the least dense 3 % trimmed, Poisson-disk samples of the mesh.
    """

    def method(points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
        with needed("the chain of Open3D"):
            import open3d

        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud, rows = cloud.remove_statistical_outlier(NEIGHBORS, DEVIATIONS)
        if normals is None:
            cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBORS))
            cloud.orient_normals_consistent_tangent_plane(NEIGHBORS)
        else:
            cloud.normals = open3d.utility.Vector3dVector(normals[rows])
        mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=DEPTH, n_threads=1)
        mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(np.asarray(density), TRIMMED))
        open3d.utility.random.seed(seed)
        dense = mesh.sample_points_poisson_disk(round(ratio * len(points)), 2)
        return np.hstack([np.asarray(dense.points), np.asarray(dense.normals)])

    return method
