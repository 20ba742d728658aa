"""Panels of cloud and mesh files."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.mesh_topology import vertex_normals
from pnu.geometry.normal_estimation import complete_normals
from pnu.io import CLOUD_SUFFIXES, MESH_SUFFIXES, Mesh, read_cloud, read_mesh
from pnu.io.cloud import READERS as CLOUD_READERS
from pnu.io.mesh import READERS as MESH_READERS
from pnu.rendering.camera import Camera
from pnu.rendering.colors import normal_colors, typical_limit, value_colors
from pnu.rendering.figure import ColorBar
from pnu.rendering.render import STONE, render_cloud, render_mesh

MINIMUM = 16  # points from which normals can be estimated
COLORS = ("auto", "quality", "stored", "normal", "plain")


class Shape(NamedTuple):
    """What a file shows."""

    path: str
    points: NDArray[np.float64]  # (n, 3), of a mesh its vertices
    normals: NDArray[np.float64] | None  # (n, 3)
    mesh: Mesh | None
    attributes: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()  # what was found and done while the file was read

    def source(self, color: str) -> str:
        """What a choice of COLORS means here: never auto. ValueError where the file lacks it."""
        needs = {"quality": "quality" in self.attributes, "stored": "colors" in self.attributes}
        needs |= {"normal": self.normals is not None, "plain": True}
        if color == "auto":
            return next(name for name in COLORS[1:] if needs[name] and not (name == "normal" and self.mesh is not None))
        if not needs[color]:
            raise ValueError(f"{self.path}: holds nothing for color={color}; use color=auto, or another file")
        return color

    def colors(self, color: str, bar: ColorBar | None) -> NDArray[np.uint8] | None:
        """Colors `(n, 3)` of the points; None for the surface's own."""
        source = self.source(color)
        if source == "quality" and bar is not None:
            return value_colors(self.attributes["quality"], bar.limits, bar.colormap)
        if source == "stored":
            return self.attributes["colors"][:, :3]
        if source == "normal" and self.normals is not None:
            return normal_colors(self.normals)
        return None if self.mesh is not None else np.tile(np.array(STONE, np.uint8), (len(self.points), 1))

    def draw(
        self, camera: Camera, color: str, bar: ColorBar | None, *, size: int, radius: float | None, smooth: bool
    ) -> NDArray[np.uint8]:
        """The panel, `(size, size, 3)`."""
        colors = self.colors(color, bar)
        if self.mesh is not None:
            return render_mesh(self.mesh, colors, camera=camera, size=size, smooth=smooth)
        cloud = self.points if self.normals is None else np.hstack([self.points, self.normals])
        return render_cloud(cloud, colors, camera=camera, size=size, radius=radius)


def read_shape(path: str, columns: str | None = None) -> Shape:
    """A file with faces as a mesh, any other as a cloud. ValueError as in `pnu.io`; columns as in `read_cloud`."""
    suffix = Path(path).suffix.lower()
    if suffix in MESH_SUFFIXES and Path(path).is_file() and len(MESH_READERS[suffix](Path(path)).faces):
        mesh = read_mesh(path)
        # as the file has them, one a vertex: a cloud's points at one place are one
        attributes = CLOUD_READERS[suffix](Path(path)).attributes if suffix in CLOUD_SUFFIXES else {}
        return Shape(path, mesh.vertices, vertex_normals(mesh), mesh, attributes)
    points, normals, attributes, notes = read_cloud(path, minimum=1, columns=columns)
    if normals is not None and np.isnan(normals).any():
        enough = len(points) >= MINIMUM
        normals = complete_normals(points, normals) if enough else None
    return Shape(path, points, normals, None, attributes, notes)


def quality_bar(shapes: Sequence[Shape], color: str, limit: float | None, colormap: str, label: str) -> ColorBar | None:
    """The one color scale, from 0, of all shapes that are colored by quality; None where there are none."""
    values = [shape.attributes["quality"] for shape in shapes if shape.source(color) == "quality"]
    if not values:
        return None
    return ColorBar((0, limit or max(typical_limit(quality) for quality in values)), label, colormap)
