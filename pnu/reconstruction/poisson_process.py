"""The process that runs Open3D's Poisson reconstruction: `python -I poisson_child.py IN.npz OUT.npz`.

On its own, and not a part of the program that calls it, because the native code may crash. One thread: with several it
crashes at random (isl-org/Open3D#6828) and the vertices come in another order each time.
"""

import sys

import numpy as np

CANNOT_IMPORT = 3


def main(source: str, target: str) -> None:
    """Reconstruct the cloud in one file, the surface into another."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        print(f"{error}", file=sys.stderr)
        sys.exit(CANNOT_IMPORT)
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    given = np.load(source)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(given["points"]))
    cloud.normals = open3d.utility.Vector3dVector(given["normals"])
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=int(given["depth"]), scale=float(given["box"]), linear_fit=True, n_threads=1
    )
    np.savez(target, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.triangles), density=np.asarray(density))


if __name__ == "__main__":
    main(*sys.argv[1:])
