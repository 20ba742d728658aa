"""The runs of a sweep, grouped by what differs between their configs; seeds are repetitions."""

import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from pnu.config.compose import flatten
from pnu.config.quoting import shell_line
from pnu.io import read_json
from pnu.training.closing_lines import own_metrics, shown_in
from pnu.training.run_folder import UNHASHED, UNHASHED_DATA, RunFolder
from pnu.training.sweeps import runs

if TYPE_CHECKING:
    from pnu.metrics import Shown

REPEATED = ("seed", "data.seed")  # what may differ between the runs of one setting


class Run(NamedTuple):
    """One run folder; `metrics` are those of the test, empty unless it finished, `validation` those of the best one."""

    folder: RunFolder
    record: Mapping[str, Any]
    config: Mapping[str, Any]  # dotted keys
    metrics: Mapping[str, float]
    validation: Mapping[str, float]

    @property
    def seed(self) -> Any:
        """Of its config."""
        return self.config.get("seed")


class Summary(NamedTuple):
    """A metric of one setting over its seeds.

    mean: of the runs. spread: their standard deviation, None for one run. difference: of the mean to the baseline's,
    None for the baseline. exceeds: whether |difference| is greater than the spread of a difference between two runs,
    sqrt(spread^2 + baseline's spread^2); None where a spread is unknown.
    """

    mean: float
    spread: float | None
    difference: float | None = None
    exceeds: bool | None = None


class Setting(NamedTuple):
    """Runs that differ in their seed alone. `values` are those of the keys in which the settings differ."""

    name: str
    values: Mapping[str, Any]
    runs: Sequence[Run]

    def of(self, metric: str) -> list[float]:
        """A metric's values, one for each run that has it."""
        return [run.metrics[metric] for run in self.runs if metric in run.metrics]

    def mean(self, metric: str) -> float:
        """NaN where no run has the metric."""
        found = self.of(metric)
        return statistics.fmean(found) if found else math.nan


class Study(NamedTuple):
    """All settings in the order of their jobs, the baseline first; the runs that have not finished, and those that
    were pruned.

    search: whether the settings are trials of a search, of which none is the one to compare with.
    """

    folder: Path
    settings: Sequence[Setting]
    unfinished: Sequence[Run]
    search: bool = False
    pruned: Sequence[Run] = ()

    @property
    def baseline(self) -> Setting | None:
        """The setting that others are compared with; None in a search."""
        return None if self.search else self.settings[0]

    @property
    def described(self) -> dict[str, Any]:
        """How the metrics of one's own are shown, as the runs' records say."""
        return {name: entry for s in self.settings for run in s.runs for name, entry in own_metrics(run.folder).items()}

    @property
    def metrics(self) -> list[str]:
        """Names of the metrics that any setting has, in the order of the tables."""
        results = [run.metrics for setting in self.settings for run in setting.runs]
        return [shown.name for shown in shown_in(results, self.described)]

    def shown(self, metric: str) -> "Shown":
        """How a metric of these runs is shown."""
        return shown_in([{metric: 0.0}], self.described)[0]

    def summary(self, setting: Setting, metric: str) -> Summary | None:
        """None where the setting has no such metric."""
        values, base = setting.of(metric), self.baseline.of(metric) if self.baseline else []
        if not values:
            return None
        spread = statistics.stdev(values) if len(values) > 1 else None
        if setting is self.baseline or not base:
            return Summary(statistics.fmean(values), spread)
        difference = statistics.fmean(values) - statistics.fmean(base)
        if spread is None or len(base) < 2:
            return Summary(statistics.fmean(values), spread, difference)
        exceeds = abs(difference) > math.hypot(spread, statistics.stdev(base))
        return Summary(statistics.fmean(values), spread, difference, exceeds)


def collect(folder: str | Path, baseline: str | None = None) -> Study:
    """Read all runs below a sweep's folder.

    Args:
        baseline: name of the setting to compare with; None: that of the first job, or for a search none.

    Raises:
        ValueError: no finished run there, or no setting of that name.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(
            f"sweep={folder}: no such folder; expected one that a sweep made ({shell_line('train', '-m')} ...)"
        )
    found = [read_run(run) for run in runs(folder)]
    finished = [run for run in found if run.metrics]
    if not finished:
        raise ValueError(f"sweep={folder}: expected finished runs below it, found {len(found)} runs, none finished")
    settings = grouped(finished)
    if baseline is not None:
        chosen = [setting for setting in settings if setting.name == baseline]
        if not chosen:
            names = ", ".join(setting.name for setting in settings)
            raise ValueError(f"baseline={baseline}: expected one of {names}")
        settings = chosen + [setting for setting in settings if setting is not chosen[0]]
    search = baseline is None and any(run.config.get("objective") for run in finished)
    pruned = [run for run in found if run.record.get("status") == "pruned"]
    return Study(folder, settings, [run for run in found if not run.metrics and run not in pruned], search, pruned)


def read_run(folder: RunFolder) -> Run:
    """A run of a sweep, from its folder."""
    record = folder.read_record()
    config = yaml.safe_load(folder.config.read_text("utf-8")) if folder.config.exists() else {}
    flat = {key: value for key, value in flatten(config).items() if not isinstance(value, Mapping)}
    metrics = read_json(folder.metrics) if folder.metrics.exists() else {}
    test = metrics.get("test", {}) if record.get("status") == "finished" else {}
    return Run(folder, record, flat, test, metrics.get("validation", {}))


def grouped(found: Sequence[Run]) -> list[Setting]:
    """Runs that differ in their seed alone, together."""
    ignored = {*UNHASHED, *REPEATED, *(f"data.{name}" for name in UNHASHED_DATA)}
    keys = {key: None for run in found for key in run.config}
    kept = [key for key in keys if key not in ignored and key.partition(".")[0] not in UNHASHED]
    differ = [key for key in kept if len({repr(run.config.get(key)) for run in found}) > 1]
    groups: dict[str, list[Run]] = {}
    for run in found:
        groups.setdefault(repr([run.config.get(key) for key in differ]), []).append(run)
    settings = []
    for members in groups.values():
        values = {key: members[0].config[key] for key in differ if key in members[0].config}
        settings.append(Setting(given_name(members[0]), values, sorted(members, key=lambda run: str(run.seed))))
    names = [setting.name for setting in settings]
    return [s if s.name and names.count(s.name) == 1 else s._replace(name=long_name(s)) for s in settings]


def given_name(run: Run) -> str:
    """The name of a run's setting, where one was chosen."""
    return str(run.record.get("setting") or "").rpartition("/")[2]


def long_name(setting: Setting) -> str:
    """A name of what differs, for settings that have none of their own."""
    described = ", ".join(f"{key}={short(value)}" for key, value in setting.values.items())
    return ": ".join(filter(None, [setting.name, described])) or "all runs"


def short(value: Any) -> str:
    """A value in few letters."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def effects(study: Study) -> dict[str, list[tuple[float, Setting]]]:
    """For each key with numbers: the settings that differ from the baseline in it alone, by its value; the baseline
    among them. Where no two settings differ in one key alone (a search), all settings by every key."""
    base = study.settings[0].values
    keys = [key for key in base if all(number(setting.values.get(key)) for setting in study.settings)]
    alone = {}
    for key in [] if study.search else keys:
        same = [s for s in study.settings if all(s.values.get(k) == v for k, v in base.items() if k != key)]
        if len(same) > 2 or len(same) == len(study.settings) > 1:
            alone[key] = by_value(key, same)
    searched = [key for key in keys if len({setting.values[key] for setting in study.settings}) > 4]
    return alone or {key: by_value(key, study.settings) for key in searched}


def by_value(key: str, settings: Sequence[Setting]) -> list[tuple[float, Setting]]:
    """Settings in the order of a number that they vary."""
    return sorted(((float(setting.values[key]), setting) for setting in settings), key=lambda pair: pair[0])


def number(value: Any) -> bool:
    """A value as a number, or None."""
    return isinstance(value, int | float) and not isinstance(value, bool)
