"""Point Cloud Library's format: text, binary, and binary compressed (LZF)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pnu.io.shift import read_shift
from pnu.io.text import table

KINDS = {"I": "i", "U": "u", "F": "f"}
HEAD = 2**20  # bytes at most before the points
UNSAID = (0, 0, 0, 1, 0, 0, 0)  # VIEWPOINT of programs that know of no sensor: place and quaternion


def read_pcd(path: Path) -> dict[str, np.ndarray]:
    """Fields by name, (n,) or (n, count); x y z as float64 with the shift that a comment of the header names."""
    data = path.read_bytes()
    header, start = _header(path, data)
    shift = read_shift(data[:start].decode("ascii", "replace"))
    names = header["FIELDS"]
    try:
        sizes = [int(word) for word in header["SIZE"]]
        counts = [int(word) for word in header.get("COUNT", ["1"] * len(names))]
        kinds = [KINDS[word.upper()] for word in header["TYPE"]]
        points = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        fields = list(zip(kinds, sizes, counts, strict=True))
        repeated = any(names.count(name) > 1 for name in names if name != "_")
        if repeated or len(names) != len(fields) or points < 0 or min(counts) < 0:
            raise ValueError
        if max(counts) > len(data):  # and numpy would overflow
            raise ValueError
        dtype = np.dtype([(f"{i}", f"<{kind}{size}", (count,)) for i, (kind, size, count) in enumerate(fields)])
    except (ValueError, KeyError, TypeError, IndexError):
        raise ValueError(
            f"{path}: FIELDS, SIZE, TYPE, COUNT and POINTS of the header disagree; save it again"
        ) from None
    mode = header["DATA"][0].lower()
    if mode == "ascii":
        columns = _text(path, data[start:], points, dtype)
    elif mode == "binary":
        if points * dtype.itemsize > len(data) - start:
            raise _short(path, points * dtype.itemsize, len(data) - start)
        if data[start + points * dtype.itemsize :].strip(b"\0\r\n\t "):
            raise _long(path, points, f"{len(data) - start - points * dtype.itemsize} bytes")
        rows = np.frombuffer(data, dtype, points, start) if points else np.empty(0, dtype)
        columns = [rows[name] for name in dtype.names or ()]
    elif mode == "binary_compressed":
        columns = _compressed(path, data, start, points, dtype)
    else:
        raise ValueError(f"{path}: DATA is '{mode[:30]}'; expected ascii, binary or binary_compressed")
    found = {
        name: np.ascontiguousarray(column[:, 0] if column.shape[1] == 1 else column)
        for name, column in zip(names, columns, strict=True)
        if name != "_" and column.shape[1]  # padding
    }
    if shift is not None:
        found |= {axis: found[axis] + by for axis, by in zip("xyz", shift, strict=True) if axis in found}
    return found


def read_viewpoint(path: Path) -> np.ndarray | None:
    """Place of the sensor, (3,), with the shift that a comment names; None where the header has the usual zeros."""
    with path.open("rb") as file:
        data = file.read(HEAD)
    header, start = _header(path, data)
    try:
        pose = np.array([float(word) for word in header.get("VIEWPOINT", [])])
    except ValueError:
        return None
    if len(pose) != 7 or not np.isfinite(pose).all() or (pose == UNSAID).all():
        return None
    shift = read_shift(data[:start].decode("ascii", "replace"))
    return pose[:3] if shift is None else pose[:3] + shift


def _header(path: Path, data: bytes) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start)
        if end < 0 or end - start > 100_000:
            raise ValueError(f"{path}: expected a pcd header up to a DATA line, found none; is it another format?")
        words = data[start:end].decode("ascii", "replace").split("#")[0].split()
        start = end + 1
        if words:
            header[words[0].upper()] = words[1:]
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "DATA") if not header.get(key)]
    if missing or not (header.get("POINTS") or (header.get("WIDTH") and header.get("HEIGHT"))):
        raise ValueError(f"{path}: the pcd header lacks {' '.join(missing) or 'POINTS'}; save the file again")
    return header, start


def _short(path: Path, promised: int, found: int) -> ValueError:
    return ValueError(
        f"{path}: the header promises {promised} bytes of points, the file holds {found}; it is cut off, copy it again"
    )


def _long(path: Path, points: int, more: str) -> ValueError:
    return ValueError(
        f"{path}: goes on after the last point, with {more} more than the {points} points that the header promises; "
        "correct POINTS, WIDTH and HEIGHT there, or save it again"
    )


def _text(path: Path, body: bytes, points: int, dtype: np.dtype) -> list[np.ndarray]:
    lines = [line for line in body.decode("ascii", "replace").splitlines() if line.strip()]
    if len(lines) < points:
        raise ValueError(
            f"{path}: the header promises {points} points, the file holds {len(lines)}; it is cut off, copy it again"
        )
    if len(lines) > points:
        raise _long(path, points, f"{len(lines) - points} lines")
    values = table(path, lambda: lines)
    widths = [dtype[i].shape[0] for i in range(len(dtype.names or ()))]
    if not points:
        values = np.empty((0, sum(widths)))
    if values.shape != (points, sum(widths)):
        raise ValueError(f"{path}: the header names {sum(widths)} columns, the lines have {values.shape[1]}")
    columns = np.split(values, np.cumsum(widths)[:-1], axis=1)
    return [column.astype(dtype[i].base) for i, column in enumerate(columns)]


def _compressed(path: Path, data: bytes, start: int, points: int, dtype: np.dtype) -> list[np.ndarray]:
    """Two sizes, then all of field 0, all of field 1, ... compressed together."""
    packed, size = (int.from_bytes(data[start + i : start + i + 4], "little") for i in (0, 4))
    body = data[start + 8 : start + 8 + packed]
    # A LZF reference of 3 bytes makes at most 264.
    if len(body) < packed or size != points * dtype.itemsize or size > 264 * packed:
        raise _short(path, points * dtype.itemsize, len(data) - start - 8)
    try:
        flat = decompress_lzf(body, size)
    except IndexError:
        flat = b""
    if len(flat) != size:
        raise ValueError(f"{path}: the compressed points are damaged; copy the file again")
    columns, position = [], 0
    for i in range(len(dtype.names or ())):
        count = points * dtype[i].shape[0]
        column = np.frombuffer(flat, dtype[i].base, count, position) if count else np.empty(0, dtype[i].base)
        columns.append(column.reshape(points, -1))
        position += column.nbytes
    return columns


def decompress_lzf(data: bytes, size: int) -> bytes:
    """LZF: runs of literals, and references (length, distance back) to what came out before."""
    out = bytearray()
    position = 0
    while position < len(data) and len(out) <= size:
        control = data[position]
        position += 1
        if control < 32:
            out += data[position : position + control + 1]
            position += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[position]
            position += 1
        start = len(out) - ((control & 31) << 8 | data[position]) - 1
        position += 1
        length += 2
        if start < 0:
            raise IndexError("reference before the start")
        while length > 0:  # a reference may reach into what it writes itself
            part = out[start : start + length]
            out += part
            start, length = start + len(part), length - len(part)
    return bytes(out)


def write_pcd(path: Path, fields: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> None:
    """Binary pcd of fields (n,) or (n, count)."""
    columns = {name: values.reshape(len(values), -1) for name, values in fields.items()}
    dtype = np.dtype([(name, v.dtype.newbyteorder("<"), (v.shape[1],)) for name, v in columns.items()])
    rows = np.empty(len(next(iter(columns.values()))), dtype)
    for name, values in columns.items():
        rows[name] = values
    header = [
        *(f"# {comment}" for comment in comments),
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(v.dtype.itemsize) for v in columns.values()),
        "TYPE " + " ".join(v.dtype.kind.upper() for v in columns.values()),
        "COUNT " + " ".join(str(v.shape[1]) for v in columns.values()),
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        "DATA binary",
    ]
    with path.open("wb") as handle:
        handle.write(("\n".join(header) + "\n").encode("ascii", "replace"))
        rows.tofile(handle)
