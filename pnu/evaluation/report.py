"""Tables of an evaluation: terminal, JSON, CSV."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pnu.evaluation.measure import Row
from pnu.io import atomic_path, check_writable, write_json


class Metric(NamedTuple):
    """How tables show a metric."""

    head: str
    factor: float
    digits: int


METRICS = {
    "chamfer_sq": Metric("CD", 1e3, 4),
    "hausdorff_sq": Metric("HD", 1e3, 3),
    "p2f": Metric("P2F", 1e3, 3),
    "normal_deg": Metric("normal", 1, 2),
    "normal_unsigned_deg": Metric("unsigned", 1, 2),
    "flipped": Metric("flipped", 100, 2),
    "spacing_cv": Metric("spacing", 1, 3),
    "uniformity": Metric("uniform.", 1, 3),
    "seconds": Metric("s", 1, 2),
    "peak_memory_mb": Metric("MiB", 1, 0),
}
LEGEND = (
    "CD: mean squared distances, both directions added; HD: largest squared distance; P2F: mean distance to the true "
    "mesh; all three x 1e3, in the {frame}. Normals: mean angle in degrees, signed (0..180) and unsigned (0..90); "
    "flipped: % of them. spacing: std/mean of the nearest distance; uniform.: spread of the density over disks of 1 % "
    "of the surface. floor: another Poisson-disk sampling of the true surface, as dense as the output."
)
REFERENCES = ("floor", "input")


def legend(rows: Iterable[Row]) -> str:
    """What the numbers mean, their units and frame."""
    frames = dict.fromkeys(row["frame"] for row in rows)
    return LEGEND.format(frame=f"frame of the truth ({', or '.join(frames)})")


def summarize(rows: Iterable[Row]) -> list[Row]:
    """Mean and spread (standard deviation) over shapes for each kind and method: keys `<metric>` and `<metric>_std`.

    A metric that some shape lacks is NaN, never the mean of the others.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["kind"], row["method"]), []).append(row)
    result = []
    for (kind, method), members in groups.items():
        summary: Row = {"kind": kind, "method": method, "shapes": len(members)}
        for name in METRICS:
            if any(name in row for row in members):
                values = np.array([row.get(name, math.nan) for row in members])
                summary[name] = float(values.mean())
                summary[f"{name}_std"] = float(values.std(ddof=1)) if len(values) > 1 else math.nan
        result.append(summary)
    return result


def print_tables(rows: Sequence[Row], head: str) -> None:
    """A table for each kind of input: every shape, then mean and spread, then the references' means."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=max(Console().width, 118), highlight=False)
    summaries = summarize(rows)
    names = [name for name in METRICS if any(name in row for row in rows)]
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of_kind = [row for row in rows if row["kind"] == kind]
        table = Table(title=f"{kind}: {counts(of_kind)}", title_justify="left", title_style="bold")
        table.add_column("method")
        table.add_column("shape")
        for name in names:
            table.add_column(METRICS[name].head, justify="right")
        for summary in sorted((s for s in summaries if s["kind"] == kind), key=lambda s: s["method"] in REFERENCES):
            method = summary["method"]
            if method not in REFERENCES:
                for row in of_kind:
                    if row["method"] == method:
                        table.add_row(method, row["shape"], *(cell(row, name) for name in names))
            table.add_row(method, "mean", *(cell(summary, name) for name in names), style="bold")
            spread = {name: summary.get(f"{name}_std", math.nan) for name in names}
            table.add_row("", "spread", *(cell(spread, name) for name in names), style="dim", end_section=True)
        console.print(table)
    console.print(f"{head}. {legend(rows)}\n")


def counts(rows: Sequence[Row]) -> str:
    """The numbers of points of one kind of input: "5000 -> 20000 points"."""
    made = [row for row in rows if row["method"] not in REFERENCES]
    pairs = sorted({(row["points_in"], row["points_out"]) for row in made})
    return ", ".join(f"{n} -> {m}" for n, m in pairs[:3]) + (" ..." if len(pairs) > 3 else "") + " points"


def cell(row: Mapping[str, Any], name: str) -> str:
    value = row.get(name, math.nan)
    return "-" if math.isnan(value) else f"{METRICS[name].factor * value:.{METRICS[name].digits}f}"


def write_results(folder: str | Path, rows: Sequence[Row], head: Mapping[str, Any]) -> None:
    """metrics.json (head, rows, means and spreads) and metrics.csv (rows) in a folder that is there."""
    folder = Path(folder)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(folder / "metrics.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    content = {**head, **counted(rows), "legend": legend(rows), "rows": list(rows), "summary": summarize(rows)}
    write_json(folder / "metrics.json", content)


def counted(rows: Iterable[Row]) -> dict[str, Any]:
    """The numbers of points that were used, whatever was asked for: one, or all of them where they differ."""
    found: dict[str, Any] = {}
    for name, values in (
        ("points", {row["points_in"] for row in rows if row["method"] == "input"}),
        ("truth_points", {row["truth_points"] for row in rows if "truth_points" in row}),
    ):
        if values:
            found[name] = min(values) if len(values) == 1 else sorted(values)
    return found


def result_folder(path: str | Path, within: str | Path | None = None) -> Path:
    """The folder, made where it is not there yet; ValueError if files cannot be written to it, or if a link leads
    out of the folder `within`."""
    path = Path(path)
    if within is not None and not path.resolve().is_relative_to(Path(within).resolve()):
        raise ValueError(f"{path}: a link leads out of {within}, to {path.resolve()}; give output=FOLDER")
    try:
        path.mkdir(parents=True, exist_ok=True)
        check_writable(path / "metrics.json")
    except OSError as error:
        raise ValueError(
            f"output={path}: cannot be made a folder ({error.strerror}); choose another with output=FOLDER"
        ) from None
    return path
