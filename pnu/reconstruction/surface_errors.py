"""How far a reconstructed surface lies from the true one, vertex by vertex."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.mesh_sampling import closest_points, face_normals, sample_area
from pnu.geometry.mesh_topology import vertex_normals
from pnu.io import Mesh
from pnu.rendering.colors import typical_limit, value_colors

Array = NDArray[np.float64]

ELSEWHERE = 0.05  # of the true radius: if half of the points lie farther off, they are in another frame


class SurfaceErrors(NamedTuple):
    """Errors of a mesh against the true one, in the unit of the coordinates."""

    distance: Array  # (v,) from each vertex to the true surface
    normal_deg: Array  # (v,) angle between a vertex's normal and the true one at the closest point, 0..180
    from_truth: Array  # (samples,) from points of the true surface, even by area, to the mesh
    radius: float  # of the true surface: largest distance of a vertex from the middle of its box

    def summary(self) -> dict[str, float]:
        """Mean, root mean square and maximum of each; distances in the unit of the coordinates, flipped as a share."""
        result = {"radius": self.radius, "vertices": len(self.distance), "samples_of_truth": len(self.from_truth)}
        for name, values in self._by_name().items():
            result |= {f"{name}_mean": float(values.mean()), f"{name}_rms": float(np.sqrt((values**2).mean()))}
            result[f"{name}_max"] = float(values.max())
        return result | {"flipped": float((self.normal_deg > 90).mean())}

    def table(self) -> str:
        """The summary for a terminal; distances in thousandths of the true radius."""
        rows = [f"errors, in 1/1000 of the true radius ({self.radius:.6g}):       mean      RMS      max"]
        heads = ("mesh -> truth, each vertex", "truth -> mesh, even by area", "normals at vertices, degrees")
        for (name, values), head in zip(self._by_name().items(), heads, strict=True):
            scaled = values if name == "normal_deg" else 1e3 * values / self.radius
            numbers = (scaled.mean(), np.sqrt((scaled**2).mean()), scaled.max())
            rows.append(f"  {head:<{len(rows[0]) - 29}}" + "".join(f"{number:9.3f}" for number in numbers))
        return "\n".join(rows)

    def colors(self, limit: float | None = None, colormap: str = "error") -> NDArray[np.uint8]:
        """Colors `(v, 3)` of the distances from 0 to `limit`; default: `typical_limit` of them."""
        return value_colors(self.distance, (0, limit or typical_limit(self.distance)), colormap)

    def _by_name(self) -> dict[str, Array]:
        return {"to_truth": self.distance, "from_truth": self.from_truth, "normal_deg": self.normal_deg}


def surface_errors(mesh: Mesh, truth: Mesh, *, rng: np.random.Generator, samples: int = 20_000) -> SurfaceErrors:
    """Distances between two surfaces in both directions, and the angle between their normals."""
    _, distance, face = closest_points(truth, mesh.vertices)
    cosine = (vertex_normals(mesh) * face_normals(truth)[face]).sum(1)
    from_truth = closest_points(mesh, sample_area(truth, samples, rng)[:, :3])[1]
    return SurfaceErrors(distance, np.degrees(np.arccos(cosine.clip(-1, 1))), from_truth, box_radius(truth))


def check_frame(points: np.ndarray, truth: Mesh, *, name: str = "cloud", truth_name: str = "truth") -> None:
    """ValueError if the points `(n, 3)` cannot lie on the true surface, because they are in another frame or unit.

    Half of them (of at most 1000) must lie within 5 % of the true radius.
    """
    radius = box_radius(truth)
    surface = sample_area(truth, 20_000, np.random.default_rng(0))[:, :3]  # fine enough for 5 %, and fast anywhere
    off = float(np.median(kd_tree(surface).query(points[:: -(-len(points) // 1000)])[0]))
    if off > ELSEWHERE * radius:
        used = truth.vertices[np.unique(truth.faces)]
        centers = [(p.min(0) + p.max(0)) / 2 for p in (points, used)]
        apart = np.linalg.norm(centers[0] - centers[1])
        size = np.ptp(points, axis=0).max() / np.ptp(used, axis=0).max()
        raise ValueError(
            f"{truth_name}: is not in the frame of {name}, half of whose points lie more than {off / radius:.0%} of "
            f"its radius off (middles {apart:.3g} apart, {size:.3g} times as large); bring both into one frame"
        )


def box_radius(mesh: Mesh) -> float:
    """Largest distance of a vertex from the middle of the box; vertices without a face are no part of the surface."""
    used = mesh.vertices[np.unique(mesh.faces)]
    return float(np.linalg.norm(used - (used.min(0) + used.max(0)) / 2, axis=1).max())
