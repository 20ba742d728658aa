"""Several methods beside each other: tables, surfaces with their errors, figures and 3D views on one page."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pnu import rendering
from pnu.benchmark import Row, write_results
from pnu.io import atomic_path
from pnu.metrics import METRICS, Metric
from pnu.report import offline_page
from pnu.report.comparison_tables import tables
from pnu.report.shape_views import (
    Look,
    Rebuilt,
    ShownCase,
    normals_figure,
    points_for,
    rebuild,
    shape_figure,
    shapes_figure,
    surface_rows,
    view,
)

__all__ = ["Look", "ShownCase", "Written", "write_comparison"]


LOOK = Look()


class Written(NamedTuple):
    """What became of it."""

    size: int  # of the page, in bytes
    points: int  # of each cloud in the 3D views, at most
    notes: list[str]  # on surfaces that could not be made, or look wrong
    surfaces: list[Row]  # their errors


def write_comparison(
    folder: Path,
    rows: Sequence[Row],
    shown: Sequence[ShownCase],
    *,
    title: str,
    head: Sequence[str],
    settings: Mapping[str, Any],
    rebuilt_kinds: Sequence[str] = (),
    look: Look = LOOK,
    page_mb: float = 40,
    picture: str | Path | None = None,
    metrics: Sequence[Metric] = METRICS,
    seed: int = 0,
    step: Callable[[str], None] = lambda text: None,
) -> Written:
    """index.html, metrics.json, metrics.csv and figures/<shape>_<kind>.png in a folder that is there.

    Args:
        rows: of `evaluation.evaluate`.
        shown: cases for figures and 3D views, with all clouds.
        head: paragraphs below the title.
        settings: kept in metrics.json.
        rebuilt_kinds: kinds of input whose clouds are made surfaces too, which takes seconds for each.
        page_mb: about the size of the page that is allowed; clouds are thinned to fit.
        picture: webp to write, all shapes in one: surfaces and their errors, or clouds by normals if none is rebuilt.
        metrics: in the order of the tables.
        step: told what comes next, once for each of `shown`.
    """
    write_results(folder, rows, settings, metrics)
    (folder / "figures").mkdir(exist_ok=True)
    rebuilt: list[dict[str, Rebuilt]] = []
    surfaces: list[Row] = []
    notes: list[str] = []
    drawn: dict[str, bytes] = {}
    for one in shown:
        shape, kind = one.case.truth.shape, one.case.kind
        step(f"{shape}, {kind}: surfaces and figures")
        made, said = rebuild(one, seed) if kind in rebuilt_kinds else ({}, [])
        rebuilt.append(made)
        notes += said
        surfaces += surface_rows(one.case, made)
        if made or not rebuilt_kinds:
            figure = shape_figure(one, made, look)
            rendering.save_png(folder / "figures" / f"{shape}_{kind}.png", figure)
            drawn[f"{shape}, {kind}"] = rendering.webp(figure)
    if picture and drawn:
        pairs = [pair for pair in zip(shown, rebuilt, strict=True) if pair[1]]
        errors = {(row["shape"], row["kind"], row["method"]): row.get("normal_unsigned_deg") for row in rows}
        all_shapes = shapes_figure(pairs, look) if pairs else normals_figure(shown, errors, look)
        with atomic_path(picture) as temporary:
            temporary.write_bytes(rendering.webp(all_shapes, quality=80))
    elif picture:
        notes.append(f"{picture}: not written, since there are no surfaces")
    vertices = sum(len(surface.mesh.vertices) for made in rebuilt for surface in made.values())
    points = points_for(page_mb, sum(len(one.clouds) + 1 for one in shown), vertices)
    largest = max((len(cloud) for one in shown for cloud in (*one.clouds.values(), one.case.truth.samples)), default=0)
    views = [view(one, made, points) for one, made in zip(shown, rebuilt, strict=True)]
    write_results(folder, rows, {**settings, "surfaces": surfaces}, metrics)
    size = offline_page.write_page(
        folder / "index.html",
        title,
        tables(rows, surfaces, metrics),
        views,
        head=head,
        foot=notes,
        views_note="" if points >= largest else f"Of clouds with more than {points} points, every k-th is shown.",
        figures=drawn,
        colormap=look.colormap,
    )
    return Written(size, points, notes, surfaces)
