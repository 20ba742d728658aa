"""All measurements of speed in one table: `python -m bench [ops] [loss] [step] [inference] [scale] [--threads 2] ...`.

The table, and the machine it was made on, go to outputs/bench/ as Markdown and JSON. Every figure is a ratio of medians
of runs taken in turn (`bench.timing`).
"""

import argparse
import os
import platform
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path

import torch

from bench import compiled, inference, ops, scale, step
from bench.timing import Row
from pnu.io import atomic_path, write_json
from pnu.runtime.provenance import provenance

PARTS: dict[str, Callable[[], Iterable[Row]]] = {
    "ops": ops.rows,
    "loss": step.loss_rows,
    "step": step.step_rows,
    "compiled": compiled.rows,
    "inference": inference.rows,
}
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


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"of {' '.join([*PARTS, 'scale'])}; default: all")
    parser.add_argument("--threads", type=int, default=2, help="of torch (default: 2)")
    parser.add_argument("--points", type=int, nargs="+", default=scale.SHORT, help="sizes of the scale curve")
    parser.add_argument("--models", nargs="+", default=["surface"], help="of the scale curve: surface pnu ...")
    parser.add_argument("--keep", action="store_true", help="the last dense cloud of the curve, as ply in the folder")
    parser.add_argument("--folder", type=Path, default=Path("outputs/bench"), help="for table and plot")
    arguments = parser.parse_args()
    unknown = set(arguments.parts) - {*PARTS, "scale"}
    if unknown:
        parser.error(f"no such part: {' '.join(sorted(unknown))}; expected {' '.join([*PARTS, 'scale'])}")
    wanted = arguments.parts or [*PARTS, "scale"]
    torch.set_num_threads(arguments.threads)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    started, known = time.perf_counter(), facts()
    rows: list[Row] = []
    notes: list[str] = []
    for name, measure in PARTS.items():
        if name in wanted:
            for row in measure():
                rows.append(row)
                print(row, flush=True)
    profile = step.profile() if "step" in wanted else None
    if profile:
        notes += ["", *profile.lines()]
    keep = arguments.folder if arguments.keep else None
    curve = scale.curve(arguments.points, arguments.threads, arguments.models, keep) if "scale" in wanted else []
    if curve:
        notes += ["", *scale.lines(curve)]
        scale.plot(curve, arguments.folder / "scale.png")
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


if __name__ == "__main__":
    main()
