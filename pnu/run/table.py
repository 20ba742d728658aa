"""What a training prints at its end."""

from collections.abc import Mapping
from typing import Any

from pnu.io import read_json
from pnu.run.folder import RunFolder
from pnu.run.quoting import shell_line

# metric -> how a table shows it: name, factor, format
SHOWN = {
    "chamfer_sq": ("CD x 1e3", 1e3, ".3f"),
    "hausdorff_sq": ("HD (squared) x 1e3", 1e3, ".2f"),
    "spacing_cv": ("spacing, variation", 1.0, ".3f"),
    "normal_deg": ("normal error, signed (deg)", 1.0, ".1f"),
    "normal_unsigned_deg": ("normal error, unsigned (deg)", 1.0, ".1f"),
    "flipped": ("normals flipped (%)", 100.0, ".1f"),
}
# section of metrics.json -> its column; "start": of a run that began from given weights
TITLES = {"untrained": "untrained", "start": "start", "validation": "best validation", "test": "test"}


def objective(config: Mapping[str, Any], run: RunFolder) -> list[float] | None:
    """The best validation's values of the metrics that `config["objective"]` names.

    Raises:
        ValueError: there is no such metric.
    """
    if not config["objective"]:
        return None
    found = read_json(run.metrics).get("validation")
    if found is None:
        raise ValueError("objective: no validation during the training; lower trainer.val_check_interval")
    missing = set(config["objective"]) - set(found)
    if missing:
        raise ValueError(f"objective={sorted(missing)}: expected some of {', '.join(sorted(set(found) - {'step'}))}")
    return [found[name] for name in config["objective"]]


def job_line(run: RunFolder) -> str:
    """The test metrics of one job of a sweep."""
    test = read_json(run.metrics)["test"]
    parts = [f"{title} {factor * test[name]:{form}}" for name, (title, factor, form) in SHOWN.items() if name in test]
    return f"job {run.facts['job']} finished: {run}: {', '.join(parts)}"


def closing(run: RunFolder) -> str:
    """The metrics of a run as a table, its folder, and the command to go on with."""
    found = read_json(run.metrics)
    columns = [name for name in TITLES if name in found]
    rows = [["each patch in its unit sphere", *(TITLES[name] for name in columns)]]
    for metric, (title, factor, form) in SHOWN.items():
        values = [found[column].get(metric) for column in columns]
        if any(value is not None for value in values):
            rows.append([title, *("-" if value is None else format(factor * value, form) for value in values)])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
    lines.insert(1, "-" * len(lines[0]))
    if "test" in columns and len(columns) > 1:
        others = " and ".join(TITLES[name] for name in columns if name != "test")
        chosen = ", with the network of the best validation" * ("validation" in columns)
        lines.append(f"{others}: on the validation's shapes; test: on other shapes{chosen}")
    upsample = shell_line("upsample", input="cloud.ply", output="dense.ply", run=run)
    return "\n".join(["", *lines, "", f"run folder: {run}", f"next: {upsample}"])
