"""Pages that need nothing else: tables that can be sorted, shapes that can be turned, figures.

The viewer is `viewer.js` on OGL (`ogl.min.js`, public domain, see OGL-LICENSE.txt).
"""

import base64
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from pnu.io import atomic_path
from pnu.rendering.colors import value_colors
from pnu.report.html_tables import Cell, Column, Line, Row, Set, Table, sort_key, typeset
from pnu.report.viewer_data import Drawing, ShapeView, encode

__all__ = [
    "Cell",
    "Column",
    "Drawing",
    "Line",
    "Row",
    "Set",
    "ShapeView",
    "Table",
    "data_url",
    "render",
    "sort_key",
    "typeset",
    "write_page",
]


def write_page(
    path: str | Path,
    title: str,
    tables: Mapping[str, Sequence[Table]],
    views: Sequence[ShapeView] = (),
    *,
    head: Sequence[str] = (),
    foot: Sequence[str] = (),
    views_note: str = "",
    figures: Mapping[str, bytes] | None = None,
    colormap: str = "error",
    pick: Mapping[str, Any] | None = None,
) -> int:
    """Write the page of a comparison atomically; returns its size in bytes.

    Args:
        tables: of each kind of input, which tabs switch between.
        views: for the 3D viewer.
        head, foot: paragraphs of plain text.
        figures: caption -> PNG or WebP.
        colormap: of errors, as in `pnu.rendering.colors`.
        pick: what the viewer shows first: mode (normals, errors, plain, colors), up (x, y, z), form, shape, kind, item.
    """
    from markupsafe import Markup

    scale = color_scale(colormap)
    stored = json.dumps([encode(view) for view in views]).replace("<", "\\u003c")  # nothing ends the element
    text = render(
        "comparison.html",
        title=title,
        tables={kind: [typeset(table) for table in shown] for kind, shown in tables.items()},
        head=head,
        foot=foot,
        views_note=views_note,
        pictures={caption: data_url(picture) for caption, picture in (figures or {}).items()},
        gradient=gradient(scale),
        colors=Markup(json.dumps([round(float(v), 4) for v in scale.ravel() / 255])),
        views=Markup(stored),
        pick=Markup(json.dumps(dict(pick or {})).replace("<", "\\u003c")),
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return len(text.encode())


def color_scale(colormap: str = "error") -> np.ndarray:
    """The sixteen colors (16, 3) of errors that the viewer mixes."""
    return value_colors(np.linspace(0, 1, 16), (0, 1), colormap)


def gradient(scale: np.ndarray) -> str:
    """The same as a background of CSS."""
    return f"linear-gradient(to right, {', '.join(f'rgb({r} {g} {b})' for r, g, b in scale)})"


def render(template: str, **values: Any) -> str:
    """A template of this package, filled; text in values is escaped."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    def read(name: str) -> str:
        return files(__package__).joinpath(name).read_text("utf-8")

    pages = Environment(
        loader=FunctionLoader(read), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    pages.globals["asset"] = lambda name: Markup(read(name))  # a file of this package, as it is
    return pages.get_template(template).render(**values)


def data_url(picture: bytes) -> str:
    """A PNG or WebP in the page itself."""
    kind = "webp" if picture[8:12] == b"WEBP" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
