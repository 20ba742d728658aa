"""The plots of a report: each metric of each setting, effects of numbers, learning curves, points against normals."""

import logging
import math
from collections import defaultdict
from collections.abc import Callable, Sequence

from pnu.run.table import SHOWN
from pnu.study.plot import axes_at, axis, color, dash, dot, frame, line, panels
from pnu.study.settings import Setting, Study, effects, short

Panel = Callable[[float, float], str]
Curve = list[tuple[float, float]]
CURVES = ("val/chamfer_sq", "val/normal_deg", "train/cd")


def plots(study: Study) -> dict[str, tuple[str, str]]:
    """File name without suffix -> (caption, SVG)."""
    names = [setting.name for setting in study.settings]
    found = {
        "settings": (
            "Each metric of each setting: a dot for each seed, a bar for the mean; the band is the baseline's spread",
            panels([settings_panel(study, metric) for metric in study.metrics], 3, names),
        )
    }
    if by_key := effects(study):
        drawn = [effect_panel(study, key, metric) for key in by_key for metric in study.metrics if metric in MAIN]
        found["effects"] = ("Effect of each number: mean and, as a line up and down, spread over seeds", panels(drawn))
    curves = [panel for name in CURVES if (panel := curve_panel(study, name)) is not None]
    if curves:
        found["curves"] = ("Learning curves, mean over seeds", panels(curves, columns=3, legend=names))
    if {"chamfer_sq", "normal_deg"} <= set(study.metrics):
        drawn = [pareto_panel(study, "normal_deg"), pareto_panel(study, "normal_unsigned_deg")]
        found["pareto"] = (
            "Points against normals, mean of each setting: no other is better in both than those on the line",
            panels(drawn, legend=names),
        )
    return found


MAIN = ("chamfer_sq", "normal_deg")


def head(metric: str) -> str:
    return SHOWN[metric][0]


def scaled(metric: str, values: Sequence[float]) -> list[float]:
    return [SHOWN[metric][1] * value for value in values]


def settings_panel(study: Study, metric: str) -> Panel:
    def draw(left: float, top: float) -> str:
        across, up = axes_at(left, top)
        values = [scaled(metric, setting.of(metric)) for setting in study.settings]
        x = axis([-0.4, len(values) - 0.6], *across)
        y = axis([value for group in values for value in group], *up)
        marks = [(float(i), str(i)) for i in range(len(values))]
        parts = []
        summary = study.summary(study.baseline, metric)
        if summary is not None and summary.spread is not None:
            mean, spread = scaled(metric, [summary.mean, summary.spread])
            high, low = y(min(mean + spread, y.high)), y(max(mean - spread, y.low))
            band = f'x="{x.start}" y="{high:.1f}" width="{x.end - x.start}" height="{low - high:.1f}"'
            parts.append(f'<rect {band} fill="#dfe8f3"/>')
        parts.append(frame(head(metric), x, y, ("setting", head(metric)), marks))
        for i, group in enumerate(values):
            for run, value in zip([r for r in study.settings[i].runs if metric in r.metrics], group, strict=True):
                title = f"{study.settings[i].name}, seed {run.seed}: {value:.4g}"
                parts.append(dot(x(i), y(value), color(i), title, 3))
            if group:
                mean = y(sum(group) / len(group))
                parts.append(f'<path d="M{x(i) - 9:.1f} {mean:.1f}h18" stroke="{color(i)}" stroke-width="2.5"/>')
        return "".join(parts)

    return draw


def effect_panel(study: Study, key: str, metric: str) -> Panel:
    def draw(left: float, top: float) -> str:
        across, up = axes_at(left, top)
        pairs = [(value, setting) for value, setting in effects(study)[key] if setting.of(metric)]
        values = [value for value, _ in pairs]
        positive = [value for value in values if value > 0]
        log = len(positive) > 1 and max(positive) / min(positive) > 20
        # on a logarithmic axis zero has a place of its own, left of the others
        zero = min(positive) / 10 if log else 0.0
        place = {value: value if value > 0 or not log else zero for value in values}
        x = axis(place.values(), *across, log=log)
        means = [scaled(metric, [setting.mean(metric)])[0] for _, setting in pairs]
        spreads = [scaled(metric, [summary_spread(study, setting, metric)])[0] for _, setting in pairs]
        y = axis([m + s * side for m, s in zip(means, spreads, strict=True) for side in (-1, 1)], *up)
        marks = [(place[value], short(value)) for value in dict.fromkeys(values)] if len(set(values)) <= 6 else None
        parts = [frame(f"{key}: {head(metric)}", x, y, (key, head(metric)), marks)]
        points = [(x(place[value]), y(mean)) for value, mean in zip(values, means, strict=True)]
        if len(set(values)) == len(values) <= 8:
            parts.append(line(points, "#9aa3ad"))
        for (value, setting), point, mean, spread in zip(pairs, points, means, spreads, strict=True):
            ink = color(1 if setting is study.baseline else 0)
            parts.append(line([(point[0], y(mean - spread)), (point[0], y(mean + spread))], ink))
            parts.append(dot(*point, ink, f"{setting.name}: {short(value)}, {mean:.4g} +- {spread:.2g}"))
        return "".join(parts)

    return draw


def summary_spread(study: Study, setting: Setting, metric: str) -> float:
    summary = study.summary(setting, metric)
    return (summary.spread or 0.0) if summary else 0.0


def curve_panel(study: Study, name: str) -> Panel | None:
    curves = [mean_curve(setting, name) for setting in study.settings]
    if not any(len(curve) > 1 for curve in curves):
        return None
    factor = 1e3 if name in ("val/chamfer_sq", "train/cd") else 1.0
    log = name in ("val/chamfer_sq", "train/cd")

    def draw(left: float, top: float) -> str:
        across, up = axes_at(left, top)
        x = axis([step for curve in curves for step, _ in curve], *across)
        y = axis([factor * value for curve in curves for _, value in curve], *up, log=log)
        parts = [frame(f"{name} x 1e3" if factor > 1 else name, x, y, ("step", "logarithmic" if log else ""))]
        for i, curve in enumerate(curves):
            points = [(x(step), y(factor * value)) for step, value in curve if value > 0 or not log]
            parts.append(line(points, color(i), dash(i)))
        return "".join(parts)

    return draw


def mean_curve(setting: Setting, name: str, points: int = 200) -> Curve:
    """The mean over seeds of a logged value at each step that all have; training values as means over 20 steps."""
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
    def draw(left: float, top: float) -> str:
        across, up = axes_at(left, top)
        places = {
            i: (scaled("chamfer_sq", [s.mean("chamfer_sq")])[0], scaled(normals, [s.mean(normals)])[0])
            for i, s in enumerate(study.settings)
            if s.of(normals) and s.of("chamfer_sq")
        }
        x = axis([place[0] for place in places.values()], *across)
        y = axis([place[1] for place in places.values()], *up)
        parts = [frame(f"{head(normals)} against CD", x, y, (head("chamfer_sq"), head(normals)))]
        parts.append(line([(x(a), y(b)) for a, b in front(list(places.values()))], "#9aa3ad"))
        for i, (a, b) in places.items():
            parts.append(dot(x(a), y(b), color(i), f"{study.settings[i].name}: {a:.4g}, {b:.4g}", 4.5))
            parts.append(f'<text x="{x(a) + 7:.1f}" y="{y(b) - 5:.1f}">{i}</text>')
        return "".join(parts)

    return draw


def front(places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those that no other beats in both, by the first value."""
    best, kept = math.inf, []
    for place in sorted(places):
        if place[1] < best:
            best = place[1]
            kept.append(place)
    return kept
