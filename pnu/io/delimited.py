"""Clouds in text, as programs and people write them: separators, names, comments, counts, decimal commas."""

import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pnu.io.columns import SKIP
from pnu.io.fields import DEGREES, POINTS
from pnu.io.scan_columns import columns_of_scans
from pnu.io.text import table, text_lines

SAMPLE = 100  # lines that tell how a file is written
COMMENT = re.compile(r"\s*(#|//|%)+")
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.IGNORECASE)
UNIT = re.compile(r"\s*[\[(][^\])]*[\])]\s*$")  # x [m]


class Layout(NamedTuple):
    """How a file is written."""

    separator: str | None  # a comma, semicolon or tab that stands between any two values; None: blanks, or a mixture
    decimal_comma: bool
    width: int  # columns
    names: list[str] | None
    titles: list[str]  # lines before them that say something else
    first: int  # line that holds the first values, counted from 1
    promised: int | None  # number of points, as a line before them says
    words: list[int]  # columns that hold no numbers


class Text(NamedTuple):
    """Values (n, k), the names of their columns if the file says them, and what to say."""

    values: np.ndarray
    names: list[str] | None
    notes: tuple[str, ...]


def read_text(path: Path, columns: Sequence[str] | None = None) -> Text:
    """Values and names of a text file; `columns` are names that stand for the file's own."""
    layout = layout_of(path)
    names = layout.names if columns is None else list(columns)
    if names is not None and len(names) != layout.width:
        told = f"line {layout.first} has {layout.width} columns"
        if columns is not None:
            raise ValueError(f"{path}: columns={','.join(names)} are {len(names)} names, {told}; leave one out with _")
        raise ValueError(f"{path}: has {len(names)} names of columns, {told}; say them: columns=x,y,z,_,...")
    notes = [f"line left out: {title[:60]}" for title in layout.titles]
    if layout.words:
        given = [(names or [])[i : i + 1] or [f"column {i + 1}"] for i in layout.words]
        said = [word for (word,) in given if word != SKIP]
        notes += [f"left out, no numbers: {', '.join(said)}"] if said else []
    used = [i for i in range(layout.width) if i not in layout.words and not (names and names[i] == SKIP)]
    blocks: list[int] = []
    values = table(path, lambda: _rows(path, layout, used, blocks), first_line=layout.first)
    kept = names and [names[i] for i in used]
    if layout.promised is not None:
        values, more = _counted(path, values, sum(blocks))
        notes += more
    if layout.decimal_comma:
        notes.append("commas are read as decimal points")
    return Text(values, kept, tuple(notes))


def layout_of(path: Path) -> Layout:
    """How a file is written, from its first lines."""
    lines = list(islice(text_lines(path), SAMPLE))
    plain = [bare(line) for line in lines]
    data = [i for i, line in enumerate(plain) if line and is_number(re.split(r"[\s,;]+", line.strip("\"' ,;"))[0])]
    if not data:
        found = next((line for line in plain if line), "")  # words alone
        return Layout(None, False, len(found.split()), None, [], 1, None, [])
    count = None
    first = data[0]
    if (
        len(data) > 1
        and plain[first].isdecimal()
        and len(plain[data[1]].replace(",", " ").replace(";", " ").split()) > 2
    ):
        count, first = int(plain[first][:18]), data[1]
    rows = [plain[i] for i in data if i >= first]
    decimal = _decimal_comma(rows)
    separator = next(
        (mark for mark in ("\t;" if decimal else "\t;,") if all(mark in row.strip() for row in rows)), None
    )
    if separator in (None, ",") and not decimal and _commas_twice(rows):
        raise ValueError(
            f"{path}: line {first + 1}: commas stand between numbers and within them; write decimal points, or "
            "semicolons between the numbers"
        )
    cells = split_line(rows[0], separator)
    words = [i for i, cell in enumerate(cells) if not is_number(cell.replace(",", ".") if decimal else cell)]
    words = words if len(cells) - len(words) >= 3 else []
    names, at = _names(lines[:first], plain[:first], len(cells), separator)
    titles = [line for i, line in enumerate(plain[:first]) if line and i != at and not line.isdecimal()]
    return Layout(separator, decimal, len(cells), names, titles, first + 1, count, words)


def bare(line: str) -> str:
    """A line without its comment and quotes."""
    line = line.split("#", 1)[0].split("//", 1)[0].replace('"', "").strip("\r\n\0 ")
    return "" if line.startswith("%") else line


def is_number(text: str) -> bool:
    """Whether a word is a number, with a decimal point."""
    try:
        float(text)
    except ValueError:
        return text == ""  # an empty field
    return "_" not in text


def split_line(line: str, separator: str | None) -> list[str]:
    """Values of a line; behind a separator at its end there is none."""
    if separator is None:
        return line.replace(",", " ").replace(";", " ").split()
    cells = [cell.strip() for cell in line.split(separator)]
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _names(
    lines: list[str], plain: list[str], width: int, separator: str | None
) -> tuple[list[str] | None, int | None]:
    """Names of the columns, and at which of the lines before the values: bare, or a comment that names x y z."""
    for at in reversed(range(len(lines))):
        text = plain[at] or COMMENT.sub("", lines[at].replace('"', "")).strip()
        for mark in (separator, ",", ";", "\t", None):
            found = [UNIT.sub("", cell).strip() for cell in (split_line(text, mark) if mark else text.split())]
            known = {name.lower() for name in found}
            if any(known.issuperset(names) for names in (*POINTS, *DEGREES)) and (plain[at] or len(found) == width):
                return _distinct(found), at
        words = plain[at].replace(",", " ").replace(";", " ").split()
        if len(words) == width and not any(map(is_number, words)):
            return _distinct(words), at
    return None, None


def _distinct(names: list[str]) -> list[str]:
    result: list[str] = []
    for name in names:
        same = sum(other.lower() == name.lower() for other in names[: len(result)])
        result.append((f"{name}_{same + 1}" if same else name) or SKIP)
    return ["intensity" if name.lower() == "i" else name for name in result]


def _decimal_comma(rows: list[str]) -> bool:
    """Whether each comma stands within a number, between separators that are none, and no number has a point."""
    cells = [cell for row in rows for cell in row.replace(";", " ").split()]
    within = [cell for cell in cells if "," in cell]
    return (
        bool(within)
        and not any("." in cell for cell in cells)
        and all(DECIMAL_COMMA.fullmatch(cell) for cell in within)
        and len(cells) > len(rows)  # not commas alone
    )


def _commas_twice(rows: list[str]) -> bool:
    """0,61,-0,77,1,26: every second number is the rest of the one before, which no sign and leading zeros tell."""
    cells = [row.split(",") for row in rows]
    width = len(cells[0])
    if width < 6 or width % 2 or any(len(row) != width or "." in "".join(row) for row in cells):
        return False
    rest = [cell.strip() for row in cells for cell in row[1::2]]
    return all(cell.isdecimal() for cell in rest) and any(len(cell) > 1 and cell[0] == "0" for cell in rest)


def _rows(path: Path, layout: Layout, used: list[int], blocks: list[int]) -> Iterator[str]:
    """Lines from the first values on, as `table` takes them; lone counts go to `blocks`."""
    blocks[:] = [] if layout.promised is None else [layout.promised]
    all_used = len(used) == layout.width
    separator = layout.separator
    for line in islice(text_lines(path), layout.first - 1, None):
        if '"' in line or "//" in line or "%" in line:
            line = bare(line) + "\n"
        if layout.promised is not None and line.strip().isdecimal():
            blocks.append(int(line.strip()[:18]))
            yield "\n"
            continue
        if all_used and (separator is None or not _has_empty(line, separator)):
            line = line.replace(",", ".") if layout.decimal_comma else line.replace(",", " ")
            yield line.replace(";", " ")
            continue
        if separator is not None:
            cells = [cell.strip() for cell in bare(line).split(separator)]
            cells = cells[: layout.width] if not any(cells[layout.width :]) else cells
        else:
            cells = (bare(line) if layout.decimal_comma else bare(line).replace(",", " ")).replace(";", " ").split()
        if not any(cells):
            yield "\n"
        elif len(cells) == layout.width:
            taken = [cells[i].replace(",", ".") if layout.decimal_comma else cells[i] for i in used]
            yield " ".join("_".join(cell.split()) or "nan" for cell in taken) + "\n"
        else:  # another number of columns than the lines before, whichever are used: `table` says which line
            yield " ".join(["nan"] * (len(used) + 1)) + "\n"


def _has_empty(line: str, separator: str) -> bool:
    line = line.strip("\r\n ")
    return separator * 2 in line or line.startswith(separator) or line.endswith(separator)


def _counted(path: Path, values: np.ndarray, count: int) -> tuple[np.ndarray, list[str]]:
    """Values whose number a line before them promises; where there are twice as many, normals follow the points."""
    if len(values) == 2 * count and values.shape[1] == 3 and path.suffix.lower() == ".pwn":
        return np.hstack([values[:count], values[count:]]), []
    if len(values) < count:
        raise ValueError(f"{path}: promises {count} points, holds {len(values)}; it is cut off, copy it again")
    if len(values) > count:
        return values, [f"a line promises {count} points, {len(values)} follow: all are read"]
    return values, []


def read_ptx(path: Path) -> tuple[Text, dict[str, np.ndarray]]:
    """Scans on a grid, each with its place: two counts, four lines of the scanner, four of the matrix, the points.

    And `columns_of_scans`: a scan stands where the matrix moves it, else where its first line says.
    """
    lines = text_lines(path)
    scans, places, lost, width = [], [], 0, 0
    while head := list(islice((line for line in lines if line.strip()), 10)):
        try:
            size = int(head[0]) * int(head[1])
            matrix = np.array([[float(word) for word in line.split()] for line in head[6:]])
            place = np.array([float(word) for word in head[2].split()])
            if size < 0 or matrix.shape != (4, 4) or any(len(line.split()) != 3 for line in head[2:6]):
                raise ValueError
        except (ValueError, IndexError):
            raise ValueError(
                f"{path}: expected ptx: two counts, four lines of 3 numbers and four of 4 before the points; "
                "is it a pts or xyz file?"
            ) from None
        rows = list(islice(lines, min(size, path.stat().st_size)))
        if len(rows) < size:
            raise ValueError(f"{path}: promises {size} points, holds {len(rows)}; it is cut off, copy it again")
        values = table(path, lambda rows=rows: rows)  # type: ignore[misc]
        if not size:
            continue
        if len(values) != size or values.shape[1] < 3 or (width and values.shape[1] != width):
            raise ValueError(f"{path}: expected lines of x y z intensity, or with r g b; the file is damaged")
        width = values.shape[1]
        seen = values[:, :3].any(axis=1)
        lost += int((~seen).sum())
        scan = values[seen]
        scan[:, :3] = scan[:, :3] @ matrix[:3, :3] + matrix[3, :3]
        scans.append(scan)
        places.append(matrix[3, :3] if matrix[3, :3].any() else place)
    if not scans:
        raise ValueError(f"{path}: holds no points; expected ptx")
    notes = [f"{lost} of {lost + sum(map(len, scans))} points left out: no return"] if lost else []
    notes += [f"{len(scans)} scans, each moved to its place"] if len(scans) > 1 else []
    names = {4: ["x", "y", "z", "intensity"], 7: ["x", "y", "z", "intensity", "red", "green", "blue"]}.get(width)
    return Text(np.vstack(scans), names, tuple(notes)), columns_of_scans([len(scan) for scan in scans], places)
