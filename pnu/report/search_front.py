"""What a search for two objectives has found: the best validation of each trial, those that no other beats, and what
ran with several seeds beside them."""

import statistics
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from pnu.report.plots import Panel, Plot, axis_values, color, front, logarithmic, plot
from pnu.report.sweep_results import Run, Study, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CAPTION = (
    "The best validation of each trial: no other is better in both than those on the line; a cross is the mean and"
    " standard deviation of what ran with several seeds"
)
Place = tuple[float, float]


class Trial(NamedTuple):
    """A setting of a search, or a pruned run, which has no number in the report's table.

    places: both objectives of the best validation of each run.
    """

    number: int | None
    differs: str
    places: Sequence[Place]

    @property
    def mean(self) -> Place:
        """Over its runs."""
        return statistics.fmean(x for x, _ in self.places), statistics.fmean(y for _, y in self.places)

    @property
    def spread(self) -> Place:
        """Standard deviations over its runs; zeros for one."""
        if len(self.places) < 2:
            return 0.0, 0.0
        return statistics.stdev(x for x, _ in self.places), statistics.stdev(y for _, y in self.places)


def objectives(study: Study) -> list[str]:
    """The two metrics that a search makes small; nothing where there is no search, or not two."""
    names = study.settings[0].runs[0].config.get("objective") or []
    return list(names) if study.search and len(names) == 2 else []


def trials(study: Study) -> list[Trial]:
    """Those that have validated, by number, then the pruned ones."""
    names = objectives(study)
    if not names:
        return []

    def places(runs: Sequence[Run]) -> list[Place]:
        known = [run.validation for run in runs if all(run.validation.get(name) is not None for name in names)]
        return [(values[names[0]], values[names[1]]) for values in known]

    keys = list(study.settings[0].values)
    found = [
        Trial(number, ", ".join(f"{key}={short(value)}" for key, value in setting.values.items()), places(setting.runs))
        for number, setting in enumerate(study.settings)
    ]
    found += [
        Trial(None, ", ".join(f"{key}={short(run.config.get(key))}" for key in keys), places([run]))
        for run in study.pruned
    ]
    return [trial for trial in found if trial.places]


def repeated(found: Sequence[Trial]) -> list[Trial]:
    """What ran with more seeds than the trials of the search did."""
    fewest = min((len(trial.places) for trial in found), default=0)
    return [trial for trial in found if len(trial.places) > fewest]


def unbeaten(found: Sequence[Trial]) -> list[Trial]:
    """The trials than which no other is better in both, by the first objective; what ran with more seeds is none."""
    beside = repeated(found)
    single = {trial.mean: trial for trial in found if trial not in beside}
    return [single[place] for place in front(list(single))]


def front_table(study: Study) -> list[str]:
    """Lines of a Markdown table of those that no other beats, and of what ran with several seeds."""
    found = trials(study)
    if not found:
        return []
    shown = [study.shown(name) for name in objectives(study)]
    lines = [f"| | {' | '.join(one.title for one in shown)} | seeds | differs in |", "|---|---:|---:|---:|---|"]
    for trial in [*unbeaten(found), *repeated(found)]:
        cells = [one.text(value) for one, value in zip(shown, trial.mean, strict=True)]
        if len(trial.places) > 1:
            spreads = (one.text(value) for one, value in zip(shown, trial.spread, strict=True))
            cells = [f"{mean} ± {spread}" for mean, spread in zip(cells, spreads, strict=True)]
        number = "pruned" if trial.number is None else str(trial.number)
        lines.append(f"| {number} | {' | '.join(cells)} | {len(trial.places)} | {trial.differs} |")
    return lines


def search_plots(study: Study) -> dict[str, Plot]:
    """File name without suffix -> plot; nothing where there is no search for two objectives."""
    found = trials(study)
    return {"search": plot(CAPTION, [front_panel(study, found)], scale=1.5)} if found else {}


def front_panel(study: Study, found: Sequence[Trial]) -> Panel:
    """One objective against the other."""
    names = objectives(study)

    def scaled(places: Sequence[Place]) -> tuple[list[float], list[float]]:
        return axis_values(study, names[0], [x for x, _ in places]), axis_values(
            study, names[1], [y for _, y in places]
        )

    def draw(axes: "Axes") -> None:
        beside, best = repeated(found), unbeaten(found)
        single = [trial for trial in found if trial not in beside]
        pruned = [trial.mean for trial in single if trial.number is None]
        ended = [trial.mean for trial in single if trial.number is not None]
        axes.plot(*scaled([trial.mean for trial in best]), color="#9aa3ad", zorder=1)
        axes.plot(*scaled(pruned), "o", color="#9aa3ad", fillstyle="none", markersize=4, label=f"{len(pruned)} pruned")
        axes.plot(*scaled(ended), "o", color=color(0), markersize=4, label=f"{len(ended)} to the end")
        for trial in beside:
            axes.plot(*scaled(trial.places), ".", color=color(1), markersize=5)
            (x, y), (x_spread, y_spread) = (scaled([place]) for place in (trial.mean, trial.spread))
            label = f"{trial.number}, {len(trial.places)} seeds"
            axes.errorbar(x, y, xerr=x_spread, yerr=y_spread, color=color(1), capsize=3, zorder=3, label=label)
        for trial in best:
            (across,), (up,) = scaled([trial.mean])
            number = "" if trial.number is None else str(trial.number)
            axes.annotate(number, (across, up), (4, 3), textcoords="offset points")
        places = [place for trial in found for place in trial.places]
        logarithmic(axes.xaxis, scaled(places)[0])
        titles = [study.shown(name).title for name in names]
        axes.set(title=f"{titles[1]} against {titles[0]}", xlabel=f"{titles[0]}, logarithmic", ylabel=titles[1])
        axes.legend(frameon=False, fontsize=8)

    return draw
