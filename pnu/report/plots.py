"""The plots of a report, by matplotlib without a screen: each metric of each setting, effects of numbers, learning
curves, points against normals."""

import io
import logging
import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

from pnu.extras import needed
from pnu.report.sweep_results import Setting, Study, effects, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Panel = Callable[["Axes"], None]
Curve = list[tuple[float, float]]
MAIN = ("chamfer_sq", "normal_deg")
LOGARITHMIC = ("val/chamfer_sq", "train/cd")
WIDTH, HEIGHT = 4.1, 2.9  # inches of a panel
COLORS = ("#1f4e8c", "#d1495b", "#2e8b57", "#e08a00", "#6a4c93", "#008b9a", "#8c564b", "#c2569b", "#7f8c1f", "#444b54")
STYLE = {
    "axes.edgecolor": "#555c66",
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "grid.color": "#e3e6ea",
    "lines.linewidth": 1.6,
    "svg.fonttype": "none",  # text that can be searched
    "text.color": "#1a1d21",
    "text.parse_math": False,  # a name of a setting may hold a dollar
}


class Plot(NamedTuple):
    """One figure of the report, in both forms; the same study gives the same bytes."""

    caption: str
    svg: str
    png: bytes

    @property
    def inline(self) -> str:
        """The SVG as an element of a page, without the head of a file."""
        return self.svg[self.svg.index("<svg") :]


def plots(study: Study) -> dict[str, Plot]:
    """File name without suffix -> plot."""
    names = [setting.name for setting in study.settings]
    found = {
        "settings": plot(
            "Each metric of each setting: a dot for each seed, a bar for the mean"
            + ("" if study.search else "; the band is the baseline's spread"),
            [settings_panel(study, metric) for metric in study.metrics],
            names,
        )
    }
    if by_key := effects(study):
        drawn = [effect_panel(study, key, metric) for key in by_key for metric in study.metrics if metric in MAIN]
        found["effects"] = plot("Effect of each number: mean and, as a line up and down, spread over seeds", drawn)
    validated = [f"val/{metric}" for metric in study.metrics if metric in MAIN or metric in study.described]
    curves = [panel for name in [*validated, "train/cd"] if (panel := curve_panel(study, name)) is not None]
    if curves:
        found["curves"] = plot("Learning curves, mean over seeds", curves, names)
    normals = [name for name in ("normal_deg", "normal_unsigned_deg") if name in study.metrics]
    if normals and "chamfer_sq" in study.metrics:
        found["pareto"] = plot(
            "Points against normals, mean of each setting: no other is better in both than those on the line",
            [pareto_panel(study, name) for name in normals],
            names,
        )
    return found


def plot(
    caption: str, drawn: Sequence[Panel], legend: Sequence[str] = (), columns: int = 3, scale: float = 1.0
) -> Plot:
    """Panels in rows, each `scale` times as large as usual, and below them a legend: number and color of each name."""
    with needed("drawing plots"):
        from matplotlib import style
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.lines import Line2D

    columns = min(columns, len(drawn))
    rows, across = -(-len(drawn) // columns), max(1, round(columns * WIDTH / 2.6))
    below = 0.22 * -(-len(legend) // across) + 0.1 if legend else 0.0
    with style.context(["default", {**STYLE, "svg.hashsalt": caption}]), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # of names in other scripts
        figure = Figure(figsize=(columns * scale * WIDTH, rows * scale * HEIGHT + below))
        FigureCanvasAgg(figure)
        share = below / (rows * scale * HEIGHT + below)
        figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08, rect=(0, share, 1, 1 - share))
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, place in zip(drawn, axes, strict=False):
            panel(place)
        for empty in axes[len(drawn) :]:
            empty.remove()
        if legend:
            lines = [Line2D([], [], color=color(i), linestyle=dash(i), linewidth=3) for i in range(len(legend))]
            texts = [f"{i} {name}"[:34] for i, name in enumerate(legend)]
            figure.legend(lines, texts, loc="lower left", ncols=across, frameon=False, borderaxespad=0.2)
        return Plot(caption, svg(figure), png(figure))


def svg(figure: "Figure") -> str:
    """A figure as SVG."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def png(figure: "Figure") -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return buffer.getvalue()


def color(index: int) -> str:
    """The color of the i-th line."""
    return COLORS[index % len(COLORS)]


def dash(index: int) -> Literal["-", "--"]:
    """Lines after the tenth are dashed, since their colors repeat."""
    return "--" if index >= len(COLORS) else "-"


def logarithmic(axis: "Axis", values: Iterable[float]) -> None:
    """Make an axis logarithmic, with round numbers that the axis holds: at powers of ten, 1 2 5, or, where all values
    lie within less than a decade, as on a linear one."""
    with needed("drawing plots"):
        from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

    known = [value for value in values if math.isfinite(value) and value > 0] or [1.0, 10.0]
    low, high = min(known), max(known)
    room = max((high / low) ** 0.06, 1.02)
    axis._set_axes_scale("log")  # type: ignore[attr-defined]
    (axis.axes.set_xlim if axis.axis_name == "x" else axis.axes.set_ylim)(low / room, high * room)  # type: ignore[attr-defined]
    decades = math.log10(high / low)
    if decades < 1:
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    else:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades <= 3 else (1,), numticks=12))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: short(float(value))))
    axis.set_minor_formatter(NullFormatter())


def axis_values(study: Study, metric: str, values: Iterable[float]) -> list[float]:
    """Values in the unit of a metric's axis."""
    return [study.shown(metric).factor * value for value in values]


def settings_panel(study: Study, metric: str) -> Panel:
    """A metric of each setting, with its seeds."""

    def draw(axes: "Axes") -> None:
        summary = study.summary(study.baseline, metric) if study.baseline else None
        if summary is not None and summary.spread is not None:
            mean, spread = axis_values(study, metric, [summary.mean, summary.spread])
            axes.axhspan(mean - spread, mean + spread, color="#dfe8f3", zorder=0)
        for i, setting in enumerate(study.settings):
            values = axis_values(study, metric, setting.of(metric))
            axes.plot([i] * len(values), values, "o", color=color(i), markersize=4, alpha=0.8)
            if values:
                mean = sum(values) / len(values)
                axes.plot([i - 0.3, i + 0.3], [mean, mean], color=color(i), linewidth=2.5)
        axes.set_xticks(range(len(study.settings)))
        axes.set_xlim(-0.6, len(study.settings) - 0.4)
        axes.set(title=study.shown(metric).title, xlabel="setting")

    return draw


def effect_panel(study: Study, key: str, metric: str) -> Panel:
    """A metric against a number that the settings vary."""

    def draw(axes: "Axes") -> None:
        pairs = [(value, setting) for value, setting in effects(study)[key] if setting.of(metric)]
        values = [value for value, _ in pairs]
        positive = [value for value in values if value > 0]
        log = len(positive) > 1 and max(positive) / min(positive) > 20 and min(values) >= 0
        # on a logarithmic axis zero has a place of its own, left of the others
        place = {value: value if value > 0 or not log else min(positive) / 10 for value in values}
        means = axis_values(study, metric, [setting.mean(metric) for _, setting in pairs])
        spreads = axis_values(study, metric, [spread_of(study, setting, metric) for _, setting in pairs])
        if len(set(values)) == len(values) <= 8:
            axes.plot([place[value] for value in values], means, color="#9aa3ad", zorder=1)
        for (value, setting), mean, spread in zip(pairs, means, spreads, strict=True):
            ink = color(1 if setting is study.baseline else 0)
            axes.errorbar(place[value], mean, yerr=spread, fmt="o", color=ink, markersize=5)
        if log:
            logarithmic(axes.xaxis, place.values())
        if len(place) <= 6:
            axes.set_xticks([*place.values()], [short(value) for value in place])
        axes.set(title=f"{key}: {study.shown(metric).title}", xlabel=key)

    return draw


def spread_of(study: Study, setting: Setting, metric: str) -> float:
    """Standard deviation over the seeds of a setting."""
    summary = study.summary(setting, metric)
    return (summary.spread or 0.0) if summary else 0.0


def curve_panel(study: Study, name: str) -> Panel | None:
    """A value during the training, mean over seeds."""
    curves = [mean_curve(setting, name) for setting in study.settings]
    if not any(len(curve) > 1 for curve in curves):
        return None
    stage, _, metric = name.partition("/")
    factor = study.shown(metric).factor if stage == "val" else 1e3

    def draw(axes: "Axes") -> None:
        for i, curve in enumerate(curves):
            axes.plot([s for s, _ in curve], [factor * v for _, v in curve], color=color(i), linestyle=dash(i))
        title = f"{name} x 1e3" if factor == 1e3 else name
        if name in LOGARITHMIC:
            logarithmic(axes.yaxis, [factor * value for curve in curves for _, value in curve])
            title += ", logarithmic"
        axes.set(title=title, xlabel="step")

    return draw


def mean_curve(setting: Setting, name: str, points: int = 200) -> Curve:
    """The mean over seeds of a logged value at each step that all have; training values as means over 20 steps."""
    with needed("TensorBoard"):
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logging.getLogger("tensorboard").setLevel(logging.ERROR)  # it warns of runs that went on after an interruption
    by_step: defaultdict[float, list[float]] = defaultdict(list)
    for run in setting.runs:
        folder = run.folder.path / "tensorboard"
        if not folder.is_dir():
            return []
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
        if name not in events.Tags()["scalars"]:
            return []
        # a step that an interrupted run did twice counts once, as it was done last
        curve = sorted({float(event.step): event.value for event in events.Scalars(name)}.items())
        if name.startswith("train/"):
            size = max(20, len(curve) // points)
            blocks = [curve[i : i + size] for i in range(0, len(curve), size)]
            curve = [(block[-1][0], sum(value for _, value in block) / len(block)) for block in blocks]
        for step, value in curve:
            by_step[step].append(value)
    return [
        (step, sum(values) / len(values))
        for step, values in sorted(by_step.items())
        if len(values) == len(setting.runs)
    ]


def pareto_panel(study: Study, normals: str) -> Panel:
    """Chamfer distance against the error of the normals."""

    def draw(axes: "Axes") -> None:
        places = {
            i: (
                axis_values(study, "chamfer_sq", [s.mean("chamfer_sq")])[0],
                axis_values(study, normals, [s.mean(normals)])[0],
            )
            for i, s in enumerate(study.settings)
            if s.of(normals) and s.of("chamfer_sq")
        }
        if best := front(list(places.values())):
            axes.plot(*zip(*best, strict=True), color="#9aa3ad", zorder=1)
        for i, place in places.items():
            axes.plot(*place, "o", color=color(i), markersize=6)
            axes.annotate(str(i), place, (4, 3), textcoords="offset points")
        axes.margins(0.1)
        titles = study.shown("chamfer_sq").title, study.shown(normals).title
        axes.set(title=f"{titles[1]} against CD", xlabel=titles[0], ylabel=titles[1])

    return draw


def front(places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those that no other beats in both, by the first value."""
    best, kept = math.inf, []
    for place in sorted(places):
        if place[1] < best:
            best = place[1]
            kept.append(place)
    return kept
