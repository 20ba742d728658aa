"""From a scan to a mesh, step by step, with a picture of each: `python docs/scan_to_mesh.py [scan.ply [folder]]`.

Without a file, a scan of a procedural shape is made: 1500 points without normals. The folder (scan_to_mesh/ by default)
gets dense.ply, mesh.ply and steps.png. The cells (# %%) run one by one in editors that know them.
"""

# %% A scan: points, and normals if the file has them
import sys
from pathlib import Path

import numpy as np

import pnu
from pnu.data import shapes
from pnu.geometry.mesh_sampling import closest_points, sample_area
from pnu.io import Cloud, read_cloud, write_cloud, write_mesh
from pnu.reconstruction import reconstruct
from pnu.rendering import figure, look_at, render_cloud, render_mesh, save_png

folder = Path(sys.argv[2] if len(sys.argv) > 2 else "scan_to_mesh")
folder.mkdir(parents=True, exist_ok=True)
truth = None if len(sys.argv) > 1 else shapes.make("teapot")
if truth is None:
    scan = read_cloud(sys.argv[1])
else:
    scan = Cloud(sample_area(truth, 1500, np.random.default_rng(0))[:, :3], None, {})
print(f"scan:  {len(scan.points)} points, {'with' if scan.normals is not None else 'without'} normals")

# %% Four points for each, with normals. A trained run goes in as model="outputs/..."
dense = pnu.upsample(scan.points, scan.normals, ratio=4, model="surface")
points, normals = dense[:, :3], dense[:, 3:]
write_cloud(folder / "dense.ply", points, normals)
print(f"dense: {len(dense)} points")

# %% How good are they? Only where the true surface is known
if truth is not None:
    _, distance, face = closest_points(truth, points)
    corners = truth.vertices[truth.faces[face]]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = (normals * outward).sum(1) / np.linalg.norm(outward, axis=1)
    print(f"       {1e3 * distance.mean():.2f}e-3 from the surface on average, the shape's radius is 1")
    print(f"       normals off by {np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean():.1f} degrees on average")

# %% A surface through them
pictures = [("scan", scan.points), ("dense", dense)]
camera = look_at(scan.points, azimuth=30, elevation=20, up="z")
panels = [render_cloud(cloud, camera=camera, size=400) for _, cloud in pictures]
captions = [f"{name}, {len(cloud)} points" for name, cloud in pictures]
try:
    surface = reconstruct(points, normals)
except ValueError as error:  # open3d or its system libraries are missing: the points are saved all the same
    print(f"no mesh: {error}")
else:
    for warning in surface.warnings():
        print(f"       {warning}")
    write_mesh(folder / "mesh.ply", surface.mesh)
    panels.append(render_mesh(surface.mesh, camera=camera, size=400))
    captions.append(f"mesh, {len(surface.mesh.faces)} faces")
    print(f"mesh:  {len(surface.mesh.vertices)} vertices, {len(surface.mesh.faces)} faces")

# %% All steps side by side
save_png(folder / "steps.png", figure(panels, captions))
print(f"see    {folder}/steps.png")
