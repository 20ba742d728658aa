"""Clouds of any size written a part at a time: ply, npy, las and laz."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from pnu.io.atomic import atomic_path
from pnu.io.las import las_writer
from pnu.io.output import check_output, ply_columns, storable_attributes
from pnu.io.ply import vertex_header, vertex_rows
from pnu.io.shift import single_is_enough

PARTWISE = frozenset({".ply", ".npy", ".las", ".laz"})
Write = Callable[[np.ndarray, np.ndarray, Mapping[str, np.ndarray]], None]
"""write(points (n, 3), normals (n, 3), attributes): the next part."""


def check_partwise(path: str | Path) -> None:
    """`ValueError` where a file of this name cannot be written in parts."""
    check_output(path)
    if Path(path).suffix.lower() not in PARTWISE:
        raise ValueError(
            f"{path}: {Path(path).suffix} is not written in parts, as memory= and tiles= want it; "
            f"take one of {' '.join(sorted(PARTWISE))}"
        )


@contextmanager
def cloud_writer(
    path: str | Path, count: int, low: np.ndarray, high: np.ndarray, attributes: Mapping[str, np.ndarray]
) -> Iterator[Write]:
    """A file that takes `count` points with normals in parts, and appears when all are there.

    low, high: corners of a box around all of them, from which precision follows. attributes: a few rows of each, which
    say what they are like, of those that the format keeps (`kept_attributes`).

    Raises:
        ValueError: another number of points was written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    done = 0
    corners = np.stack([low, high])
    some = storable_attributes(attributes)
    with atomic_path(path) as temporary:
        if suffix in (".las", ".laz"):
            with las_writer(temporary, low, high, True, some) as (_, write):

                def part(points: np.ndarray, normals: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
                    nonlocal done
                    done += len(points)
                    write(points, normals, storable_attributes(values))

                yield part
        else:
            single = single_is_enough(corners)
            with temporary.open("wb") as handle:
                if suffix == ".npy":
                    header = {"descr": "<f8", "fortran_order": False, "shape": (count, 6)}
                    np.lib.format.write_array_header_1_0(handle, header)
                else:
                    none = np.empty((0, 3))
                    handle.write(vertex_header(count, ply_columns(none, none, _few(some, 0), single=single)[0]))

                def part(points: np.ndarray, normals: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
                    nonlocal done
                    done += len(points)
                    if suffix == ".npy":
                        np.hstack([points, normals]).astype("<f8").tofile(handle)
                    else:
                        columns = ply_columns(points, normals, storable_attributes(values), single=single)[0]
                        vertex_rows(columns).tofile(handle)

                yield part
        if done != count:
            raise ValueError(f"{path}: expected {count} points, {done} were written")


def _few(attributes: Mapping[str, np.ndarray], rows: int) -> dict[str, np.ndarray]:
    return {name: values[:rows] for name, values in attributes.items()}
