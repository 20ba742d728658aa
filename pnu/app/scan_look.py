"""What `pnu app` shows of a scan before anything is made of it, and of what was made."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu.cleaning import Cleaned
from pnu.geometry.cloud_statistics import CloudStatistics, describe_cloud
from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.open_rims import OpenRim, open_rims
from pnu.io import Cloud
from pnu.io.atomic import atomic_path
from pnu.rendering.colors import typical_limit
from pnu.rendering.file_panels import Shape, read_shape
from pnu.report.view_page import frame
from pnu.report.viewer_data import Drawing, ShapeView, view_arrays

SHOWN = 1_000_000  # points of a cloud in the browser
STRAY, TURNED, RIM = 1, 2, 3  # what is marked, as the viewer colors it
UPWARD = {".las", ".laz", ".e57"}  # formats of scanners: z points up
MADE = 1_000_000  # points that are proposed at most
WIDE = 0.35  # of the radius: rims beyond are borders, no holes


def look_at_scan(path: str, before: Cloud, cleaned: Cleaned, view: str) -> dict[str, Any]:
    """What is found in a scan as read, cleaned by the defaults, with what is proposed, as JSON; writes its view."""
    kept = kept_rows(before, cleaned)
    turned = turned_normals(before, cleaned, kept)
    rims = open_rims(before.points[kept])
    found = np.zeros(len(before.points), np.uint8)
    for rim in rims:
        found[kept[rim.rows]] = RIM
    found[turned], found[cleaned.stray] = TURNED, STRAY
    statistics = describe_cloud(before.points[kept], None if before.normals is None else before.normals[kept])
    center, radius = frame([before.points[kept]])
    rows = shown_rows(len(before.points), cleaned.stray)
    drawing = scan_drawing(before, found, rows)
    notes = thinned_notes({"the scan": (len(rows), len(before.points))})
    head = write_arrays(view, ShapeView(path, "", [drawing], center, radius, 1.0))
    return {
        "points": len(before.points),
        "origin": "with normals" if before.normals is not None else "without normals",
        "colors": "colors" in before.attributes,
        "up": "z" if Path(path).suffix.lower() in UPWARD else "y",
        "findings": findings(statistics, cleaned, turned, rims),
        "notes": [*cleaned.cloud.notes, *statistics.warnings(), *notes],
        "proposal": proposal(len(kept), statistics, rims, radius),
        "view": head,
    }


def kept_rows(before: Cloud, cleaned: Cleaned) -> NDArray[np.int64]:
    """Rows of the scan that are not stray."""
    return np.setdiff1d(np.arange(len(before.points)), cleaned.stray)


def turned_normals(before: Cloud, cleaned: Cleaned, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the scan whose own normals were turned to the other side."""
    after = cleaned.cloud.normals
    if before.normals is None or after is None or len(after) != len(kept):
        return np.empty(0, np.int64)
    against: NDArray[np.bool_] = (before.normals[kept] * after).sum(1) < 0
    return kept[against]


def findings(
    statistics: CloudStatistics, cleaned: Cleaned, turned: NDArray[np.int64], rims: list[OpenRim]
) -> list[dict[str, str]]:
    """A line for each kind of thing, with the color of its marks: stray, turned, rim, or none."""
    stray = len(cleaned.stray)
    wide = f"; the widest is {2 * rims[0].radius:.3g} across" if rims else ""
    lines = [
        ("stray", f"{stray} stray points, off the surface" if stray else "", "no stray points"),
        ("turned", f"{len(turned)} normals contradict those beside them" if len(turned) else "", ""),
        (
            "rim",
            f"open rims, of holes or borders: {len(rims)}{wide}" if rims else "",
            "no holes seen",
        ),
    ]
    said = [{"kind": kind if text else "none", "text": text or other} for kind, text, other in lines if text or other]
    return [*said, *({"kind": "none", "text": text} for text in str(statistics).split("; ") if text)]


def proposal(points: int, statistics: CloudStatistics, rims: list[OpenRim], radius: float) -> dict[str, Any]:
    """Values of the form: the commands' defaults, fewer points where they would become very many."""
    ratio = next((ratio for ratio in (4, 2) if ratio * points <= MADE), 1)
    holes = max((rim.radius for rim in rims if rim.radius < WIDE * radius), default=5 * statistics.middle)
    return {"ratio": ratio, "spacing": rounded(statistics.middle / ratio**0.5), "holes": rounded(1.1 * holes)}


def rounded(value: float) -> float:
    """To three digits."""
    return float(f"{value:.3g}")


def show_result(path: str, before: Cloud, cleaned: Cleaned, dense: str, mesh: str | None, view: str) -> dict[str, Any]:
    """The scan, the dense cloud and the surface side by side, as JSON; writes the view.

    Each point of a result has the distance to the nearest point of the cleaned scan; the scan's, to the dense cloud.
    """
    kept = kept_rows(before, cleaned)
    found = np.zeros(len(before.points), np.uint8)
    found[turned_normals(before, cleaned, kept)], found[cleaned.stray] = TURNED, STRAY
    rows = shown_rows(len(before.points), cleaned.stray)
    cloud = read_shape(dense)
    some = shown_rows(len(cloud.points))
    tree = kd_tree(before.points[kept])
    errors = [kd_tree(cloud.points).query(before.points[rows])[0], tree.query(cloud.points[some])[0]]
    drawings = [
        scan_drawing(before, found, rows)._replace(cloud_error=errors[0]),
        cloud_drawing(cloud, some, errors[1]),
    ]
    made = {"scan": len(before.points), "stray": len(cleaned.stray), "dense": len(cloud.points), "faces": 0}
    if mesh is not None:
        surface = read_shape(mesh)
        errors.append(tree.query(surface.points)[0])
        all_rows = np.arange(len(surface.points))
        drawings.append(
            Drawing("surface", surface=surface.mesh, surface_error=errors[2], stored=colors_of(surface, all_rows))
        )
        made["faces"] = 0 if surface.mesh is None else len(surface.mesh.faces)
    center, radius = frame([before.points[kept]])
    limit = typical_limit(np.concatenate(errors[1:]))
    bar = "distance from the scan, of the scan from the dense cloud"
    shape_view = ShapeView(path, "", drawings, center, radius, limit, "distance", bar)
    counts = {"the scan": (len(rows), len(before.points)), "the dense cloud": (len(some), len(cloud.points))}
    return {"made": made, "notes": thinned_notes(counts), "view": write_arrays(view, shape_view)}


def scan_drawing(before: Cloud, found: NDArray[np.uint8], rows: NDArray[np.int64]) -> Drawing:
    """Rows of a scan, marked."""
    colors = before.attributes.get("colors")
    normals = before.normals
    if normals is not None:
        normals = np.nan_to_num(normals)
    stored = None if colors is None else colors[rows, :3]
    return Drawing("scan", points_and_normals(before.points, normals, rows), stored=stored, found=found[rows])


def cloud_drawing(cloud: Shape, rows: NDArray[np.int64], error: np.ndarray) -> Drawing:
    """Rows of the dense cloud."""
    both = points_and_normals(cloud.points, cloud.normals, rows)
    return Drawing("dense cloud", both, error, stored=colors_of(cloud, rows))


def points_and_normals(points: np.ndarray, normals: np.ndarray | None, rows: NDArray[np.int64]) -> np.ndarray:
    """Rows of a cloud (k, 3), or (k, 6) where it has normals."""
    return points[rows] if normals is None else np.hstack([points[rows], normals[rows]])


def colors_of(shape: Shape, rows: NDArray[np.int64]) -> np.ndarray | None:
    """The file's own colors (k, 3) of rows."""
    colors = shape.attributes.get("colors")
    return None if colors is None else np.asarray(colors)[rows, :3]


def shown_rows(count: int, always: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Every k-th of so many rows, about a million at most, and some that shall be seen."""
    every = np.arange(0, count, -(-count // SHOWN))
    return every if always is None else np.union1d(every, always[:SHOWN])


def thinned_notes(counts: dict[str, tuple[int, int]]) -> list[str]:
    """What is not shown, a line each."""
    return [f"of {name} {some} of {all_} points are shown" for name, (some, all_) in counts.items() if some < all_]


def write_arrays(path: str, view: ShapeView) -> dict[str, Any]:
    """Write the arrays of a view; returns what tells where they lie."""
    head, data = view_arrays(view)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return head
