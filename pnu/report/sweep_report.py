"""A report's files: Markdown, CSV and one HTML page that needs nothing else."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pnu import rendering
from pnu.config.quoting import retyped
from pnu.io import atomic_path
from pnu.report import offline_page
from pnu.report.cloud_sheets import sheets
from pnu.report.plots import Plot, plots
from pnu.report.search_front import front_table, search_plots
from pnu.report.sweep_results import Run, Setting, Study, short
from pnu.runtime.provenance import provenance
from pnu.training.sweeps import runs_elsewhere, state

READING = "Mean and standard deviation over seeds of the test's metrics, each patch in its unit sphere."
COMPARED = (
    " In brackets the difference to the baseline; in bold where it is greater than the spread, the standard deviation"
    " of the difference of two runs. With few seeds that is a hint, not a proof."
)


def write_report(study: Study, folder: Path) -> list[Path]:
    """Write report.md, report.html, summary.csv, runs.csv and the figures, each atomically; their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = search_plots(study) | plots(study)
    pictures = {shape: rendering.webp(picture, quality=80) for shape, picture in sheets(study).items()}
    contents: dict[str, bytes] = {
        "report.md": markdown(study, drawn, list(pictures)).encode(),
        "report.html": page_html(study, drawn, pictures).encode(),
        "summary.csv": table_csv(summary_rows(study)).encode(),
        "runs.csv": table_csv(run_rows(study)).encode(),
        **{f"{name}.svg": plot.svg.encode() for name, plot in drawn.items()},
        **{f"{name}.png": plot.png for name, plot in drawn.items()},
        **{f"cloud_{shape}.webp": picture for shape, picture in pictures.items()},
    }
    for name, content in contents.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_bytes(content)
    return [folder / name for name in contents]


def facts(study: Study) -> list[str]:
    """What the reader must know of the runs."""
    finished = [run for setting in study.settings for run in setting.runs]
    hours = sum(float(run.record.get("wall_s", 0)) for run in finished) / 3600
    counts = sorted({len(setting.runs) for setting in study.settings})
    known = {key: [str(run.record[key]) for run in finished if run.record.get(key)] for key in ("git", "machine")}
    seeds = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    kind = "trials of a search" if study.search else "settings"
    lines = [f"{len(study.settings)} {kind}, {seeds} seeds each, {len(finished)} finished runs, {hours:.2f} hours."]
    if study.baseline:
        lines.append(f"Baseline: {study.baseline.name}.")
    lines.append(provenance(counts, known["git"], known["machine"]))
    if study.pruned:
        lines.append(f"{len(study.pruned)} runs were pruned, see the end.")
    if study.unfinished:
        lines.append(f"{len(study.unfinished)} runs have not finished, see the end.")
    return lines


def command_of(study: Study) -> str:
    """The command line that started the sweep."""
    return retyped(str(study.settings[0].runs[0].record.get("command", "")))


def cell(study: Study, setting: Setting, metric: str) -> tuple[str, str, bool]:
    """Mean and spread, difference, as one reads them, and whether the difference exceeds the spread."""
    summary = study.summary(setting, metric)
    if summary is None:
        return "-", "", False
    shown = study.shown(metric)
    mean = shown.text(summary.mean) + ("" if summary.spread is None else f" ± {shown.text(summary.spread)}")
    difference = "" if summary.difference is None else f"({shown.text(summary.difference, '+')})"
    return mean, difference, bool(summary.exceeds)


def reading(study: Study) -> str:
    """How the tables are to be read."""
    return READING + COMPARED * (not study.search)


def differing(setting: Setting, baseline: Setting | None) -> str:
    """The keys in which a setting differs from the baseline; of a group with another class, the class alone. Without
    baseline, all keys in which any setting differs."""
    if baseline is None:
        return ", ".join(f"{key}={short(value)}" for key, value in setting.values.items())
    keys = dict.fromkeys([*setting.values, *baseline.values])
    found = {key: setting.values.get(key, "-") for key in keys if setting.values.get(key) != baseline.values.get(key)}
    replaced = tuple(key.removesuffix("_target_") for key in found if key.endswith("._target_"))
    found = {key: value for key, value in found.items() if key.endswith("._target_") or not key.startswith(replaced)}
    return ", ".join(f"{key}={short(value)}" for key, value in found.items())


def prunings(study: Study) -> list[str]:
    """A line for each run that was pruned, with the reason."""
    return [f"{run.folder.path.name}: {run.record.get('pruned', '')}" for run in study.pruned]


def failures(study: Study) -> list[str]:
    """A line for each run that did not finish."""
    return [f"{run.folder.path.name}: {status(run)}" for run in study.unfinished]


def status(run: Run) -> str:
    """How far a run came."""
    found = state(run.folder)
    if found == "running" and not runs_elsewhere(run.folder):  # on another machine, as far as its file system tells
        return "running, or ended without a word (kill, power cut); the same command goes on with it"
    return found + {"interrupted": "; the same command goes on with it", "running": ""}.get(
        found, f": {run.record.get('error', '')}"
    )


def markdown(study: Study, drawn: Mapping[str, Plot], shapes: Sequence[str]) -> str:
    """The report as Markdown."""
    metrics = study.metrics
    lines = [f"# {study.folder.name}", "", *facts(study), ""]
    if command := command_of(study):
        lines += ["```", command, "```", ""]
    lines += [
        reading(study),
        "",
        f"| | setting | {' | '.join(study.shown(metric).title for metric in metrics)} | differs in |",
    ]
    lines.append("|---|---|" + "---:|" * len(metrics) + "---|")
    for i, setting in enumerate(study.settings):
        found = (cell(study, setting, metric) for metric in metrics)
        cells = [f"**{text}**" if beyond else text for text, beyond in ((f"{m} {d}".strip(), b) for m, d, b in found)]
        differs = "baseline" if setting is study.baseline else differing(setting, study.baseline)
        lines.append(f"| {i} | {setting.name} | {' | '.join(cells)} | {differs} |")
    if found_best := front_table(study):
        lines += ["", "## Best validation of the trials that no other beats, and of several seeds", "", *found_best]
    for name, plot in drawn.items():
        lines += ["", f"## {plot.caption}", "", f"![{plot.caption}]({name}.svg)"]
    if shapes:
        lines += ["", "## The same validation clouds for each setting: input, prediction, target; colors are normals"]
    for shape in shapes:
        lines += ["", f"![{shape}](cloud_{shape}.webp)"]
    if study.pruned:
        lines += ["", "## Runs that were pruned", "", *(f"- {text}" for text in prunings(study))]
    if study.unfinished:
        lines += ["", "## Runs that have not finished", "", *(f"- {text}" for text in failures(study))]
    return "\n".join(lines) + "\n"


def page_html(study: Study, drawn: Mapping[str, Plot], pictures: Mapping[str, bytes]) -> str:
    """The report as one page."""
    return offline_page.render(
        "report.html",
        title=study.folder.name,
        head=facts(study),
        command=command_of(study),
        reading=reading(study),
        settings=settings_table(study),
        plots=list(drawn.values()),
        pictures={shape: offline_page.data_url(picture) for shape, picture in pictures.items()},
        prunings=prunings(study),
        failures=failures(study),
    )


def settings_table(study: Study) -> offline_page.Set:
    """Sorted by a click on a head: numbers by their means."""
    rows = []
    for i, setting in enumerate(study.settings):
        cells = []
        for metric in study.metrics:
            mean, difference, beyond = cell(study, setting, metric)
            key = offline_page.sort_key(setting.mean(metric)) if setting.of(metric) else ""
            cells.append(offline_page.Cell(mean, key, "beyond" if beyond else "", difference))
        hint = "baseline" if setting is study.baseline else differing(setting, study.baseline)
        rows.append(offline_page.Line(f"{i} {setting.name}", cells, setting is study.baseline, str(i), hint))
    return offline_page.Set("", "setting", [study.shown(metric).title for metric in study.metrics], rows)


def summary_rows(study: Study) -> list[dict[str, Any]]:
    """A row for each setting and metric."""
    rows = []
    for setting in study.settings:
        for metric in study.metrics:
            summary = study.summary(setting, metric)
            if summary is not None:
                known = {"setting": setting.name, "metric": metric, "runs": len(setting.of(metric))}
                rows.append(known | summary._asdict() | {"differs": differing(setting, study.baseline)})
    return rows


def run_rows(study: Study) -> list[dict[str, Any]]:
    """A row for each run, those that were pruned or have not finished too."""
    named = [(setting.name, run) for setting in study.settings for run in setting.runs]
    rows = []
    for name, run in [*named, *(("", run) for run in [*study.pruned, *study.unfinished])]:
        row = {"setting": name, "seed": run.seed, "status": run.record.get("status"), "run": run.folder.path.name}
        row |= {metric: run.metrics.get(metric) for metric in study.metrics}
        rows.append(
            row | {"wall_s": run.record.get("wall_s"), "error": run.record.get("error") or run.record.get("pruned")}
        )
    return rows


def table_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Numbers in full, nothing for None."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()
