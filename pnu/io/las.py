"""Lidar exchange format, las and compressed laz, a slice at a time; needs laspy: pip install 'pnu[las]'."""

import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pnu.extras import needed
from pnu.io import las_child
from pnu.io.fields import GEOGRAPHIC, XYZ, distinct_names

SLICE = 2**20  # points
SLICE_BYTES = 2**28  # at most, whatever size of a point a header claims
MOST = 100  # points that a byte of laz may hold: bounds what a damaged header makes us allocate
NORMAL = ("nx", "ny", "nz")  # extra dimensions
CARRIED = ("intensity", "classification", "gps_time", "point_source_id")
PULSES = (  # of the pulse that a point is from, or of how the file was made: no sense between points
    *("return_number", "number_of_returns", "scan_angle", "scan_angle_rank", "scan_direction_flag", "user_data"),
    *("edge_of_flight_line", "scanner_channel", "synthetic", "key_point", "withheld", "overlap"),
)
OBLIQUE = 75  # degrees from straight down: more than scanners look sideways from the air
RANK = 0.006  # degrees in a step of scan_angle; those of scan_angle_rank, in older formats, are whole ones
POINTWISE = b"\1\0"  # compressor of a laz without chunks
MODEL_TYPE = 1024  # geo key: 1 projected, 2 geographic
FOREIGN = "pnu "  # before the name of a scalar that las has, but not with such values
COLORS = ("red", "green", "blue")
LONGEST = 32 - len(FOREIGN)  # bytes of a name
Content = tuple[np.ndarray, np.ndarray | None, dict[str, np.ndarray], tuple[str, ...]]


def _laspy(path: Path) -> ModuleType:
    with needed(f"{path}: reading and writing las"):
        import laspy
    module: ModuleType = laspy
    return module


def read_las(path: Path, pulses: bool = False) -> Content:
    """Points (n, 3) float64, normals if there are, colors, intensity, class, time, source and extra scalars, notes.

    pulses: also what belongs to the pulse: number of returns, scan angle ...
    """
    laspy = _laspy(path)
    try:
        _check_counts(path)
        with laspy.open(path) as file:
            if file.header.point_count > MOST * path.stat().st_size:
                raise ValueError(f"its header promises {file.header.point_count} points, more than it has room for")
            notes = (GEOGRAPHIC,) if _geographic(file.header) else ()
            standard = (*CARRIED, *PULSES) if pulses else CARRIED
            return (*_content(file.header, _slices(laspy, path, file), standard), notes)
    except Exception as error:  # laspy and its decompressors know many kinds
        raise _damaged_las(path, error) from None


def las_slices(path: Path, rows: int) -> Iterator[tuple[np.ndarray, np.ndarray | None, dict[str, np.ndarray]]]:
    """Points, normals and attributes of `rows` points at a time, in the order of the file.

    Attributes that are zero all over the file are among them, and colors have 16 bits, as they are found.
    """
    laspy = _laspy(path)
    try:
        _check_counts(path)
        with laspy.open(path) as file:
            done, promised = 0, file.header.point_count
            known = set(file.header.point_format.dimension_names)
            names = [*CARRIED, *file.header.point_format.extra_dimension_names]
            names = [name for name in names if name in known and name not in NORMAL and FOREIGN + name not in known]
            for chunk in _slices(laspy, path, file, rows):
                points = np.stack([chunk.x, chunk.y, chunk.z], 1)
                normals = np.stack([chunk[name] for name in NORMAL], 1) if known.issuperset(NORMAL) else None
                attributes = {name.removeprefix(FOREIGN): np.asarray(chunk[name]) for name in names}
                if known.issuperset(COLORS):
                    attributes["colors"] = np.stack([chunk[name] for name in COLORS], 1)
                yield points, normals, attributes
                done += len(points)
            if done < promised:
                raise ValueError(f"the header promises {promised} points, the file holds {done}")
    except GeneratorExit:
        raise
    except Exception as error:
        raise _damaged_las(path, error) from None


def las_is_geographic(path: Path) -> bool:
    """Whether the coordinate system of a file has degrees for x and y."""
    with _laspy(path).open(path) as file:
        return _geographic(file.header)


def _damaged_las(path: Path, error: Exception) -> Exception:
    if isinstance(error, ValueError) and str(error).startswith(f"{path}: is compressed"):
        return error
    reason = (str(error).splitlines() or [""])[0][:80]
    return ValueError(f"{path}: is no las file that can be read ({reason}); export it again")


def is_from_the_air(path: Path) -> bool:
    """Whether pulses had several returns, or were sent at angles as from above: scanners on the ground look around."""
    laspy = _laspy(path)
    with laspy.open(path) as file:
        first = next(_slices(laspy, path, file), None)
        if first is None:
            return False
        known = set(file.header.point_format.dimension_names)
        angle = (
            np.asarray(first["scan_angle"]) * RANK if "scan_angle" in known else np.asarray(first["scan_angle_rank"])
        )
        steepest = float(np.abs(angle.astype(np.float64)).max())
        return steepest <= OBLIQUE and (steepest > 0 or int(np.asarray(first["number_of_returns"]).max()) > 1)


def _check_counts(path: Path) -> None:
    """`ValueError` where the header counts more records than the file has room for: laspy would read on for hours."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if head[:4] != b"LASF" or len(head) < 227:
        raise ValueError("it does not begin with a las header")
    records = 54 * struct.unpack_from("<I", head, 100)[0]
    if head[24:26] == b"\x01\x04" and len(head) == 375:
        records += 60 * struct.unpack_from("<I", head, 243)[0]
    if records > size:
        raise ValueError("its header counts more records than it has room for")


def _slices(laspy: ModuleType, path: Path, file: Any, most: int = SLICE) -> Iterator[Any]:
    """The points of an open file; compressed ones from a child process, which may crash without loss."""
    header = file.header
    kind = header.point_format.dtype()
    rows = max(1, min(most, SLICE_BYTES // kind.itemsize))
    if not header.are_points_compressed:
        yield from file.chunk_iterator(rows)
        return
    for record in header.vlrs:
        if type(record).__name__ == "LasZipVlr" and record.record_data_bytes()[:2] == POINTWISE:
            raise ValueError(
                f"{path}: is compressed in one piece, as by laszip 1, which lazrs cannot read; decompress it with "
                f"laszip or las2las, or compress it anew: las2las -i {path.name} -o new.laz"
            )
    command = [sys.executable, "-I", las_child.__file__, str(path), str(rows)]
    environment = os.environ | {"RUST_BACKTRACE": "0"}
    with (
        tempfile.TemporaryFile() as said,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said, env=environment) as child,
    ):
        assert child.stdout is not None
        while data := child.stdout.read(rows * kind.itemsize):
            records = np.frombuffer(data, kind, len(data) // kind.itemsize).copy()
            yield laspy.ScaleAwarePointRecord(records, header.point_format, header.scales, header.offsets)
        if child.wait():
            said.seek(0)
            raise ValueError(
                said.read().decode(errors="replace").strip() or f"its decompressor ended with {child.returncode}"
            )


def _geographic(header: Any) -> bool:
    """Whether its coordinate system has degrees for x and y: by its geo keys, or by its text (WKT)."""
    for record in header.vlrs:
        for key in getattr(record, "geo_keys", None) or []:
            if key.id == MODEL_TYPE and key.tiff_tag_location == 0:
                return bool(key.value_offset == 2)
        text = str(getattr(record, "string", "") or "").lstrip("\0 \n").upper()
        if text.startswith(("GEOGCS", "GEOGCRS", "GEODCRS", "GEOGRAPHICCRS")):
            return True
        if text.startswith("COMPD_CS") or text.startswith("COMPOUNDCRS"):
            return "PROJCS" not in text and "PROJCRS" not in text
    return False


def _content(
    header: Any, slices: Iterator[Any], standard: Sequence[str]
) -> tuple[np.ndarray, np.ndarray | None, dict[str, np.ndarray]]:
    n = header.point_count
    known = set(header.point_format.dimension_names)
    extra = [name for name in header.point_format.extra_dimension_names if name not in NORMAL]
    points = np.empty((n, 3))
    normals = np.empty((n, 3)) if known.issuperset(NORMAL) else None
    colors = np.empty((n, 3), np.uint16) if known.issuperset(COLORS) else None
    columns: dict[str, np.ndarray] = {}
    done = 0
    for chunk in slices:
        part = slice(done, done + len(chunk))
        points[part] = np.stack([chunk.x, chunk.y, chunk.z], 1)
        if normals is not None:
            normals[part] = np.stack([chunk[name] for name in NORMAL], 1)
        if colors is not None:
            colors[part] = np.stack([chunk[name] for name in COLORS], 1)
        for name in [*(name for name in standard if name in known and FOREIGN + name not in known), *extra]:
            values = np.asarray(chunk[name])
            if name not in columns:
                columns[name] = np.zeros((n, *values.shape[1:]), values.dtype)
            columns[name][part] = values
        done += len(chunk)
    if done < n:
        raise ValueError(f"the header promises {n} points, the file holds {done}")
    attributes = {name.removeprefix(FOREIGN): v for name, v in columns.items() if name in extra or v.any()}
    if colors is not None and colors.any():
        attributes["colors"] = (colors if colors.max() < 256 else colors >> 8).astype(np.uint8)
    return points, normals, attributes


def _fits(dimension: Any, values: np.ndarray) -> bool:
    """Whether a dimension of the format holds these values as they are; some have a few bits only."""
    if values.ndim > 1:
        return False
    if dimension.dtype is None or dimension.num_bits < 8:
        return bool(
            (values >= 0).all() and (values < 2**dimension.num_bits).all() and (values == values.astype(int)).all()
        )
    return bool(np.array_equal(values.astype(dimension.dtype), values))


def write_las(
    path: Path, points: np.ndarray, normals: np.ndarray | None, attributes: Mapping[str, np.ndarray]
) -> dict[str, str]:
    """Coordinates to a billionth of the extent; normals and scalars that las does not know as extra dimensions.

    Returns under which name each attribute was written.
    """
    with las_writer(path, points.min(0), points.max(0), normals is not None, attributes) as (names, write):
        for start in range(0, len(points), SLICE):
            part = slice(start, start + SLICE)
            some = {name: values[part] for name, values in attributes.items()}
            write(points[part], None if normals is None else normals[part], some)
    return names


@contextmanager
def las_writer(
    path: Path, low: np.ndarray, high: np.ndarray, normals: bool, attributes: Mapping[str, np.ndarray]
) -> Iterator[tuple[dict[str, str], Callable[[np.ndarray, np.ndarray | None, Mapping[str, np.ndarray]], None]]]:
    """A file that takes points a part at a time: write(points, normals, attributes); and the names of attributes.

    low, high: corners of the box of all points. attributes: all of them, or a part that says what they are like: values
    that their dimension of las cannot hold go into one of its own.
    """
    laspy = _laspy(path)
    names = distinct_names([name for name in attributes if name != "colors"], (*XYZ, *NORMAL, *COLORS), length=LONGEST)
    header = laspy.LasHeader(version="1.4", point_format=7 if "colors" in attributes else 6)
    header.offsets = np.floor(low)
    extent = max(float((high - header.offsets).max()), 1e-9)
    header.scales = np.full(3, 10 ** np.ceil(np.log10(extent / 2**31 * 1.001)))
    known = {dimension.name: dimension for dimension in header.point_format.dimensions}
    ranked = "scan_angle_rank" in names and "scan_angle" not in names
    if ranked:
        names["scan_angle_rank"] = "scan_angle"

    def turned(given: str, values: np.ndarray) -> np.ndarray:
        return np.rint(values / RANK).clip(-30000, 30000) if ranked and given == "scan_angle_rank" else values

    columns, extra = {}, []
    for given, values in attributes.items():
        if given != "colors":
            name, values = names[given], turned(given, np.asarray(values))
            column = name if name not in known or _fits(known[name], values) else FOREIGN + name
            columns[given] = column
            if column not in known:
                width = f"{values.shape[1] if values.ndim > 1 else ''}{values.dtype}"
                extra.append(laspy.ExtraBytesParams(name=column, type=width))
    extra += [laspy.ExtraBytesParams(name=name, type="float32") for name in NORMAL if normals]
    header.add_extra_dims(extra)
    try:
        with laspy.open(path, mode="w", header=header, do_compress=path.suffix.lower() == ".laz") as file:

            def write(points: np.ndarray, directions: np.ndarray | None, values: Mapping[str, np.ndarray]) -> None:
                record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
                record.x, record.y, record.z = points.T
                for given, column in columns.items():
                    record[column] = turned(given, np.asarray(values[given]))
                if directions is not None:
                    for name, part in zip(NORMAL, directions.astype(np.float32).T, strict=True):
                        record[name] = part
                if "colors" in values:
                    for name, part in zip(COLORS, values["colors"].T, strict=False):
                        record[name] = part.astype(np.uint16) * 257
                file.write_points(record)

            yield names, write
    except RuntimeError as error:  # of the compressor, where the disk is full
        raise OSError(str(error)) from error
