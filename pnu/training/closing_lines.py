"""What a training prints at its end."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from pnu.io import read_json
from pnu.training.pruning import objective_values
from pnu.training.run_folder import RunFolder

if TYPE_CHECKING:
    from pnu.metrics import Shown

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
    return list(objective_values(config["objective"], found).values())


def own_metrics(run: RunFolder) -> dict[str, Any]:
    """How the metrics of one's own that a run measured are shown, by name, as its record says."""
    found = run.read_record().get("metrics")
    return found if isinstance(found, dict) else {}


def shown_in(results: Iterable[Mapping[str, Any]], own: Mapping[str, Any]) -> list["Shown"]:
    """How to show the metrics that any of the results has, in the order of the tables: pnu's, then one's own."""
    from pnu.metrics import METRICS, Shown

    names = {name for result in results for name in result}
    known = {metric.shown.name: metric.shown for metric in METRICS}
    known |= {name: Shown.read(name, entry) for name, entry in own.items() if name not in known}
    return [shown for name, shown in known.items() if name in names]


def job_line(run: RunFolder) -> str:
    """The test metrics of one job of a sweep; of a pruned one, why it was."""
    if run.pruned:
        return f"job {run.facts['job']} pruned: {run}: {run.pruned}"
    test = read_json(run.metrics)["test"]
    parts = [f"{shown.title} {shown.text(test[shown.name])}" for shown in shown_in([test], own_metrics(run))]
    return f"job {run.facts['job']} finished: {run}: {', '.join(parts)}"


def closing_lines(run: RunFolder) -> str:
    """The metrics of a run as a table, its folder, and the command to go on with."""
    found = read_json(run.metrics)
    columns = [name for name in TITLES if name in found]
    rows = [["each patch in its unit sphere", *(TITLES[name] for name in columns)]]
    for shown in shown_in([found[column] for column in columns], own_metrics(run)):
        rows.append([shown.title, *(shown.text(found[column].get(shown.name)) for column in columns)])
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
    if not run.last.exists():
        kept = "no checkpoint was kept: trainer.fast_dev_run, or no callbacks.checkpoints"
        return "\n".join(["", *lines, "", f"run folder: {run}", kept])
    upsample = run.line("upsample", input="cloud.ply", output="dense.ply")
    if run.read_record().get("task") == "normals":
        upsample = run.line("evaluate", task="normals")
    return "\n".join(["", *lines, "", f"run folder: {run}", f"next: {upsample}"])
