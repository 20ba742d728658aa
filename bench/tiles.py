"""Clouds in tiles: time and peak memory of `pnu upsample memory=` over the size of a simulated airborne scan (Linux).

    python -m bench.tiles --points 100000 300000 1000000 --memory 1500MiB
    python -m bench.tiles --calibrate 20000 60000 180000      # what a point of a tile takes, for pnu/commands/_tiles.py

The table goes to outputs/bench/tiles.md. A scan is written a slice at a time, so it may be larger than memory.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.__main__ import facts
from pnu.io import atomic_path

DENSITY = 8.0  # points in a square meter, of all lines together
HEIGHT, HALF = 500.0, np.radians(20)  # of flight, and of the scanner's field of view
OVERLAP = 0.3  # of two lines beside each other
NOISE = 0.02  # meters
BLOCK = 40.0  # meters from one house to the next
SLICE = 2**18
PLACE = np.array([4.1e5, 5.3e6, 0.0])  # as map coordinates are


class Measured(NamedTuple):
    """One size."""

    points: int
    made: int
    tiles: int
    seconds: float
    processor_seconds: float
    peak_gib: float
    output_gib: float


def heights(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of hills with houses on them, flat and gabled, at places (n,) in meters."""
    ground = 12 * np.sin(x / 90) * np.cos(y / 130) + 3 * np.sin(x / 17 + y / 29)
    u, v = x / BLOCK, y / BLOCK
    row, column = np.floor(u), np.floor(v)
    kind = np.abs(np.sin(12.9898 * row + 78.233 * column)) * 43758.5453 % 1
    s, t = np.abs(u - row - 0.5), np.abs(v - column - 0.5)
    house = (s < 0.18) & (t < 0.12 + 0.1 * kind) & (kind > 0.3)
    base = 12 * np.sin((row + 0.5) * BLOCK / 90) * np.cos((column + 0.5) * BLOCK / 130)
    roof = base + 7 + 4 * kind + np.where(kind > 0.6, BLOCK * (0.18 - s), 0)
    found: np.ndarray = np.where(house, np.maximum(roof, ground), ground)
    return found


def flight_lines(n: int) -> Iterator[tuple[np.ndarray, np.ndarray, int]]:
    """A scan of n points in slices: points (k, 3), angles in degrees (k,), number of the line.

    Lines along x side by side, each swept from side to side: dense in the middle, and twice in the overlap.
    """
    swath = 2 * HEIGHT * np.tan(HALF)
    side = (n / DENSITY) ** 0.5
    lines = max(1, round(side / (swath * (1 - OVERLAP))))
    swath = min(swath, side)
    rng = np.random.default_rng(n)
    each = np.diff(np.round(np.linspace(0, n, lines + 1)).astype(int))
    for line, count in enumerate(each):
        sweeps = max(1, round((count * side / swath) ** 0.5))
        for start in range(0, count, SLICE):
            number = np.arange(start, min(start + SLICE, count))
            sweep = number * sweeps / count
            angle = np.arctan(swath / 2 / HEIGHT) * (4 * np.abs(sweep % 1 - 0.5) - 1)
            x = side * sweep / sweeps + 0.02 * rng.standard_normal(len(number))
            y = side * (line + 0.5) / lines + HEIGHT * np.tan(angle) + 0.02 * rng.standard_normal(len(number))
            z = heights(x, y) + NOISE * rng.standard_normal(len(number))
            yield np.column_stack([x, y, z]) + PLACE, np.degrees(angle), line


def write_scan(path: Path, n: int) -> None:
    """The scan as las, with angles and intensities."""
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.offsets, header.scales = PLACE, np.full(3, 0.001)
    with laspy.open(path, mode="w", header=header) as file:
        for points, angle, line in flight_lines(n):
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.T
            record["scan_angle"] = np.rint(angle / 0.006)
            record["return_number"] = record["number_of_returns"] = np.ones(len(points), np.uint8)
            record["intensity"] = 1000 + 100 * (points[:, 2] % 7)
            record["point_source_id"] = np.full(len(points), line, np.uint16)
            file.write_points(record)


def measured(n: int, folder: Path, ratio: float, memory: str, threads: int, keep: bool) -> Measured:
    """`pnu upsample` of a scan of n points in a process of its own."""
    scan, dense = folder / f"scan_{n}.las", folder / f"dense_{n}.las"
    if not scan.is_file():
        with atomic_path(scan) as temporary:
            write_scan(temporary, n)
    command = [sys.executable, "-m", "pnu", "upsample", f"input={scan}", f"output={dense}", f"ratio={ratio:g}"]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    started = time.perf_counter()
    with subprocess.Popen([*command, f"memory={memory}"], stdout=subprocess.PIPE, text=True, env=environment) as child:
        assert child.stdout is not None
        text = child.stdout.read()
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {child.returncode}")
    print(text, flush=True)
    tiles = int(text.split("tiles:")[1].split(",")[0])
    found = Measured(
        n, round(ratio * n), tiles, time.perf_counter() - started, usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss / 2**20, dense.stat().st_size / 2**30,
    )  # fmt: skip
    if not keep:
        scan.unlink()
        dense.unlink()
    return found


def table(found: list[Measured], memory: str) -> str:
    """As Markdown, with how time grows."""
    lines = [
        f"memory={memory}",
        "",
        "| points | made | tiles | s | processors, s | peak memory, GiB |",
        "|" + "---|" * 6,
    ]
    for one in found:
        times = f"{one.seconds:.0f} | {one.processor_seconds:.0f} | {one.peak_gib:.2f}"
        lines.append(f"| {one.points} | {one.made} | {one.tiles} | {times} |")
    if len(found) > 1:
        sizes, used = np.log([one.points for one in found]), np.log([one.processor_seconds for one in found])
        lines += ["", f"processor time grows with the points to the power {np.polyfit(sizes, used, 1)[0]:.2f}"]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.tiles", description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[100_000, 300_000], help="of the scans")
    parser.add_argument("--calibrate", type=int, nargs="+", help="sizes of a single tile each, in 64 GiB")
    parser.add_argument("--ratio", type=float, default=4)
    parser.add_argument("--memory", default="1500MiB", help="as of the command")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keep", action="store_true", help="scans and dense clouds in the folder")
    parser.add_argument("--folder", type=Path, default=Path("outputs/bench"))
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    memory = "64GiB" if given.calibrate else given.memory
    found = []
    for n in given.calibrate or given.points:
        found.append(measured(n, given.folder, given.ratio, memory, given.threads, given.keep))
        print(found[-1], flush=True)
    text = "; ".join(f"{key}: {value}" for key, value in facts().items()) + "\n\n" + table(found, memory)
    with atomic_path(given.folder / ("calibrated.md" if given.calibrate else "tiles.md")) as path:
        path.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
