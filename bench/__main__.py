"""All measurements of speed in one table, or those of some parts: `python -m bench [step] [--threads 2] ...`.

The table, and the machine it was made on, go to outputs/bench/ as Markdown and JSON. Every figure is a ratio of medians
of runs taken in turn (`bench.timing`). Where ours takes more than 10 % longer beside an alternative than the committed
table says, twice in a row, that is said and the exit code is 1; `--commit` measures twice and writes the lower ratios.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from bench import compiled, inference, ops, scale, step
from bench.timing import LIMIT, Row, entries, slower
from pnu.io import atomic_path, write_json
from pnu.runtime.provenance import provenance

PARTS: dict[str, Callable[[], Iterable[Row]]] = {
    "ops": ops.rows,
    "loss": step.loss_rows,
    "step": step.step_rows,
    "precision": step.precision_rows,
    "compiled": compiled.rows,
    "inference": inference.rows,
}
COMMITTED = Path(__file__).with_name("committed.json")
PACKAGES = ("torch", "numpy", "scipy", "numba", "open3d")


def facts() -> dict[str, str]:
    """What the figures depend on."""
    return {
        "made": provenance([1]),
        "cores": str(os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": ", ".join(f"{name} {version(name)}" for name in PACKAGES),
    }


def markdown(facts: dict[str, str], rows: list[Row], notes: list[str]) -> str:
    """Table of ratios, one line an alternative."""
    lines = ["| operation | pnu, s | alternative | its time / ours |", "|---|---|---|---|"]
    for row in rows:
        ours, *_ = row.seconds
        for other, ratio in row.ratios.items():
            lines.append(f"| {row.name} | {row.seconds[ours]:.3g} | {other} | {ratio:.1f} |")
    text = ["; ".join(f"{key}: {value}" for key, value in facts.items()), ""]
    return "\n".join([*text, *(lines if rows else []), *notes]) + "\n"


def measured(measure: Callable[[], Iterable[Row]], committed: dict[str, Any]) -> tuple[list[Row], list[str]]:
    """Rows of a part, and a line for each ratio that is worse than committed.

    It has to be so twice: other work on the machine can slow down one measurement.
    """
    rows = told(measure())
    worse = slower(rows, committed)
    if worse:
        print("slower than committed: once more", flush=True)
        rows = told(measure())
        worse = {key: factor for key, factor in slower(rows, committed).items() if key in worse}
    return rows, [
        f"- {name}: {factor:.2f} times as long as committed ({committed[name]['made']})"
        for name, factor in worse.items()
    ]


def told(rows: Iterable[Row]) -> list[Row]:
    """The rows, each printed as soon as it is there."""
    found = []
    for row in rows:
        print(row, flush=True)
        found.append(row)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"of {' '.join([*PARTS, 'scale'])}; default: all")
    parser.add_argument("--threads", type=int, default=2, help="of torch (default: 2)")
    parser.add_argument("--points", type=int, nargs="+", default=scale.SHORT, help="sizes of the scale curve")
    parser.add_argument("--models", nargs="+", default=["surface"], help="of the scale curve: surface pnu ...")
    parser.add_argument("--keep", action="store_true", help="the last dense cloud of the curve, as ply in the folder")
    parser.add_argument("--folder", type=Path, default=Path("outputs/bench"), help="for table and plot")
    parser.add_argument(
        "--commit", action="store_true", help=f"write the ratios, the lower of two, to bench/{COMMITTED.name}"
    )
    arguments = parser.parse_args()
    unknown = set(arguments.parts) - {*PARTS, "scale"}
    if unknown:
        parser.error(f"no such part: {' '.join(sorted(unknown))}; expected {' '.join([*PARTS, 'scale'])}")
    wanted = arguments.parts or [*PARTS, "scale"]
    torch.set_num_threads(arguments.threads)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    started, known = time.perf_counter(), facts()
    committed = json.loads(COMMITTED.read_text(encoding="utf-8")) if COMMITTED.exists() else {}
    rows: list[Row] = []
    notes: list[str] = []
    worse: list[str] = []
    again: list[Row] = []
    for name, measure in PARTS.items():
        if name in wanted:
            found, lines = measured(measure, {} if arguments.commit else committed)
            rows += found
            worse += lines
            again += told(measure()) if arguments.commit else []
    profile = step.profile() if "step" in wanted else None
    if profile:
        notes += ["", *profile.lines()]
    keep = arguments.folder if arguments.keep else None
    curve = scale.curve(arguments.points, arguments.threads, arguments.models, keep) if "scale" in wanted else []
    if curve:
        notes += ["", *scale.lines(curve)]
        scale.plot(curve, arguments.folder / "scale.png")
    if worse:
        notes += ["", f"Slower than committed by more than {LIMIT - 1:.0%}:", "", *worse]
    if arguments.commit:
        write_json(COMMITTED, (committed if arguments.parts else {}) | entries([*rows, *again], known["made"]))
    table = markdown(known, rows, notes)
    stem = "bench" if not arguments.parts else "_".join(wanted)
    with atomic_path(arguments.folder / f"{stem}.md") as path:
        path.write_text(table, encoding="utf-8")
    content = {
        "machine": known,
        "rows": [{"name": row.name, "seconds": row.seconds, "ratios": row.ratios} for row in rows],
        "step": profile._asdict() if profile else None,
        "scale": [point._asdict() for point in curve],
    }
    write_json(arguments.folder / f"{stem}.json", content)
    print(f"\n{table}\n{arguments.folder / stem}.md and .json, {time.perf_counter() - started:.0f} s")
    if worse:
        sys.exit(1)


if __name__ == "__main__":
    main()
