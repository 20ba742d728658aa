"""A scan, what was taken out of it, the dense cloud and the surface, side by side on one page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pnu.io import Cloud, Mesh
from pnu.report.offline_page import write_page
from pnu.report.viewer_data import Drawing, ShapeView

MOST = 60_000  # points of a cloud that is drawn
FEWEST = 8  # points that have a spacing


def write_scan_page(
    path: str | Path,
    name: str,
    scan: Cloud,
    stray: np.ndarray,
    notes: Sequence[str],
    dense: np.ndarray,
    mesh: Mesh,
) -> int:
    """Write the page atomically; returns its size in bytes.

    Args:
        scan: as it was read.
        stray: rows of it that were taken out.
        notes: what was found and done, a line each.
        dense: points and normals (m, 6).
    """
    kept = np.delete(np.arange(len(scan.points)), stray)
    low, high = np.quantile(scan.points[kept], (0.001, 0.999), axis=0)
    center, radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
    drawings = [
        Drawing("scan", scan.points[every_kth(np.arange(len(scan.points)))]),
        *([Drawing("taken out", scan.points[stray])] if len(stray) >= FEWEST else []),
        Drawing("dense cloud", dense[every_kth(np.arange(len(dense)))]),
        Drawing("surface", surface=mesh),
    ]
    counts = f"{len(scan.points)} points read, {len(dense)} made, {len(mesh.faces)} faces."
    largest = max(len(scan.points), len(dense))
    return write_page(
        path,
        name,
        {},
        [ShapeView(name, "scan", drawings, center, radius, 1.0)],
        head=[counts, *notes],
        views_note="" if largest <= MOST else f"Of clouds with more than {MOST} points, every k-th is shown.",
    )


def every_kth(rows: np.ndarray) -> np.ndarray:
    """Every k-th of the rows, at most `MOST`."""
    return rows[:: -(-len(rows) // MOST)]
