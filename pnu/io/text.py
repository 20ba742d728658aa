"""Tables of numbers in text, with errors that name the line."""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import NoReturn

import numpy as np


def open_file(path: Path, content: str, suffixes: Iterable[str]) -> str:
    """The lower-case suffix of an existing file that is not empty; `ValueError` otherwise."""
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; give the file of a {content}")
    if path.suffix or path.is_file():
        known_suffix(path, content, suffixes)
    if not path.is_file():
        raise ValueError(f"{path}: no such file; give the path of a {content}")
    if not path.stat().st_size:
        raise ValueError(f"{path}: the file is empty; expected a {content}")
    return path.suffix.lower()


def known_suffix(path: Path, content: str, suffixes: Iterable[str]) -> str:
    """The suffix of a path, in lower case; `ValueError` names those that are known."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        wrong = f"the suffix '{path.suffix}' is not a format of a {content}" if path.suffix else "has no suffix"
        if path.is_dir():
            wrong = f"is a folder; give the name of a {content}"
        raise ValueError(f"{path}: {wrong}; use one of {' '.join(sorted(suffixes))}")
    return suffix


def text_lines(path: Path) -> Iterator[str]:
    """Lines of a text file, in UTF-8 or UTF-16, with or without a byte order mark."""
    with path.open("rb") as handle:
        encoding = _encoding(handle.read(4096))
    if encoding is None:
        raise ValueError(f"{path}: holds binary data; expected text, as the suffix '{path.suffix}' says")
    with path.open(encoding=encoding, errors="replace") as handle:
        yield from handle


def _encoding(head: bytes) -> str | None:
    """Of a text that begins so; None for binary data."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if b"\0" not in head:
        return "utf-8-sig"
    first, second = head[0:-1:2], head[1::2]
    if not any(second) and all(first):
        return "utf-16-le"
    return "utf-16-be" if not any(first) and all(second) else None


def table(path: Path, lines: Callable[[], Iterable[str]], *, first_line: int = 1) -> np.ndarray:
    """Numbers in columns, (rows, columns) float64; blank lines and # comments are skipped.

    `lines` gives the lines anew at each call: they are read a second time to name the one that is wrong.
    """
    rows = iter(lines())
    head = next((line for line in rows if line.split("#")[0].strip()), None)
    if head is None:
        return np.empty((0, 0))
    try:
        return np.loadtxt(chain([head], rows), comments="#", ndmin=2)
    except ValueError:
        _blame(path, lines(), first_line)


def _blame(path: Path, lines: Iterable[str], first_line: int) -> NoReturn:
    width = 0
    for number, line in enumerate(lines, first_line):
        tokens = line.split("#")[0].split()
        for token in tokens:
            try:
                float(token)
            except ValueError:
                raise ValueError(
                    f"{path}: line {number}: expected numbers, found '{token[:30]}'; remove or comment (#) that line"
                ) from None
        if tokens and width and len(tokens) != width:
            raise ValueError(
                f"{path}: line {number} has {len(tokens)} columns, those before have {width}; the file may be cut off"
            )
        width = width or len(tokens)
    raise ValueError(f"{path}: cannot be read as a table of numbers; check its lines")


def indices(path: Path, values: list[int]) -> np.ndarray:
    """int64 of whole numbers read from text; `ValueError` for one that no file can mean."""
    try:
        return np.array(values, np.int64)
    except OverflowError:
        raise ValueError(f"{path}: a face has a corner beyond 2^63; the file is damaged, save it again") from None
