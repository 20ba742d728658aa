"""Files side by side in the viewer: clouds, surfaces, or both."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pnu.rendering import in_one_place
from pnu.rendering.colors import typical_limit
from pnu.rendering.file_panels import Shape
from pnu.report.offline_page import write_page
from pnu.report.scan_page import FEWEST
from pnu.report.viewer_data import Drawing, ShapeView

BYTES_POINT, BYTES_VERTEX = 16.0, 24.0  # in a page, packed, with normals, quality and colors


class ViewedFiles(NamedTuple):
    """What a page shows of files."""

    views: list[ShapeView]  # one where the files lie in one place, else one for each
    notes: list[str]  # what was left out or found, a line each


def views_of(shapes: Sequence[Shape], points: int) -> ViewedFiles:
    """The files with one camera if they are of one size and place, else each alone; at most `points` of a cloud.

    Raises:
        ValueError: a cloud has too few points, or no extent.
    """
    notes = [f"{Path(shape.path).name}: {note}" for shape in shapes for note in shape.notes]
    names = distinct_titles([Path(shape.path).name for shape in shapes])
    drawings = []
    for name, shape in zip(names, shapes, strict=True):
        drawing, shown = drawing_of(name, shape, points)
        drawings.append(drawing)
        if shown < len(shape.points):
            notes.append(f"{name}: {shown} of its {len(shape.points)} points are shown, every k-th")
    qualities = [shape.attributes["quality"] for shape in shapes if "quality" in shape.attributes]
    limit = max((typical_limit(quality) for quality in qualities), default=0) or 1.0
    clouds = [shape.points for shape in shapes]
    together = in_one_place(*clouds)
    groups = [list(range(len(shapes)))] if together else [[i] for i in range(len(shapes))]
    if not together:
        notes.append("the files differ in size or place, so each has a camera of its own")
    views = []
    for group in groups:
        center, radius = frame([clouds[i] for i in group])
        title = names[group[0]] if len(group) == 1 else f"{len(group)} files"
        shown_here = [drawings[i] for i in group]
        views.append(ShapeView(title, "", shown_here, center, radius, limit, "quality", "quality"))
    return ViewedFiles(views, notes)


def drawing_of(name: str, shape: Shape, points: int) -> tuple[Drawing, int]:
    """How a file is drawn, and how many of its points are."""
    colors = shape.attributes.get("colors")
    quality = shape.attributes.get("quality")
    if shape.mesh is not None:
        stored = None if colors is None else colors[:, :3]
        return Drawing(name, surface=shape.mesh, surface_error=quality, stored=stored), len(shape.points)
    if len(shape.points) < FEWEST:
        raise ValueError(f"{shape.path}: has {len(shape.points)} points, at least {FEWEST} can be shown")
    every = slice(None, None, -(-len(shape.points) // points))
    cloud = shape.points if shape.normals is None else np.hstack([shape.points, shape.normals])
    stored = None if colors is None else colors[every, :3]
    drawing = Drawing(name, cloud[every], None if quality is None else quality[every], stored=stored)
    return drawing, len(cloud[every])


def frame(clouds: Sequence[np.ndarray]) -> tuple[np.ndarray, float]:
    """Center and radius of what the viewer shows, without the farthest thousandth of each cloud on each side."""
    boxes = [np.quantile(points[:, :3], (0.001, 0.999), axis=0) for points in clouds]
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    radius = float(np.linalg.norm(high - low) / 2)
    return (low + high) / 2, radius or 1.0


def distinct_titles(names: Sequence[str]) -> list[str]:
    """The names, those that come again with a number."""
    return [f"{name} ({names[:i].count(name) + 1})" if name in names[:i] else name for i, name in enumerate(names)]


def points_that_fit(shapes: Sequence[Shape], size_mb: float) -> int:
    """How many points of each cloud a page of about that size holds beside the surfaces."""
    vertices = sum(len(shape.points) for shape in shapes if shape.mesh is not None)
    clouds = sum(shape.mesh is None for shape in shapes)
    return max(int((size_mb * 1e6 - vertices * BYTES_VERTEX) / (BYTES_POINT * max(clouds, 1))), FEWEST)


def write_view_page(path: str | Path, viewed: ViewedFiles, *, up: str, title: str) -> int:
    """Write the page atomically; returns its size in bytes."""
    stored = any(drawing.stored is not None for view in viewed.views for drawing in view.drawings)
    pick = {"up": up} | ({"mode": "colors"} if stored else {})
    return write_page(path, title, {}, viewed.views, head=viewed.notes, pick=pick)
