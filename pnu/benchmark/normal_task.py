"""Normals as a task of its own: clouds of PCPNet's kinds, methods that give normals, their errors and time."""

import csv
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from pnu.benchmark.cases import generator
from pnu.benchmark.measuring import Row
from pnu.data.normal_patches import NORMAL_KINDS, draw_cloud
from pnu.geometry.jet_normals import jet_normals
from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.normal_estimation import estimate_normals, orient_normals
from pnu.io import Mesh
from pnu.metrics.normal_scores import normal_scores
from pnu.upsamplers.whole_clouds import normals

PUBLISHED_NORMALS = Path(__file__).with_name("published_normals.csv")
Estimator = Callable[[np.ndarray], np.ndarray]
"""points (n, 3) -> normals (n, 3), oriented as far as it can."""

COLUMNS = {
    "unoriented_rms_deg": ("RMS", 1.0, ".2f"), "unoriented_pgp5": ("PGP5", 100.0, ".1f"),
    "unoriented_pgp10": ("PGP10", 100.0, ".1f"), "oriented_rms_deg": ("RMS oriented", 1.0, ".2f"),
    "oriented_pgp5": ("PGP5 or.", 100.0, ".1f"), "oriented_pgp10": ("PGP10 or.", 100.0, ".1f"),
    "flipped": ("flipped %", 100.0, ".2f"), "seconds": ("s", 1.0, ".2f"),
}  # fmt: skip


def estimators(neighbors: int = 24) -> dict[str, Estimator]:
    """PCA and jets, both oriented as pnu orients; plane fits within each sheet; `pnu.normals`, learned, from there."""

    def oriented(lines: Estimator) -> Estimator:
        return lambda points: orient_normals(points, lines(points))

    return {
        "pca": oriented(lambda points: estimate_normals(points, neighbors, orient=False)),
        "jets": oriented(lambda points: jet_normals(torch.from_numpy(points)[None], neighbors)[0].numpy()),
        "planes": estimate_normals,
        "pnu": normals,
    }


def network_estimator(network: nn.Module, name: str, at_once: int = 512) -> Estimator:
    """A network of neighborhoods, such as PCPNet; what it gives without signs is oriented as pnu orients.

    ValueError for a network of another task.
    """
    if getattr(network, "task", "upsampling") != "normals":
        raise ValueError(f"run={name}: is no network of normals, which task=normals trains")
    found: Any = network
    k = found.neighbors[-1]

    def estimate(points: np.ndarray) -> np.ndarray:
        if len(points) < k:
            raise ValueError(f"points={len(points)}: {name} sees {k} neighbors, give as many points")
        near = kd_tree(points).query(points, k=k)[1]
        with torch.no_grad():
            rows = [
                found(torch.from_numpy(points[idx] - points[idx[:, :1]]).float()[None])[0, :, 3:].double()
                for idx in np.array_split(near, -(-len(near) // at_once))
            ]
        lines: np.ndarray = torch.nn.functional.normalize(torch.cat(rows), dim=1).numpy()
        return lines if found.oriented else orient_normals(points, lines)

    return estimate


class NormalCase(NamedTuple):
    """A cloud, and the true normals of its points."""

    shape: str
    kind: str
    points: np.ndarray  # (n, 3)
    normals: np.ndarray  # (n, 3)


def normal_cases(
    meshes: Mapping[str, Callable[[], Mesh]], kinds: Sequence[str], *, points: int, seed: int = 0
) -> Iterator[NormalCase]:
    """Clouds of all kinds from each mesh, drawn by (seed, shape, kind) alone. ValueError for a kind that is none."""
    if unknown := [kind for kind in kinds if kind not in NORMAL_KINDS]:
        raise ValueError(f"kinds={unknown[0]}: expected some of {', '.join(NORMAL_KINDS)}")
    for shape, make in meshes.items():
        mesh = make()
        for kind in kinds:
            cloud = draw_cloud(mesh, kind, points, generator(seed, shape, f"normals {kind}"))
            yield NormalCase(shape, kind, cloud[:, :3], cloud[:, 3:])


def evaluate_normals(
    methods: Mapping[str, Estimator], cases: Iterable[NormalCase], step: Callable[[str], None] = lambda text: None
) -> Iterator[Row]:
    """A row of errors and seconds for each case and method."""
    for case in cases:
        for name, estimate in methods.items():
            step(f"{case.shape}, {case.kind}: {name}")
            started = time.perf_counter()
            found = estimate(case.points)
            seconds = time.perf_counter() - started
            head = {"shape": case.shape, "kind": case.kind, "method": name, "points": len(case.points)}
            yield head | normal_scores(found, case.normals) | {"seconds": seconds}


def mean_rows(rows: Sequence[Row]) -> list[Row]:
    """Means over shapes for each kind and method, and for each method over the kinds' means ("all")."""
    kinds, methods = (list(dict.fromkeys(row[name] for row in rows)) for name in ("kind", "method"))
    found = [
        {"kind": kind, "method": method}
        | {
            name: float(np.mean([r[name] for r in rows if (r["kind"], r["method"]) == (kind, method)]))
            for name in COLUMNS
        }
        for kind in kinds
        for method in methods
    ]
    for method in methods if len(kinds) > 1 else ():
        own = [row for row in found if row["method"] == method]
        found.append(
            {"kind": "all", "method": method} | {name: float(np.mean([row[name] for row in own])) for name in COLUMNS}
        )
    return found


def print_normal_tables(rows: Sequence[Row]) -> None:
    """Means over shapes for each kind, then the published rows in a table of their own."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=max(Console().width, 118), highlight=False)
    shapes = len({row["shape"] for row in rows})
    table = Table(title=f"Normals, means of {shapes} shapes", title_justify="left", title_style="bold")
    for head in ("kind", "method"):
        table.add_column(head)
    for head, _, _ in COLUMNS.values():
        table.add_column(head, justify="right")
    last = ""
    for row in mean_rows(rows):
        cells = [format(factor * row[name], form) for name, (_, factor, form) in COLUMNS.items()]
        if last not in ("", row["kind"]):
            table.add_section()
        last = row["kind"]
        table.add_row(row["kind"], row["method"], *cells)
    console.print(table)
    console.print("RMS: root mean square of the angles in degrees. PGP5, PGP10: % of points below 5 and 10 degrees.")
    published = Table(title="Published on PCPNet's shapes, not measured here", title_justify="left")
    for head in ("method", "signs", "RMS", "source"):
        published.add_column(head)
    for found in published_normals():
        published.add_row(found["method"], found["signs"], found["rms_deg"], found["source"])
    console.print(published)


def published_normals() -> list[dict[str, str]]:
    """The rows of published_normals.csv."""
    with PUBLISHED_NORMALS.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert all(math.isfinite(float(row["rms_deg"])) for row in rows)
    return rows
