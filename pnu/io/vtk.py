"""Visualization Toolkit: legacy files (vtk) in text or binary, and polygons in XML (vtp)."""

import base64
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

KINDS = {
    **{"float": "f4", "double": "f8", "int": "i4", "unsigned_int": "u4", "short": "i2", "unsigned_short": "u2"},
    **{"char": "i1", "unsigned_char": "u1", "long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8"},
    **{"vtkidtype": "i8", "vtktypeint32": "i4", "vtktypeuint8": "u1"},
}
XML_KINDS = {
    f"{name}{8 * size}": f"{kind}{size}" for name, kind in (("Int", "i"), ("UInt", "u")) for size in (1, 2, 4, 8)
}
XML_KINDS |= {"Float32": "f4", "Float64": "f8"}
PACKED = 1100  # times that zlib makes data smaller, at most


class Content(NamedTuple):
    """vertices (v, 3); counts (p,) and corners of polygons, in a row; columns (v,) or (v, k) by name."""

    vertices: np.ndarray
    counts: np.ndarray
    corners: np.ndarray
    columns: dict[str, np.ndarray]


def read_vtk(path: Path) -> Content:
    """Points, polygons and values of points; other cells and values of cells are left out."""
    try:
        content = _xml(path) if path.suffix.lower() == ".vtp" else _legacy(path)
    except (ValueError, KeyError, IndexError, TypeError, OverflowError, zlib.error, ElementTree.ParseError) as error:
        reason = " ".join(str(error).split())[:80]
        raise ValueError(f"{path}: is no {path.suffix[1:]} file that can be read ({reason}); save it as ply") from None
    return content


def _polygons(offsets: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts and corners of cells that end at `offsets`."""
    counts = np.diff(offsets, prepend=0)
    if len(counts) and (counts.min() < 0 or offsets[-1] != len(corners)):
        raise ValueError("offsets and corners of its polygons disagree")
    return counts, corners


# Legacy


class _Body:
    """Words and arrays of a legacy file, one after the other."""

    def __init__(self, data: bytes, start: int, binary: bool) -> None:
        self.data, self.at, self.binary = data, start, binary

    def line(self) -> list[str]:
        """Words of the next line with content, none at the end."""
        while self.at < len(self.data):
            end = self.data.find(b"\n", self.at)
            end = len(self.data) if end < 0 else end
            words = self.data[self.at : min(end, self.at + 1000)].decode("ascii", "replace").split()
            self.at = end + 1
            if words:
                return words
        return []

    def array(self, kind: str, count: int) -> np.ndarray:
        if not 0 <= count <= len(self.data):
            raise ValueError(f"it promises {count} numbers, more than it has room for")
        if self.binary:
            code = np.dtype(">" + KINDS[kind.lower()])
            values = np.frombuffer(self.data, code, count, self.at)
            self.at += values.nbytes
            return values.astype(code.newbyteorder("="))
        found: list[str] = []
        while len(found) < count:
            words = self.line()
            if not words:
                raise ValueError(f"it promises {count} numbers, and ends after {len(found)}")
            found += words
        if len(found) > count:
            raise ValueError(f"{len(found)} numbers where {count} were expected")
        return np.array(found, np.float64).astype(KINDS[kind.lower()])


def _legacy(path: Path) -> Content:
    data = path.read_bytes()
    head = data[:1000].split(b"\n", 3)
    if (
        len(head) < 4
        or not head[0].lower().startswith(b"# vtk datafile")
        or head[2].strip() not in (b"ASCII", b"BINARY")
    ):
        raise ValueError("it does not begin with '# vtk DataFile', a title, and ASCII or BINARY")
    body = _Body(data, sum(len(line) + 1 for line in head[:3]), head[2].strip() == b"BINARY")
    vertices, counts, corners = np.empty((0, 3)), np.empty(0, np.int64), np.empty(0, np.int64)
    columns: dict[str, np.ndarray] = {}
    of_points, count = False, 0
    while words := body.line():
        key, rest = words[0].upper(), words[1:]
        if key == "DATASET" and rest[0].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise ValueError(f"it holds {rest[0]}; expected POLYDATA")
        if key == "POINTS":
            vertices = body.array(rest[1], 3 * int(rest[0])).reshape(-1, 3).astype(np.float64)
        elif key in ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS"):
            first, second = int(rest[0]), int(rest[1])
            found = _legacy_cells(body, first, second)
            if key == "POLYGONS":
                counts, corners = found
        elif key == "CELL_TYPES":
            body.array("int", int(rest[0]))
        elif key in ("POINT_DATA", "CELL_DATA"):
            of_points = key == "POINT_DATA"
            count = int(rest[0])
        elif key in ("NORMALS", "VECTORS"):
            _keep(columns, rest[0], body.array(rest[1], 3 * count).reshape(-1, 3), of_points)
        elif key == "COLOR_SCALARS":
            kind = "unsigned_char" if body.binary else "float"
            _keep(columns, "colors", body.array(kind, count * int(rest[1])).reshape(count, -1), of_points)
        elif key == "SCALARS":
            width = int(rest[2]) if len(rest) > 2 else 1
            before = body.at
            if body.line()[0].upper() != "LOOKUP_TABLE":
                body.at = before
            _keep(columns, rest[0], body.array(rest[1], count * width).reshape(count, -1), of_points)
        elif key == "FIELD":
            for _ in range(min(int(rest[1]), 1000)):
                name, columns_of, rows, kind = body.line()
                values = body.array(kind, int(columns_of) * int(rows)).reshape(int(rows), -1)
                _keep(columns, name, values, of_points and len(values) == len(vertices))
        elif key == "METADATA":
            end = data.find(b"\n\n", body.at)
            body.at = len(data) if end < 0 else end
        elif key == "LOOKUP_TABLE":
            body.array("unsigned_char" if body.binary else "float", 4 * int(rest[1]))
        elif key != "DATASET":
            raise ValueError(f"'{words[0][:30]}' is no section of it")
    return Content(vertices, counts, corners, columns)


def _legacy_cells(body: _Body, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
    """Counts and corners: of version 5 as offsets and connectivity, before as a count before each cell's corners."""
    before = body.at
    words = body.line()
    if words and words[0].upper() == "OFFSETS":
        offsets = body.array(words[1], first).astype(np.int64)
        words = body.line()
        return _polygons(offsets[1:], body.array(words[1], second).astype(np.int64))
    body.at = before
    flat = body.array("int", second).astype(np.int64).tolist()
    counts, corners, at = [], [], 0
    for _ in range(min(first, second)):
        counts.append(flat[at])
        corners += flat[at + 1 : at + 1 + max(flat[at], 0)]
        at += 1 + max(flat[at], 0)
    if sum(counts) != len(corners) or min(counts, default=0) < 0:
        raise ValueError("sizes and corners of its polygons disagree")
    return np.array(counts, np.int64), np.array(corners, np.int64)


def _keep(columns: dict[str, np.ndarray], name: str, values: np.ndarray, of_points: bool) -> None:
    if of_points:
        columns[name] = values[:, 0] if values.shape[1] == 1 else values


# XML


def _xml(path: Path) -> Content:
    data = path.read_bytes()
    if b"<!" in re.sub(rb"<!--.*?-->", b"", data[:5000], flags=re.S):
        raise ValueError("it defines entities")
    found = re.search(rb"<AppendedData[^>]*encoding=\"(\w+)\"[^>]*>\s*_", data)
    appended, raw = b"", False
    if found:
        end = data.rfind(b"</AppendedData>")
        appended, raw = data[found.end() : end], found[1] == b"raw"
        data = data[: found.start()] + b"</VTKFile>"
    root = ElementTree.fromstring(data)
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        raise ValueError("expected <VTKFile type='PolyData'>")
    arrays = _Arrays(root, appended, raw, path.stat().st_size)
    parts = [_piece(piece, arrays) for piece in root.iter("Piece")]
    if not parts:
        raise ValueError("it holds no Piece")
    sizes = [len(part.vertices) for part in parts]
    first = np.cumsum(sizes) - sizes
    names = set.intersection(*(set(part.columns) for part in parts))
    return Content(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.counts for part in parts]),
        np.concatenate([part.corners + start for part, start in zip(parts, first, strict=True)]),
        {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns if name in names},
    )


def _piece(piece: ElementTree.Element, arrays: "_Arrays") -> Content:
    vertices = next((values for _, values in arrays.of(piece.find("Points"))), np.empty((0, 3)))
    cells = dict(arrays.of(piece.find("Polys")))
    none = np.empty(0, np.int64)
    counts, corners = _polygons(
        cells.get("offsets", none).reshape(-1).astype(np.int64),
        cells.get("connectivity", none).reshape(-1).astype(np.int64),
    )
    columns: dict[str, np.ndarray] = {}
    for name, values in arrays.of(piece.find("PointData")):
        if len(values) == len(vertices):
            _keep(columns, name, values, True)
    return Content(vertices.reshape(-1, 3).astype(np.float64), counts, corners, columns)


class _Arrays:
    """The DataArrays of a file."""

    def __init__(self, root: ElementTree.Element, appended: bytes, raw: bool, size: int) -> None:
        self.appended, self.raw, self.size = appended, raw, size
        self.order = ">" if root.get("byte_order") == "BigEndian" else "<"
        self.length = np.dtype(self.order + XML_KINDS[root.get("header_type", "UInt32")])
        compressor = root.get("compressor")
        if compressor not in (None, "vtkZLibDataCompressor"):
            raise ValueError(f"compressed by {compressor}; expected zlib")
        self.packed = compressor is not None

    def of(self, parent: ElementTree.Element | None) -> Iterator[tuple[str, np.ndarray]]:
        for item in parent.findall("DataArray") if parent is not None else ():
            kind = XML_KINDS.get(item.get("type", ""))
            if kind is None:
                continue  # text
            if item.get("format") == "ascii":
                values = np.array((item.text or "").split(), np.float64).astype(kind)
            else:
                values = np.frombuffer(self._bytes(item), np.dtype(self.order + kind)).astype(kind)
            width = int(item.get("NumberOfComponents") or 1)
            yield item.get("Name") or "Points", values.reshape(-1, max(width, 1))

    def _bytes(self, item: ElementTree.Element) -> bytes:
        """Content of an array: a length before it, or, compressed, a table of the lengths of its blocks."""
        if item.get("format") == "appended":
            data = self.appended[int(item.get("offset") or 0) :]
            return self._unpacked(data, self.raw)
        return self._unpacked("".join((item.text or "").split()).encode(), False)

    def _unpacked(self, data: bytes, raw: bool) -> bytes:
        one = self.length.itemsize

        def numbers(count: int) -> np.ndarray:
            size = count * one
            head = data[:size] if raw else base64.b64decode(data[: 4 * -(-size // 3)])[:size]
            return np.frombuffer(head, self.length).astype(np.int64)

        if not self.packed:
            size = int(numbers(1)[0])
            if not 0 <= size <= self.size:
                raise ValueError(f"an array promises {size} bytes, more than there is room for")
            body = (
                data[one : one + size] if raw else base64.b64decode(data[: 4 * -(-(one + size) // 3)])[one : one + size]
            )
            if len(body) < size:
                raise ValueError("an array is cut off")
            return body
        blocks = int(numbers(1)[0])
        if not 0 <= blocks <= self.size:
            raise ValueError(f"an array promises {blocks} blocks, more than there is room for")
        table = numbers(3 + blocks)
        sizes = table[3:]
        start = len(table) * one if raw else 4 * -(-len(table) * one // 3)
        rest = data[start:] if raw else base64.b64decode(data[start:][: 4 * -(-int(sizes.sum()) // 3)])
        if len(sizes) and (sizes.min() < 0 or sizes.sum() > len(rest)):
            raise ValueError("an array is cut off")
        ends = np.cumsum(sizes)
        parts = []
        for begin, end in zip(ends - sizes, ends, strict=True):
            parts.append(zlib.decompressobj().decompress(rest[begin:end], PACKED * int(end - begin) + 1))
        return b"".join(parts)
