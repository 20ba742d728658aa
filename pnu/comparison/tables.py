"""The tables of the page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pnu import page
from pnu.evaluation import METRICS, Row, summarize
from pnu.evaluation.report import REFERENCES, counts

SURFACE_COLUMNS = {
    "to_truth_mean": ("mean", 1e3),
    "to_truth_rms": ("RMS", 1e3),
    "to_truth_max": ("max", 1e3),
    "from_truth_mean": ("mean back", 1e3),
    "from_truth_max": ("max back", 1e3),
    "normal_deg_mean": ("normal", 1.0),
}


def tables(rows: Sequence[Row], surface_rows: Sequence[Row]) -> dict[str, list[page.Table]]:
    """For each kind of input: the means of all metrics, the paper's Table 1 (CD and HD of each shape), the surfaces."""
    result = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of_kind = [row for row in rows if row["kind"] == kind]
        made = [row for row in surface_rows if row["kind"] == kind]
        shapes = list(dict.fromkeys(row["shape"] for row in of_kind))
        found = [means(of_kind, len(shapes)), table_1(of_kind, shapes)]
        result[kind] = found + ([surface_table(made)] if made else [])
    return result


def means(rows: Sequence[Row], shapes: int) -> page.Table:
    names = [name for name in METRICS if any(name in row for row in rows)]
    columns = [page.Column(METRICS[name].head, METRICS[name].digits) for name in names]
    body = [
        page.Row(summary["method"], [scaled(summary, name) for name in names], summary["method"] in REFERENCES)
        for summary in summarize(rows)
    ]
    return page.Table(f"Mean of {shapes} shapes, {counts(rows)}", columns, references_last(body))


def table_1(rows: Sequence[Row], shapes: Sequence[str]) -> page.Table:
    metrics = ("chamfer_sq", "hausdorff_sq")
    columns = [
        page.Column(shape, METRICS[name].digits, group=METRICS[name].head) for name in metrics for shape in shapes
    ]
    by_place = {(row["method"], row["shape"]): row for row in rows}
    body = [
        page.Row(
            method,
            [scaled(by_place.get((method, shape), {}), name) for name in metrics for shape in shapes],
            method in REFERENCES,
        )
        for method in dict.fromkeys(row["method"] for row in rows)
    ]
    return page.Table("Each shape, as Table 1 of the paper", columns, references_last(body))


def surface_table(rows: Sequence[Row]) -> page.Table:
    """Means over shapes; a method without a surface of some shape gets none."""
    shapes = {row["shape"] for row in rows}
    columns = [page.Column(head) for head, _ in SURFACE_COLUMNS.values()]
    body = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        values = [
            factor * float(np.mean([row[name] for row in own])) if len(own) == len(shapes) else None
            for name, (_, factor) in SURFACE_COLUMNS.items()
        ]
        body.append(page.Row(method, values, method in REFERENCES))
    caption = "Surfaces reconstructed from the clouds (Poisson), x 1e3 of the true radius; normals in degrees"
    return page.Table(caption, columns, references_last(body))


def scaled(row: Mapping[str, Any], name: str) -> float | None:
    return METRICS[name].factor * row[name] if name in row else None


def references_last(rows: Sequence[page.Row]) -> list[page.Row]:
    return sorted(rows, key=lambda row: row.reference)
