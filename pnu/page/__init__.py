"""One HTML page that needs nothing else: tables that can be sorted, shapes that can be turned, figures.

The viewer is `viewer.js` on OGL (`ogl.min.js`, public domain, see OGL-LICENSE.txt).
"""

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pnu.io import atomic_path
from pnu.ops.colors import value_colors
from pnu.page.encode import Drawing, View, encode

__all__ = ["Column", "Drawing", "Row", "Table", "View", "write_page"]


class Column(NamedTuple):
    """The head of a column; `best` says whether its smallest number is set in bold."""

    head: str
    digits: int = 3
    best: bool = True
    group: str = ""  # a head over neighbouring columns


class Row(NamedTuple):
    """A name and a number for each column, None where there is none; a `reference` is no candidate for the best."""

    name: str
    values: Sequence[float | None]
    reference: bool = False


class Table(NamedTuple):
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Row]


def write_page(
    path: str | Path,
    title: str,
    tables: Mapping[str, Sequence[Table]],
    views: Sequence[View] = (),
    *,
    head: Sequence[str] = (),
    foot: Sequence[str] = (),
    views_note: str = "",
    figures: Mapping[str, bytes] | None = None,
    colormap: str = "error",
) -> int:
    """Write the page atomically; returns its size in bytes.

    Args:
        tables: of each kind of input, which tabs switch between.
        views: for the 3D viewer.
        head, foot: paragraphs of plain text.
        figures: caption -> PNG or WebP.
        colormap: of errors, as in `pnu.ops.colors`.
    """
    assets = {name: files(__package__).joinpath(name).read_text("utf-8") for name in ASSETS}
    scale = value_colors(np.linspace(0, 1, 16), (0, 1), colormap)
    gradient = ", ".join(f"rgb({r} {g} {b})" for r, g, b in scale)
    kinds = list(tables)
    values = {
        "title": html.escape(title),
        "style": assets["style.css"].replace("{{gradient}}", f"linear-gradient(to right, {gradient})"),
        "head": paragraphs(head),
        "foot": paragraphs(foot),
        "views_note": html.escape(views_note),
        "tabs": "".join(tab(kind, i == 0) for i, kind in enumerate(kinds)),
        "tables": "\n".join(section(kind, tables[kind], i == 0) for i, kind in enumerate(kinds)),
        "figures": "\n".join(figure(caption, picture) for caption, picture in (figures or {}).items()),
        "colors": json.dumps([round(float(v), 4) for v in scale.ravel() / 255]),
        "views": json.dumps([encode(view) for view in views]).replace("<", "\\u003c"),  # nothing ends the element
        "ogl": assets["ogl.min.js"],
        "viewer": assets["sort.js"] + assets["viewer.js"],
    }
    first, *rest = assets["page.html"].split("{{")
    text = first + "".join(values[name] + after for name, _, after in (part.partition("}}") for part in rest))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return len(text.encode())


ASSETS = ("page.html", "style.css", "sort.js", "viewer.js", "ogl.min.js")


def paragraphs(lines: Sequence[str]) -> str:
    return "\n".join(f'<p class="note">{html.escape(line)}</p>' for line in lines)


def tab(kind: str, pressed: bool) -> str:
    name = html.escape(kind)
    return f'<button data-kind="{name}" aria-pressed="{str(pressed).lower()}">{name}</button>'


def section(kind: str, tables: Sequence[Table], shown: bool) -> str:
    body = "\n".join(table_html(table) for table in tables)
    return f'<section class="kind" data-kind="{html.escape(kind)}"{"" if shown else " hidden"}>\n{body}\n</section>'


def table_html(table: Table) -> str:
    """A table whose best numbers are bold, compared as they are printed, so that equal prints are equally best."""
    best: list[str | None] = []
    for i, column in enumerate(table.columns):
        numbers = [row.values[i] for row in table.rows if not row.reference]
        known = [number for number in numbers if number is not None and math.isfinite(number)]
        best.append(shown(min(known), column.digits) if column.best and known else None)
    groups = ""
    if any(column.group for column in table.columns):
        names = [column.group for column in table.columns]
        starts = [i for i, name in enumerate(names) if i == 0 or name != names[i - 1]]
        cells = "".join(
            f'<th colspan="{end - start}">{html.escape(names[start])}</th>'
            for start, end in zip(starts, [*starts[1:], len(names)], strict=True)
        )
        groups = f'<tr class="group"><th></th>{cells}</tr>'
    heads = "".join(f'<th scope="col">{html.escape(column.head)}</th>' for column in table.columns)
    rows = []
    for row in table.rows:
        cells = ""
        for number, column, winner in zip(row.values, table.columns, best, strict=True):
            text = shown(number, column.digits)
            bold = ' class="best"' if winner is not None and text == winner and not row.reference else ""
            key = "" if number is None or not math.isfinite(number) else repr(float(number))
            cells += f'<td{bold} data-value="{key}">{text}</td>'
        kind = ' class="reference"' if row.reference else ""
        rows.append(f"<tr{kind}><td>{html.escape(row.name)}</td>{cells}</tr>")
    return (
        f'<h2>{html.escape(table.caption)}</h2>\n<div class="scroll"><table class="sortable">'
        f'<thead>{groups}<tr><th scope="col">method</th>{heads}</tr></thead>\n<tbody>\n'
        + "\n".join(rows)
        + "\n</tbody></table></div>"
    )


def shown(number: float | None, digits: int) -> str:
    return "-" if number is None or not math.isfinite(number) else f"{number:.{digits}f}"


def figure(caption: str, picture: bytes) -> str:
    data = base64.b64encode(picture).decode()
    kind = "webp" if picture[8:12] == b"WEBP" else "png"
    text = html.escape(caption)
    return f'<h2>{text}</h2>\n<figure><img alt="{text}" src="data:image/{kind};base64,{data}"></figure>'
