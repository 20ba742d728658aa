"""Tables of an evaluation: terminal, JSON, CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pnu.benchmark.measuring import Row
from pnu.io import atomic_path, check_writable, write_json
from pnu.metrics import METRICS, Metric, Shown

if TYPE_CHECKING:
    from rich.table import Table

COSTS = (
    Shown("seconds", "seconds", "s", unit="seconds", form=".2f"),
    Shown("peak_memory_mb", "memory (MiB)", "MiB", unit="MiB", form=".0f"),
)
LEGEND = (
    "{words}; lengths x 1e3, in the {frame}. Normals: mean angle in degrees, signed (0..180) and unsigned (0..90); "
    "flipped: % of them. spacing: std/mean of the nearest distance; uniform.: spread of the density over disks of 1 % "
    "of the surface. floor: another Poisson-disk sampling of the true surface, as dense as the output."
)
REFERENCES = ("floor", "input")
WIDTH, WIDEST = 118, 1000  # letters of a table's line: even if a terminal has fewer, and at most


def legend(rows: Iterable[Row], metrics: Sequence[Metric] = METRICS) -> str:
    """What the numbers mean, their units and frame."""
    rows = list(rows)
    frames = dict.fromkeys(row["frame"] for row in rows)
    names = {name for row in rows for name in row}
    words = "; ".join(metric.words for metric in metrics if metric.words and metric.shown.name in names)
    return LEGEND.format(words=words, frame=f"frame of the truth ({', or '.join(frames)})")


def columns(rows: Iterable[Row], metrics: Sequence[Metric] = METRICS) -> list[Shown]:
    """What the rows have to be shown, in the order of the tables."""
    found = {name for row in rows for name in row}
    return [shown for shown in (*(metric.shown for metric in metrics), *COSTS) if shown.name in found]


def summarize(rows: Iterable[Row], metrics: Sequence[Metric] = METRICS) -> list[Row]:
    """Mean and spread (standard deviation) over shapes for each kind and method: keys `<metric>` and `<metric>_std`.

    A metric that some shape lacks is NaN, never the mean of the others.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["kind"], row["method"]), []).append(row)
    result = []
    for (kind, method), members in groups.items():
        summary: Row = {"kind": kind, "method": method, "shapes": len(members)}
        for name in (shown.name for shown in columns(members, metrics)):
            values = np.array([row.get(name, math.nan) for row in members])
            summary[name] = float(values.mean())
            summary[f"{name}_std"] = float(values.std(ddof=1)) if len(values) > 1 else math.nan
        result.append(summary)
    return result


def over_seeds(rows: Iterable[Row], metrics: Sequence[Metric] = METRICS) -> list[Row]:
    """Mean and standard deviation over runs that differ in their seed alone, of each run's mean over the shapes: keys
    `<metric>` and `<metric>_std`, and `seeds`. Runs of a sweep are told apart by their names, NAME_seed-N.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for summary in summarize(rows, metrics):
        name, found, _ = summary["method"].rpartition("_seed-")
        if found:
            groups.setdefault((summary["kind"], name), []).append(summary | {"method": name})
    repeated = [row for members in groups.values() if len(members) > 1 for row in members]
    return [{"seeds" if key == "shapes" else key: row[key] for key in row} for row in summarize(repeated, metrics)]


def print_over_seeds(rows: Sequence[Row], metrics: Sequence[Metric] = METRICS) -> None:
    """A table for each kind of input, where there are runs that differ in their seed alone."""
    from rich.table import Table

    found = over_seeds(rows, metrics)
    for kind in dict.fromkeys(row["kind"] for row in found):
        of_kind = [row for row in found if row["kind"] == kind]
        all_shown = columns([row for row in rows if row["kind"] == kind], metrics)
        table = Table(title=f"{kind}: mean ± standard deviation over seeds", title_justify="left", title_style="bold")
        table.add_column("method", overflow="fold")  # never cut: names may differ in their ends alone
        table.add_column("seeds")
        for shown in all_shown:
            table.add_column(shown.head or shown.title, justify="right")
        for row in of_kind:
            cells = (f"{row_cell(row, s)} ± {s.text(row.get(f'{s.name}_std'))}" for s in all_shown)
            table.add_row(row["method"], str(row["seeds"]), *cells)
        show(table)


def print_tables(rows: Sequence[Row], head: str, metrics: Sequence[Metric] = METRICS) -> None:
    """A table for each kind of input: every shape, then mean and spread, then the references' means."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=max(Console().width, WIDTH), highlight=False)
    summaries = summarize(rows, metrics)
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of_kind = [row for row in rows if row["kind"] == kind]
        all_shown = columns(of_kind, metrics)
        table = Table(title=f"{kind}: {counts(of_kind)}", title_justify="left", title_style="bold")
        for name in ("method", "shape"):
            table.add_column(name, overflow="fold")
        for shown in all_shown:
            table.add_column(shown.head or shown.title, justify="right")
        for summary in sorted((s for s in summaries if s["kind"] == kind), key=lambda s: s["method"] in REFERENCES):
            method = summary["method"]
            if method not in REFERENCES:
                for row in of_kind:
                    if row["method"] == method:
                        table.add_row(method, row["shape"], *(row_cell(row, shown) for shown in all_shown))
            table.add_row(method, "mean", *(row_cell(summary, shown) for shown in all_shown), style="bold")
            spread = {shown.name: summary.get(f"{shown.name}_std") for shown in all_shown}
            table.add_row(
                "", "spread", *(row_cell(spread, shown) for shown in all_shown), style="dim", end_section=True
            )
        show(table)
    console.print(f"{head.rstrip('.')}. {legend(rows, metrics)}\n")


def show(table: Table) -> None:
    """Print a table: on a terminal with columns as narrow as they must be, else as wide as it is."""
    from rich.console import Console

    console = Console(highlight=False)
    needed = WIDTH if console.is_terminal else Console(width=WIDEST).measure(table).maximum
    Console(width=max(console.width, WIDTH, needed), highlight=False).print(table)


def counts(rows: Sequence[Row]) -> str:
    """The numbers of points of one kind of input: "5000 -> 20000 points"."""
    made = [row for row in rows if row["method"] not in REFERENCES]
    pairs = sorted({(row["points_in"], row["points_out"]) for row in made})
    return ", ".join(f"{n} -> {m}" for n, m in pairs[:3]) + (" ..." if len(pairs) > 3 else "") + " points"


def row_cell(row: Mapping[str, Any], shown: Shown) -> str:
    """A value of a row as its table shows it."""
    return shown.text(row.get(shown.name))


def write_results(
    folder: str | Path, rows: Sequence[Row], head: Mapping[str, Any], metrics: Sequence[Metric] = METRICS
) -> None:
    """metrics.json (head, rows, means and spreads) and metrics.csv (rows) in a folder that is there."""
    folder = Path(folder)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(folder / "metrics.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    content = {
        **head,
        **used_points(rows),
        "legend": legend(rows, metrics),
        "rows": list(rows),
        "summary": summarize(rows, metrics),
        "over_seeds": over_seeds(rows, metrics),
    }
    write_json(folder / "metrics.json", content)


def used_points(rows: Iterable[Row]) -> dict[str, Any]:
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
