"""The tables of the page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pnu.benchmark import Row, columns, summarize
from pnu.benchmark.result_tables import REFERENCES, counts
from pnu.metrics import METRICS, Metric, Shown
from pnu.report import offline_page
from pnu.report.html_tables import cell_text

ACROSS = 6  # shapes in a table, twice: more do not fit a window of 1400 pixels
SURFACE_COLUMNS = {
    "to_truth_mean": ("mean", 1e3),
    "to_truth_rms": ("RMS", 1e3),
    "to_truth_max": ("max", 1e3),
    "from_truth_mean": ("mean back", 1e3),
    "from_truth_max": ("max back", 1e3),
    "normal_deg_mean": ("normal", 1.0),
}


def tables(
    rows: Sequence[Row], surface_rows: Sequence[Row], metrics: Sequence[Metric] = METRICS
) -> dict[str, list[offline_page.Table]]:
    """For each kind of input: the means of all metrics, the paper's Table 1 (CD and HD of each shape), the surfaces."""
    result = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of_kind = [row for row in rows if row["kind"] == kind]
        made = [row for row in surface_rows if row["kind"] == kind]
        shapes = list(dict.fromkeys(row["shape"] for row in of_kind))
        found = [means(of_kind, len(shapes), metrics)]
        found += [table_1(of_kind, shapes[i : i + ACROSS], metrics) for i in range(0, len(shapes), ACROSS)]
        result[kind] = found + ([surface_table(made)] if made else [])
    return result


def means(rows: Sequence[Row], shapes: int, metrics: Sequence[Metric]) -> offline_page.Table:
    """The table of each method's means over the shapes."""
    all_shown = columns(rows, metrics)
    heads = [offline_page.Column(shown.head or shown.title, shown.form, better=shown.better) for shown in all_shown]
    body = [
        offline_page.Row(
            summary["method"], [table_value(summary, shown) for shown in all_shown], summary["method"] in REFERENCES
        )
        for summary in summarize(rows, metrics)
    ]
    return offline_page.Table(f"Mean of {shapes} shapes, {counts(rows)}", heads, references_last(body))


def table_1(rows: Sequence[Row], shapes: Sequence[str], metrics: Sequence[Metric] = METRICS) -> offline_page.Table:
    """The paper's Table 1: CD and HD of each shape."""
    both = [metric.shown for metric in metrics if metric.shown.head in ("CD", "HD")]
    heads = [offline_page.Column(shape, shown.form, group=shown.head) for shown in both for shape in shapes]
    by_place = {(row["method"], row["shape"]): row for row in rows}
    body = [
        offline_page.Row(
            method,
            [table_value(by_place.get((method, shape), {}), shown) for shown in both for shape in shapes],
            method in REFERENCES,
        )
        for method in dict.fromkeys(row["method"] for row in rows)
    ]
    return offline_page.Table("Each shape, as Table 1 of the paper", heads, references_last(body))


def surface_table(rows: Sequence[Row]) -> offline_page.Table:
    """Means over shapes; a method without a surface of some shape gets none."""
    shapes = {row["shape"] for row in rows}
    heads = [offline_page.Column(head) for head, _ in SURFACE_COLUMNS.values()]
    body = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        values = [
            factor * float(np.mean([row[name] for row in own])) if len(own) == len(shapes) else None
            for name, (_, factor) in SURFACE_COLUMNS.items()
        ]
        body.append(offline_page.Row(method, values, method in REFERENCES))
    caption = "Surfaces reconstructed from the clouds (Poisson), x 1e3 of the true radius; normals in degrees"
    return offline_page.Table(caption, heads, references_last(body))


def table_value(row: Mapping[str, Any], shown: Shown) -> float | None:
    """A value times the factor of its table."""
    return shown.factor * row[shown.name] if shown.name in row else None


def print_surfaces(rows: Sequence[Row]) -> None:
    """The table of the surfaces of each kind of input, as Markdown."""
    for kind in dict.fromkeys(row["kind"] for row in rows):
        table = surface_table([row for row in rows if row["kind"] == kind])
        heads = ["method", *(column.head for column in table.columns)]
        lines = [heads, ["---"] * len(heads)]
        lines += [[row.name, *(cell_text(value, ".2f") for value in row.values)] for row in table.rows]
        print("\n".join([f"{kind}: {table.caption}", "", *(f"| {' | '.join(line)} |" for line in lines), ""]))


def references_last(rows: Sequence[offline_page.Row]) -> list[offline_page.Row]:
    """The rows, those of input and floor last."""
    return sorted(rows, key=lambda row: row.reference)
