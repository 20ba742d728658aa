"""A triangle mesh through points with normals: screened Poisson reconstruction (Kazhdan and Hoppe 2013), by Open3D."""

import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.extras import require
from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.mesh_sampling import closest_points, face_normals, signed_volume
from pnu.geometry.mesh_topology import open_edges
from pnu.geometry.normal_estimation import complete_normals
from pnu.geometry.spacing import local_spacing, spacing
from pnu.io import Cloud, Mesh, check_cloud
from pnu.reconstruction import poisson_process
from pnu.runtime.system_libraries import install_line, missing_packages

Array = NDArray[np.float64]

SHALLOWEST, DEEPEST = 4, 11  # what is chosen by itself
FAR = 3.0  # in spacings: a point, or a piece of surface, that far from any other stands alone
BOX = 1.1  # side of the octree over that of the points' bounding box


class ReconstructedSurface(NamedTuple):
    """A reconstructed surface."""

    mesh: Mesh  # outward, where it is closed and was to be
    density: Array  # (v,) octree depth at which there are points: low where the surface was made up between them
    depth: int
    inside_out: bool  # the normals looked inward; the faces were turned
    missed: float  # share of the points far from the surface
    made_up: float  # share of the vertices far from all points: beyond the border of an open surface, or by bad normals
    contradicted: float  # share of the points whose normal looks away from the surface's: bad normals

    def warnings(self) -> list[str]:
        """What is wrong with the surface, a line each; nothing if all went well."""
        found = []
        if self.inside_out:
            found.append("the normals look inward; the surface was turned outward (side=in: a room, it stays)")
        if self.contradicted > 0.03:
            found.append(
                f"{self.contradicted:.0%} of the normals contradict the surface; estimate them anew, unless the shape "
                "has details finer than the points' spacing"
            )
        if self.missed > 0.03:
            found.append(f"{self.missed:.0%} of the points lie far from the surface; raise depth=, look at the normals")
        if self.made_up > 0.01:
            found.append(
                f"{self.made_up:.0%} of the surface lies far from all points, beyond the border of an open surface or "
                "because normals contradict each other; trim=0.05 removes the least supported twentieth"
            )
        return found


def reconstruct(
    points: np.ndarray, normals: np.ndarray, *, depth: int | None = None, box: float = BOX, outward: bool = True,
    timeout: float = 600, name: str = "cloud",
) -> ReconstructedSurface:  # fmt: skip
    """The surface through points `(n, 3)` along normals `(n, 3)`; those of no length are estimated. In their frame.

    The work is done by a child process, which may crash or hang without loss. The same input gives the same mesh.

    Args:
        depth: of the octree, one more halves its cells; default: cells of half the points' spacing.
        box: side of the octree over that of the points' bounding box: beyond it there is no surface.
        outward: turn the faces of a closed surface whose normals look inward; else they look as the normals do, into
            a room that was seen from within.
        timeout: seconds.
        name: of the cloud in messages.

    Raises:
        ValueError: unusable points or normals, open3d missing, crash, timeout, no surface; one line with the cure.
    """
    points, given, *_ = check_cloud(Cloud(points, normals, {}), name)
    if given is None:
        raise ValueError(f"{name}: has no normals; Poisson reconstruction needs them, estimate them first")
    if depth is not None and not 1 <= depth <= 16:
        raise ValueError(f"depth={depth}: expected 1 to 16, 8 is usual")
    given = complete_normals(points, given)
    depth = octree_depth(points, box) if depth is None else depth
    center, radius = (points.min(0) + points.max(0)) / 2, np.ptp(points, axis=0).max() / 2
    found = run_child((points - center) / radius, given, depth, timeout, box)
    mesh = Mesh(found["vertices"] * radius + center, found["faces"].astype(np.int64))
    if not len(mesh.faces):
        raise ValueError(f"{name}: Poisson reconstruction found no surface; normals that contradict each other do that")
    inside_out = outward and open_edges(mesh) == 0 and signed_volume(mesh) < 0
    if inside_out:
        mesh = mesh._replace(faces=mesh.faces[:, ::-1])
    far = FAR * spacing(points)
    some = slice(None, None, -(-len(points) // 2000))
    _, off, face = closest_points(mesh, points[some])
    away = (given[some] * face_normals(mesh)[face]).sum(1) * (-1 if inside_out else 1) < 0
    alone = kd_tree(points).query(mesh.vertices, distance_upper_bound=far)[0] > far
    shares = (float(np.mean(share)) for share in (off > far, alone, away))
    return ReconstructedSurface(mesh, found["density"], depth, inside_out, *shares)


def octree_depth(points: np.ndarray, box: float = BOX) -> int:
    """Depth at which an octree cell is at most half the points' spacing, within 4..11."""
    cells = box * np.ptp(points, axis=0).max() / spacing(points)
    return int(np.clip(np.ceil(np.log2(cells)) + 1, SHALLOWEST, DEEPEST))


def run_child(points: Array, normals: Array, depth: int, timeout: float, box: float = BOX) -> dict[str, np.ndarray]:
    """The surface that a process of its own makes; `ValueError` where it crashes or takes too long."""
    require("open3d", "reconstructing a surface")
    with tempfile.TemporaryDirectory(prefix="pnu-") as folder:
        source, target = Path(folder, "cloud.npz"), Path(folder, "mesh.npz")
        np.savez(source, points=points, normals=normals, depth=depth, box=box)
        command = [sys.executable, "-I", poisson_process.__file__, str(source), str(target)]
        try:
            run = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", timeout=timeout)
        except subprocess.TimeoutExpired:
            raise ValueError(
                f"Poisson reconstruction at depth={depth} took longer than timeout={timeout:g} seconds; "
                f"try depth={max(depth - 1, 1)} or a longer timeout"
            ) from None
        if run.returncode or not target.is_file():
            raise ValueError(failure(run.returncode, run.stderr, depth))
        with np.load(target) as found:
            return dict(found)


def failure(code: int, stderr: str, depth: int) -> str:
    """What happened to the child and what to do, in one line."""
    last = (stderr.strip().splitlines() or [""])[-1]
    if code == poisson_process.CANNOT_IMPORT:
        missing = missing_packages()
        cure = f"run as root: {install_line(missing)}" if missing else "install it again"
        return f"open3d, which reconstructs surfaces, cannot be imported here ({last}); {cure}"
    try:
        reason = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"failed with code {code} ({last})"
    except ValueError:
        reason = f"ended with code {code}"
    memory = "the memory may not suffice" if code == -9 else "nothing else is lost"
    return f"Poisson reconstruction at depth={depth} {reason}; {memory}: try again or with depth={max(depth - 1, 1)}"


def trim(surface: ReconstructedSurface, quantile: float) -> ReconstructedSurface:
    """Without the vertices whose density is below that quantile, 0 <= quantile < 1, and the faces that use them.

    For open surfaces, around which Poisson reconstruction blows a bubble: no points are there, so its density is low.
    """
    if not 0 <= quantile < 1:
        raise ValueError(f"trim={quantile:g}: expected a share of the vertices from 0 to below 1, such as 0.05")
    keep = surface.density >= np.quantile(surface.density, quantile)
    return part_of(surface, keep, f"trim={quantile:g}", "a smaller one")


def cut_off(surface: ReconstructedSurface, points: np.ndarray, reach: float) -> ReconstructedSurface:
    """Without the vertices farther from all points (n, >= 3) than `reach` times the spacing around the nearest of them.

    So an open sheet gets no bubble, and holes that are wider than twice that stay open.
    """
    if not reach > 0:
        raise ValueError(f"reach={reach:g}: expected a number of spacings above 0, such as 4")
    distance, nearest = kd_tree(points[:, :3]).query(surface.mesh.vertices)
    around = local_spacing(points)
    keep = distance <= reach * np.maximum(around, np.median(around))[nearest]
    return part_of(surface, keep, f"reach={reach:g}", "a larger one")._replace(made_up=0.0)


def part_of(surface: ReconstructedSurface, keep: NDArray[np.bool_], key: str, cure: str) -> ReconstructedSurface:
    """The vertices to keep (v,), and the faces that use no others."""
    if keep.all():
        return surface
    faces = surface.mesh.faces[keep[surface.mesh.faces].all(1)]
    used = np.zeros(len(keep), bool)
    used[faces] = True
    if not used.any():
        raise ValueError(f"{key}: leaves no face of {len(surface.mesh.faces)}; give {cure}")
    number = np.cumsum(used) - 1
    return surface._replace(mesh=Mesh(surface.mesh.vertices[used], number[faces]), density=surface.density[used])


def interpolated_values(points: np.ndarray, values: np.ndarray, query: np.ndarray, k: int = 4) -> Array:
    """Values `(n, c)` of points `(n, 3)`, such as colors, at `query` `(m, 3)`: k nearest, by inverse distance."""
    far, near = kd_tree(points).query(query, k=np.arange(1, min(k, len(points)) + 1))
    weight = 1 / (far + 1e-9 * (far.max() or 1.0))
    mean: Array = (weight[..., None] * np.asarray(values, np.float64)[near]).sum(1) / weight.sum(1, keepdims=True)
    return mean
