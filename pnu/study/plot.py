"""Small plots as SVG, drawn by hand: they need no library, in a page or in Markdown."""

import html
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

WIDTH, HEIGHT = 400, 280
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 30, 44  # margins of a panel
COLORS = ("#1f4e8c", "#d1495b", "#2e8b57", "#e08a00", "#6a4c93", "#008b9a", "#8c564b", "#c2569b", "#7f8c1f", "#444b54")


class Axis(NamedTuple):
    """Values from `low` to `high` over the pixels `start` to `end`; where `log`, the values are positive."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, value: float) -> float:
        low, high, at = (map(math.log10, (self.low, self.high, value))) if self.log else (self.low, self.high, value)
        return self.start + (at - low) / (high - low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """A few round values."""
        if self.log:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            steps = (1,) if last - first > 3 else (1, 2, 5)
            found = [m * 10.0**e for e in range(first, last + 1) for m in steps]
            return [value for value in found if self.low <= value <= self.high]
        rough = (self.high - self.low) / 5
        unit = 10 ** math.floor(math.log10(rough))
        step = next(m * unit for m in (1, 2, 5, 10) if m * unit >= rough)
        return [i * step for i in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]


def axis(values: Iterable[float], start: float, end: float, *, log: bool = False) -> Axis:
    """An axis that holds all finite values, with a little room."""
    known = [value for value in values if math.isfinite(value) and (value > 0 or not log)] or [1.0, 2.0]
    low, high = min(known), max(known)
    if log:
        room = max((high / low) ** 0.06, 1.02)
        return Axis(low / room, high * room, start, end, True)
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return Axis(low - room, high + room, start, end)


def color(index: int) -> str:
    return COLORS[index % len(COLORS)]


def dash(index: int) -> str:
    """Lines after the tenth are dashed, since their colours repeat."""
    return ' stroke-dasharray="5 3"' if index >= len(COLORS) else ""


def label(value: float) -> str:
    return f"{value:.4g}"


def text(x: float, y: float, content: str, *, anchor: str = "middle", more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{html.escape(content)}</text>'


def line(points: Sequence[tuple[float, float]], stroke: str, more: str = "") -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{stroke}" stroke-width="1.6"{more}/>'


def dot(x: float, y: float, fill: str, title: str, radius: float = 3.5) -> str:
    name = f"<title>{html.escape(title)}</title>"
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{fill}" data-x="{x:.1f}">{name}</circle>'


def frame(
    title: str, x: Axis, y: Axis, names: tuple[str, str], marks: Sequence[tuple[float, str]] | None = None
) -> str:
    """Title, grid, numbers and names of the axes; `marks` stand for the numbers of the x axis."""
    parts = [text((x.start + x.end) / 2, y.end - 12, title, more=' class="title"')]
    for value in y.ticks():
        parts.append(f'<path class="grid" d="M{x.start} {y(value):.1f}H{x.end}"/>')
        parts.append(text(x.start - 6, y(value) + 4, label(value), anchor="end"))
    for value, name in [(value, label(value)) for value in x.ticks()] if marks is None else marks:
        parts.append(f'<path class="grid" d="M{x(value):.1f} {y.start}V{y.end}"/>')
        parts.append(text(x(value), y.start + 15, name))
    parts.append(text((x.start + x.end) / 2, y.start + 33, names[0]))
    turn = f' transform="rotate(-90 {x.start - 48} {(y.start + y.end) / 2})"'
    parts.append(text(x.start - 48, (y.start + y.end) / 2, names[1], more=turn))
    parts.append(f'<path class="axis" d="M{x.start} {y.end}V{y.start}H{x.end}"/>')
    return "".join(parts)


def panels(drawn: Sequence[Callable[[float, float], str]], columns: int = 2, legend: Sequence[str] = ()) -> str:
    """An SVG of panels, each drawn with its left and top edge given, and below a legend: a colour for each name."""
    rows = -(-len(drawn) // columns)
    columns = min(columns, len(drawn))
    width, below = columns * WIDTH, rows * HEIGHT
    body = [draw((i % columns) * WIDTH, (i // columns) * HEIGHT) for i, draw in enumerate(drawn)]
    across = max(1, width // 230)
    for i, name in enumerate(legend):
        x, y = 20 + (i % across) * 230, below + 14 + (i // across) * 18
        body.append(f'<path d="M{x} {y - 4}h22" stroke="{color(i)}" stroke-width="3"{dash(i)}/>')
        body.append(text(x + 28, y, f"{i} {name}"[:34], anchor="start"))
    height = below + (18 * -(-len(legend) // across) + 10 if legend else 0)
    style = (
        "text{font:12px system-ui,sans-serif;fill:#1a1d21}.title{font-weight:600;font-size:13px}"
        ".grid{stroke:#e3e6ea}.axis{stroke:#555c66;fill:none}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">'
        f'<style>{style}</style><rect width="{width}" height="{height}" fill="#fff"/>{"".join(body)}</svg>'
    )


def axes_at(left: float, top: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Pixels of the x axis (left, right) and of the y axis (bottom, top) of a panel."""
    return (left + LEFT, left + WIDTH - RIGHT), (top + HEIGHT - BOTTOM, top + TOP)
