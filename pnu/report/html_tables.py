"""Tables of a page: numbers with a form, the best of each column in bold."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple


class Column(NamedTuple):
    """The head of a column; `best` says whether its best number is set in bold, the lowest or the highest."""

    head: str
    form: str = ".3f"
    best: bool = True
    group: str = ""  # a head over neighboring columns
    better: str = "lower"


class Row(NamedTuple):
    """A name and a number for each column, None where there is none; a `reference` is no candidate for the best."""

    name: str
    values: Sequence[float | None]
    reference: bool = False


class Table(NamedTuple):
    """A table of a page."""

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Row]


class Cell(NamedTuple):
    """Text of a cell and what is set small below it; `key` sorts; `kind` is a class of the style."""

    text: str
    key: str = ""
    kind: str = ""
    below: str = ""


class Line(NamedTuple):
    """A row as it is set; `key` sorts in place of the name."""

    name: str
    cells: Sequence[Cell]
    reference: bool = False
    key: str | None = None
    hint: str = ""


class Set(NamedTuple):
    """A table as it is set, for table.html."""

    caption: str
    first: str  # head of the names
    heads: Sequence[str]
    rows: Sequence[Line]
    groups: Sequence[tuple[str, int]] = ()  # heads over columns, and over how many


def typeset(table: Table) -> Set:
    """A table whose best numbers are bold, compared as they are printed, so that equal prints are equally best."""
    best: list[str | None] = []
    for i, column in enumerate(table.columns):
        numbers = [row.values[i] for row in table.rows if not row.reference]
        known = [number for number in numbers if number is not None and math.isfinite(number)]
        choose = max if column.better == "higher" else min
        best.append(cell_text(choose(known), column.form) if column.best and known else None)
    groups: list[tuple[str, int]] = []
    if any(column.group for column in table.columns):
        names = (column.group for column in table.columns)
        groups = [(name, len(list(members))) for name, members in itertools.groupby(names)]
    rows = []
    for row in table.rows:
        cells = []
        for number, column, winner in zip(row.values, table.columns, best, strict=True):
            text = cell_text(number, column.form)
            kind = "best" if winner is not None and text == winner and not row.reference else ""
            cells.append(Cell(text, sort_key(number), kind))
        rows.append(Line(row.name, cells, row.reference))
    return Set(table.caption, "method", [column.head for column in table.columns], rows, groups)


def cell_text(number: float | None, form: str) -> str:
    """A number as a cell shows it."""
    return "-" if number is None or not math.isfinite(number) else format(number, form)


def sort_key(number: float | None) -> str:
    """In full, nothing for none."""
    return "" if number is None or not math.isfinite(number) else repr(float(number))
