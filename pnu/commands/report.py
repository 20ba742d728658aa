"""What the runs of a sweep say: `pnu report sweep=outputs/sweeps/<name>`."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands._entry import command
from pnu.config.schema import doc

SWEEPS = Path("outputs/sweeps")


@dataclass
class Report:
    """Compare the settings of a sweep over their seeds: Markdown, CSV and one HTML page."""

    files: ClassVar = ("sweep",)
    sweep: str | None = doc("folder of the sweep; null: the newest below outputs/sweeps")
    baseline: str | None = doc("name of the setting to compare with; null: that of the first job; a search has none")
    output: str | None = doc("folder of the report; null: <sweep>/report")
    quiet: bool = doc("print the page's path alone")


def report(cfg: Any) -> None:
    """Write the report of a sweep and tell where it is."""
    from pnu.report.sweep_report import status, write_report
    from pnu.report.sweep_results import collect

    folder = Path(cfg.sweep) if cfg.sweep else newest()
    found = collect(folder, cfg.baseline)
    paths = write_report(found, Path(cfg.output or folder / "report"))
    page = next(path for path in paths if path.suffix == ".html")
    if cfg.quiet:
        print(page)
        return
    pruned = f"{len(found.pruned)} pruned, " if found.pruned else ""
    runs = sum(len(setting.runs) for setting in found.settings)
    print(f"{len(found.settings)} settings, {runs} finished runs, {pruned}{len(found.unfinished)} unfinished")
    for run in found.unfinished:
        print(f"  {run.folder}: {status(run)}")
    print(f"report folder: {page.parent}")
    print(f"next: open {page} in a browser; its curves: tensorboard --logdir {shlex.quote(str(folder))}")


def newest() -> Path:
    """The sweep below outputs/sweeps whose run began or ended last."""
    records = sorted(SWEEPS.glob("*/*/run.json"), key=lambda path: path.stat().st_mtime)
    if not records:
        raise ValueError(f"sweep=FOLDER is required: there is no sweep with runs below {SWEEPS}")
    return records[-1].parent.parent


main = command(report, Report)

if __name__ == "__main__":
    main()
