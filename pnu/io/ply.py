"""The Stanford format: any elements and properties, in text or binary of either byte order."""

import mmap
import struct
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pnu.io.text import table

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8", "bool": "u1"},
}
SLICE = 2**20  # rows written at once
NAMES = {
    **{"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"},
    **{"f4": "float", "f8": "double"},
}


class Property(NamedTuple):
    """`length` is the type of the count in front of a list, empty for a scalar."""

    name: str
    type: str
    length: str


class Element(NamedTuple):
    """An element of a header: its name, count and properties."""

    name: str
    size: int
    properties: list[Property]


class Lists(NamedTuple):
    """A list property: `counts` (n,) entries each, all `values` in a row."""

    counts: np.ndarray
    values: np.ndarray


Columns = dict[str, np.ndarray | Lists]


def read_ply(path: Path, wanted: set[str]) -> dict[str, Columns]:
    """Columns of the wanted elements by property name.

    Counts that the file's size cannot hold are refused unread, and so are files that go on after the last element.
    """
    data = _mapped(path)
    order, elements, start = _header(path, data)
    found: dict[str, Columns] = {}
    if order is None:
        lines = iter(data[start:].decode("ascii", "replace").splitlines())
        rows = (line for line in lines if line.strip())
    for element in elements:
        if order is None:
            own = list(islice(rows, min(element.size, len(data)) if element.properties else 0))
            if element.name in wanted:
                found[element.name] = _text(path, element, own)
            elif len(own) < element.size and element.properties:
                raise _short(path, element, str(len(own)))
        elif element.name in wanted:
            found[element.name], start = _binary(path, data, start, element, order)
        else:
            start = _skip(path, data, start, element, order)
    if order is None:
        if more := sum(1 for _ in rows):
            raise _long(path, elements, more, "lines")
    elif data[start : start + SLICE].strip(b"\0\r\n\t \x1a"):  # some programs fill up the last block
        raise _long(path, elements, len(data) - start, "bytes")
    return found


def element_sizes(path: Path) -> dict[str, int]:
    """How many of each element the header promises."""
    return {element.name: element.size for element in _header(path, _mapped(path))[1]}


def _mapped(path: Path) -> mmap.mmap:
    """The file's bytes: pages come in as they are needed."""
    with path.open("rb") as handle:
        return mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)


def _header(path: Path, data: mmap.mmap) -> tuple[str | None, list[Element], int]:
    """Byte order ("<", ">", None for text), elements, and where the body starts."""
    end = data.find(b"end_header")
    if data[:3] != b"ply" or end < 0:
        raise ValueError(f"{path}: expected a ply header from 'ply' to 'end_header', found none; is it another format?")
    order: str | None = ""
    elements: list[Element] = []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            match words:
                case ["format", kind, _]:
                    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
                case ["element", name, count] if int(count) >= 0:
                    elements.append(Element(name, int(count), []))
                case ["property", "list", length, kind, name] if TYPES[length][0] in "iu":
                    elements[-1].properties.append(Property(name, TYPES[kind], TYPES[length]))
                case ["property", kind, name] if kind != "list":
                    elements[-1].properties.append(Property(name, TYPES[kind], ""))
                case ["format" | "element" | "property", *_]:
                    raise ValueError(line)
                case _:
                    pass  # comment, obj_info, and what exporters write without either
        except (ValueError, KeyError, IndexError):
            raise ValueError(f"{path}: '{line.strip()[:60]}' is no line of a ply header; save the file again") from None
    if order == "":
        raise ValueError(f"{path}: the ply header has no format line; save the file again")
    for element in elements:
        names = [item.name for item in element.properties]
        if len(set(names)) < len(names):
            raise ValueError(f"{path}: element '{element.name}' has two properties of one name; save the file again")
    newline = data.find(b"\n", end)
    return order, elements, newline + 1 if newline >= 0 else len(data)


def _short(path: Path, element: Element, found: str) -> ValueError:
    return ValueError(
        f"{path}: the header promises {element.size} of element '{element.name}', the file holds {found}; "
        "it is cut off or damaged, copy it again"
    )


def _long(path: Path, elements: list[Element], more: int, unit: str) -> ValueError:
    """For a file that goes on after the last element: which line of the header would be right, where that is clear."""
    element = next((element for element in reversed(elements) if element.size), Element("vertex", 0, []))
    fixed = not any(item.length for item in element.properties)
    row = 1 if unit == "lines" else sum(np.dtype(item.type).itemsize for item in element.properties)
    cure = "save it again"
    if element.size and fixed and row and more % row == 0:
        line = f"element {element.name} {{}}"
        whole = element.size + more // row
        cure = f"if all belong to it, write '{line.format(whole)}' for '{line.format(element.size)}' in its header"
    return ValueError(
        f"{path}: goes on after the last element, with {more} {unit} more than the header promises; {cure}"
    )


def _text(path: Path, element: Element, lines: list[str]) -> Columns:
    if len(lines) < element.size:
        raise _short(path, element, str(len(lines)))
    names = [item.name for item in element.properties]
    if not any(item.length for item in element.properties):
        values = table(path, lambda: lines) if lines else np.empty((0, len(names)))
        if values.shape != (element.size, len(names)):
            raise ValueError(
                f"{path}: element '{element.name}' has {len(names)} properties, its lines {values.shape[1]} columns; "
                "save the file again"
            )
        return {item.name: values[:, i].astype(item.type) for i, item in enumerate(element.properties)}
    columns: dict[str, list[float]] = {name: [] for name in names}
    counts: dict[str, list[int]] = {item.name: [] for item in element.properties if item.length}
    for line in lines:
        words = iter(line.split())
        try:
            for item in element.properties:
                take = 1
                if item.length:
                    take = int(next(words))
                    counts[item.name].append(take)
                taken = [float(word) for word in islice(words, max(take, 0))]
                if len(taken) != take:
                    raise ValueError
                columns[item.name] += taken
        except (ValueError, StopIteration):
            raise ValueError(
                f"{path}: '{line.strip()[:40]}' does not fit element '{element.name}'; save the file again"
            ) from None
    result: Columns = {}
    for item in element.properties:
        values = np.array(columns[item.name], dtype=np.float64).astype(item.type)
        result[item.name] = Lists(np.array(counts[item.name], dtype=np.int64), values) if item.length else values
    return result


def _binary(path: Path, data: mmap.mmap, start: int, element: Element, order: str) -> tuple[Columns, int]:
    """Columns of an element that begins at byte `start`, and where it ends."""
    if not _fits(path, data, start, element):
        return {item.name: np.empty(0, item.type) for item in element.properties}, start
    lengths, rows = _uniform(path, data, start, element, order)
    if rows is not None:
        return _columns(element, rows, lengths), start + rows.nbytes
    return _ragged(path, data, start, element, order)


def _skip(path: Path, data: mmap.mmap, start: int, element: Element, order: str) -> int:
    """Where an element ends that begins at byte `start`."""
    if not _fits(path, data, start, element):
        return start
    _, rows = _uniform(path, data, start, element, order)
    if rows is not None:
        return start + rows.nbytes
    kinds = [
        (struct.Struct(order + np.dtype(item.length).char) if item.length else None, np.dtype(item.type).itemsize)
        for item in element.properties
    ]
    try:
        for number in range(element.size):  # noqa: B007
            for length, size in kinds:
                if length is None:
                    start += size
                else:
                    start += length.size + size * max(length.unpack_from(data, start)[0], 0)
    except struct.error:
        raise _short(path, element, str(number)) from None
    if start > len(data):
        raise _short(path, element, str(number))
    return start


def _fits(path: Path, data: mmap.mmap, start: int, element: Element) -> bool:
    """False for an element without content; `ValueError` for more rows than there are bytes."""
    least = sum(np.dtype(item.length or item.type).itemsize for item in element.properties)
    if element.size * least > len(data) - start:
        raise _short(path, element, f"{len(data) - start} bytes more")
    return element.size > 0 and least > 0


def _uniform(
    path: Path, data: mmap.mmap, start: int, element: Element, order: str
) -> tuple[dict[str, int], np.ndarray | None]:
    """Lengths of the lists in the first row; and the rows, None where those of others are not the same."""
    try:
        lengths, _ = _row_lengths(data, start, element, order)
    except struct.error:
        raise _short(path, element, "0") from None
    dtype = _row_dtype(element, order, lengths)
    if element.size * dtype.itemsize <= len(data) - start:
        rows = np.frombuffer(data, dtype, element.size, start)
        if all(np.all(rows[f"{name} count"] == length) for name, length in lengths.items()):
            return lengths, rows
    return lengths, None


def _row_lengths(data: mmap.mmap, start: int, element: Element, order: str) -> tuple[dict[str, int], int]:
    """Length of each list in the row at byte `start`, and where the row ends; `struct.error` where it is cut off."""
    lengths: dict[str, int] = {}
    for item in element.properties:
        take = 1
        if item.length:
            code = np.dtype(order + item.length)
            if start + code.itemsize > len(data):
                raise struct.error
            take = max(int(np.frombuffer(data, code, 1, start)[0]), 0)
            lengths[item.name] = take
            start += code.itemsize
        start += take * np.dtype(item.type).itemsize
    if start > len(data):
        raise struct.error
    return lengths, start


def _row_dtype(element: Element, order: str, lengths: Mapping[str, int]) -> np.dtype:
    fields: list[tuple[Any, ...]] = []
    for item in element.properties:
        if item.length:
            fields.append((f"{item.name} count", order + item.length))
            fields.append((item.name, order + item.type, (lengths[item.name],)))
        else:
            fields.append((item.name, order + item.type))
    return np.dtype(fields)


def _columns(element: Element, rows: np.ndarray, lengths: Mapping[str, int]) -> Columns:
    result: Columns = {}
    for item in element.properties:
        values = rows[item.name].astype(item.type)
        if item.length:
            result[item.name] = Lists(np.full(len(rows), lengths[item.name], dtype=np.int64), values.reshape(-1))
        else:
            result[item.name] = values
    return result


def _ragged(path: Path, data: mmap.mmap, start: int, element: Element, order: str) -> tuple[Columns, int]:
    """Rows whose lists differ in length, one after the other."""
    rows: list[Columns] = []
    for number in range(element.size):
        try:
            lengths, end = _row_lengths(data, start, element, order)
        except struct.error:
            raise _short(path, element, str(number)) from None
        rows.append(_columns(element, np.frombuffer(data, _row_dtype(element, order, lengths), 1, start), lengths))
        start = end
    result: Columns = {}
    for item in element.properties:
        parts = [row[item.name] for row in rows]
        if item.length:
            counts = np.concatenate([part.counts for part in parts if isinstance(part, Lists)])
            result[item.name] = Lists(counts, np.concatenate([p.values for p in parts if isinstance(p, Lists)]))
        else:
            result[item.name] = np.concatenate([part for part in parts if not isinstance(part, Lists)])
    return result, start


def write_ply(path: Path, vertex: Mapping[str, np.ndarray], faces: np.ndarray | None = None) -> None:
    """Binary little-endian ply of vertex properties (n,) and, if given, triangles (f, 3)."""
    n = len(next(iter(vertex.values())))
    with path.open("wb") as handle:
        handle.write(_header_text(n, vertex, 0 if faces is None else len(faces), faces is not None))
        for start in range(0, n, SLICE):
            vertex_rows({name: values[start : start + SLICE] for name, values in vertex.items()}).tofile(handle)
        if faces is not None:
            triangles = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", (3,))])
            triangles["count"], triangles["corners"] = 3, faces
            triangles.tofile(handle)


def _header_text(n: int, vertex: Mapping[str, np.ndarray], faces: int, with_faces: bool) -> bytes:
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property {NAMES[values.dtype.str[1:]]} {name}" for name, values in vertex.items()]
    if with_faces:
        header += [f"element face {faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii", "replace")


def vertex_header(n: int, vertex: Mapping[str, np.ndarray]) -> bytes:
    """The header of a ply of n vertices with such properties, whose rows follow (`vertex_rows`)."""
    return _header_text(n, vertex, 0, False)


def vertex_rows(vertex: Mapping[str, np.ndarray]) -> np.ndarray:
    """Vertex properties (n,) as rows of a binary file, (n,) structured."""
    rows = np.empty(len(next(iter(vertex.values()))), [(name, v.dtype.newbyteorder("<")) for name, v in vertex.items()])
    for name, values in vertex.items():
        rows[name] = values
    return rows


def ply_slices(path: Path, rows: int) -> Iterator[dict[str, np.ndarray]]:
    """Columns of the vertices of a binary file, `rows` at a time, in their order; lists of a vertex are left out.

    `ValueError` for text, lists of several lengths, and what `read_ply` refuses.
    """
    data = _mapped(path)
    order, elements, start = _header(path, data)
    if order is None:
        raise ValueError(f"{path}: is a ply in text, which is not read in slices; save it in binary")
    for element in elements:
        if element.name != "vertex":
            start = _skip(path, data, start, element, order)
            continue
        if not _fits(path, data, start, element):
            return
        dtype = _row_dtype(element, order, _row_lengths(data, start, element, order)[0])
        if any(item.length for item in element.properties):
            raise ValueError(f"{path}: its vertices hold lists, which are not read in slices; save it without")
        if element.size * dtype.itemsize > len(data) - start:
            raise _short(path, element, f"{(len(data) - start) // dtype.itemsize}")
        for first in range(0, element.size, rows):
            # read, not mapped: what has been looked at of a mapped file counts as memory
            part = np.fromfile(path, dtype, min(rows, element.size - first), offset=start + first * dtype.itemsize)
            yield {item.name: part[item.name].astype(item.type) for item in element.properties}
        return
