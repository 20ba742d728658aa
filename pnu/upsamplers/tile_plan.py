"""Clouds larger than memory: cut into tiles, and what all tiles have to agree on.

The points of a file are sorted into tiles, boxes with about as many of them, in files of a folder. A tile is worked on
with a margin of its neighbors' points (`pnu.upsamplers.tile_work`). What a whole cloud decides for all its points is
decided here once, at a few places of it: whether it lies in lines, is noisy, is kept, whose weights it takes, to which
side its normals look. Where sensors don't say that, a coarse cloud of the whole does.
"""

from __future__ import annotations

import hashlib
import math
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu import __version__
from pnu.cleaning import Character, is_noisy, stray_points
from pnu.cleaning.outliers import MANY
from pnu.geometry.anisotropy import thinned_lines
from pnu.geometry.cells import Cells
from pnu.geometry.cloud_normals import (
    contradiction,
    is_height_map,
    normals_on_sides,
    settled_normals,
    sight_from_within,
)
from pnu.geometry.depth_steps import depth_steps, smoothed_within_steps
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.normal_estimation import complete_normals
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import local_spacing
from pnu.geometry.thick_layers import layer_means, layer_noise
from pnu.io import atomic_path, read_json, write_json
from pnu.io.cloud import ORIGIN, UNSEEN, Cloud, first_of_each_place, looks_geographic, unit_normals
from pnu.io.fields import GEOGRAPHIC, as_colors
from pnu.io.point_stream import in_range, is_geographic, point_slices
from pnu.io.scan_columns import scan_numbers
from pnu.io.sensor import Sight, asked_sight, sight_of
from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.poor_axes import poor_axes
from pnu.upsamplers.surface_projection import is_even, shows_noise

SAMPLE = 2**18  # points that say where tiles are cut,
COARSE = 50_000  # and of the coarse cloud that says to which side normals look
PLACES = 16  # at which the cloud is looked at,
BLOCK = 8192  # points each
MARGIN = 12  # spacings that tiles see of their neighbors
SMALLEST = 16  # points of a cloud


class Keys(NamedTuple):
    """What is asked for, as the command's keys of these names say it."""

    input: str
    ratio: float
    spacing: float | None
    density: str
    keep: bool | str
    normals: str
    viewpoint: str | None
    up: str | None
    side: str | None
    columns: str | None
    outliers: str
    lines: str
    noise: str
    run: str


@dataclass
class Facts:
    """What is known of the whole cloud; plain values, kept as JSON."""

    points: int = 0
    """Different points that can be used."""
    sizes: list[int] = field(default_factory=list)
    """Those of each tile."""
    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)
    """Corners of the box around them."""
    notes: list[str] = field(default_factory=list)
    missing: int = 0
    """Points without a normal, where there are normals."""
    given: bool = False
    """Whether the file has normals that are used."""
    brightest: float | None = None
    """The largest number of a color; None: there are no colors."""
    attributes: list[str] = field(default_factory=list)
    lined: float | None = None
    """Distance to which points in lines are thinned out; None: there are no lines."""
    layered: float | None = None
    """Noise of points in a layer thicker than their spacing, which are averaged; None: there is no such layer."""
    steps: float | None = None
    """Width of steps of depth, within which points are smoothed; None: there are none wider than the spacing."""
    smooth: bool = False
    """Whether points are noisy beside their spacing, and smoothed first."""
    keep: bool = False
    character: Character = "clean"
    turned: str = ""
    """Why the sides of given normals are chosen anew; empty: they are not."""
    poor: str = ""
    """Why the axes of given normals are found anew; empty: they are not."""
    heights: bool = False
    """Whether this is a map of heights, seen from above."""
    apart: float = 0.0
    """Spacing where a tenth of the points lie farther apart, after thinning."""

    @property
    def trusted(self) -> bool:
        """Whether the axes of given normals are used."""
        return self.given and not self.poor

    @property
    def margin(self) -> float:
        """How much of its neighbors a tile sees."""
        return MARGIN * self.apart


class Plan:
    """A folder of tiles: their points, and what is known of the whole."""

    def __init__(self, folder: Path, keys: Keys) -> None:
        """Of a folder that `planned` has filled."""
        self.folder, self.keys = folder, keys
        record = read_json(folder / "plan.json")
        self.facts = Facts(**record["facts"])
        with np.load(folder / "cells.npz") as cells:
            self.cells = Cells(*(cells[name] for name in Cells._fields))

    @property
    def tiles(self) -> list[int]:
        """The numbers of the tiles that hold points."""
        return [number for number, size in enumerate(self.facts.sizes) if size]

    def path(self, kind: str, number: int, suffix: str = ".npy") -> Path:
        """The file of a tile."""
        return self.folder / f"{kind}_{number:05}{suffix}"

    def records(self, number: int) -> NDArray[Any]:
        """The points of a tile, structured (n,): point, normal where there are, attributes."""
        return np.asarray(np.load(self.path("points", number)))

    def region(self, number: int, kind: str = "points", margin: float | None = None) -> NDArray[Any]:
        """The points of a tile, then those of others within the margin."""
        margin = self.facts.margin if margin is None else margin
        parts = [np.load(self.path(kind, number))]
        for other in self.cells.near(number, margin):
            if self.facts.sizes[other]:
                parts.extend(rows_around(self.path(kind, other), self.cells, number, margin))
        return np.concatenate(parts)

    def sight(self, attributes: Mapping[str, np.ndarray]) -> Sight | None:
        """What says which side of the surface was seen; None: nothing does, or given normals are to stay."""
        asked = asked_sight(self.keys.viewpoint, self.keys.up, self.keys.side, attributes)
        above = Sight("up, as a map of heights", up=np.array([0.0, 0, 1])) if self.facts.heights else None
        return asked or sight_of(self.keys.input, attributes) or above

    def coarse(self) -> NDArray[np.float64]:
        """A coarse cloud of the whole with normals, (k, 6)."""
        return np.asarray(np.load(self.folder / "coarse.npy"))


def rows_around(path: Path, cells: Cells, number: int, margin: float) -> Iterator[NDArray[Any]]:
    """Of the records of a file those within a margin of a cell, a slice of the file at a time."""
    rows = np.load(path, mmap_mode="r")
    for start in range(0, len(rows), 2**18):
        part = rows[start : start + 2**18]
        yield np.asarray(part[cells.inside(np.ascontiguousarray(part["point"]), number, margin)])


def folder_of(parts: Path, keys: Keys, size: int) -> Path:
    """Where the tiles of this input for these keys lie: another input, or other keys, have another folder."""
    path = Path(keys.input)
    state = path.stat()
    text = repr((str(path.resolve()), state.st_size, state.st_mtime_ns, *keys, size, __version__))
    return parts / f"tiles_{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def planned(parts: Path, keys: Keys, size: int, progress: Progress = silent) -> Plan:
    """The plan for tiles of at most about `size` points, made now or earlier, in a folder below `parts`.

    Raises:
        ValueError: what `pnu.io.read_cloud` would refuse of the file.
    """
    folder = folder_of(parts, keys, size)
    if not (folder / "plan.json").is_file():
        if folder.is_dir():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
        try:
            facts = _made(folder, keys, size, progress)
        except BaseException:
            shutil.rmtree(folder)
            raise
        write_json(folder / "plan.json", {"keys": keys._asdict(), "facts": asdict(facts)})
    return Plan(folder, keys)


def _made(folder: Path, keys: Keys, size: int, progress: Progress) -> Facts:
    facts = Facts()
    seen = _looked_through(keys, progress)
    if not seen.count:
        raise ValueError(f"{keys.input}: holds 0 points that can be used; at least {SMALLEST} are needed")
    depth = max(0, math.ceil(math.log2(seen.count / size)))
    cells = Cells.of(seen.sample, depth)
    np.savez(folder / "cells.npz", **cells._asdict())
    facts.low, facts.high = seen.low.tolist(), seen.high.tolist()
    facts.brightest = seen.brightest
    facts.attributes = [name for name, used in seen.used.items() if used]
    _distributed(folder, cells, keys, facts, seen, progress)
    if seen.count < seen.promised:
        left = seen.promised - seen.count
        facts.notes.append(f"{left} of {seen.promised} points left out: NaN, infinite or beyond 1e+30")
    _each_place_once(folder, keys, facts, seen, progress)
    corners = np.stack([seen.low, seen.high])
    if is_geographic(keys.input) or looks_geographic(corners):
        facts.notes.append(GEOGRAPHIC)
    if facts.given and facts.missing == facts.points:
        facts.given = False
        facts.notes.append("normals are all zero or NaN: taken as none")
    elif facts.missing:
        facts.notes.append(f"{facts.missing} of {facts.points} normals are zero or NaN: theirs are estimated")
    _decided(folder, keys, facts, progress)
    return facts


@dataclass
class _Seen:
    """What the first pass over a file tells."""

    promised: int = 0
    count: int = 0
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(3, -np.inf))
    sample: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    brightest: float | None = None
    used: dict[str, bool] = field(default_factory=dict)


def _looked_through(keys: Keys, progress: Progress) -> _Seen:
    seen, step, samples = _Seen(), 1, [np.empty((0, 3))]
    progress("reading", 0, 1)
    for cloud in point_slices(keys.input, keys.columns):
        points = cloud.points[in_range(cloud.points)]
        if len(points):
            seen.low, seen.high = np.minimum(seen.low, points.min(0)), np.maximum(seen.high, points.max(0))
        samples.append(points[(-seen.count) % step :: step])
        seen.promised, seen.count = seen.promised + len(cloud.points), seen.count + len(points)
        if sum(map(len, samples)) > 2 * SAMPLE:  # half as many stay, evenly over the file
            samples, step = [np.concatenate(samples)[::2]], 2 * step
        zero_left_out = Path(keys.input).suffix.lower() in (".las", ".laz")
        for name, values in cloud.attributes.items():
            if name == "colors":
                most = float(np.nanmax(values, initial=0))
                seen.brightest = most if seen.brightest is None else max(most, seen.brightest)
            seen.used[name] = seen.used.get(name, False) or not zero_left_out or bool(values.any())
    if seen.brightest == 0 and Path(keys.input).suffix.lower() in (".las", ".laz"):
        seen.brightest = None
    seen.sample = np.concatenate(samples)
    progress("reading", 1, 1)
    return seen


def _records(cloud: Cloud, facts: Facts, with_normals: bool) -> NDArray[Any]:
    """Points, normals and those attributes that are used, as rows of one file."""
    kept: dict[str, np.ndarray] = {}
    for name in facts.attributes:
        values = cloud.attributes[name]
        if name == "colors" and values.dtype == np.uint16:
            values = values if (facts.brightest or 0) < 256 else values >> 8
            values = values.astype(np.uint8)
        elif name == "colors":
            values = as_colors(values, facts.brightest)
        kept[name] = values
    return structured(cloud.points, cloud.normals if with_normals else None, kept)


def structured(points: np.ndarray, normals: np.ndarray | None, attributes: Mapping[str, np.ndarray]) -> NDArray[Any]:
    """Rows (n,) with fields `point`, `normal` where there are, and the attributes, `value NAME`."""
    kinds: list[Any] = [("point", "f8", (3,))] + [("normal", "f8", (3,))] * (normals is not None)
    kinds += [(f"value {name}", values.dtype, values.shape[1:]) for name, values in attributes.items()]
    rows = np.empty(len(points), kinds)
    rows["point"] = points
    if normals is not None:
        rows["normal"] = normals
    for name, values in attributes.items():
        rows[f"value {name}"] = values
    return rows


def attributes_of(rows: NDArray[Any]) -> dict[str, np.ndarray]:
    """The attributes of structured rows by name."""
    names = rows.dtype.names or ()
    return {name.removeprefix("value "): rows[name] for name in names if name.startswith("value ")}


def _distributed(folder: Path, cells: Cells, keys: Keys, facts: Facts, seen: _Seen, progress: Progress) -> None:
    """The points of the file in a raw file for each tile."""
    sizes = np.zeros(len(cells.low), np.int64)
    done = 0
    progress("sorting into tiles", 0, seen.promised)
    for cloud in point_slices(keys.input, keys.columns):
        good = in_range(cloud.points)
        done += len(good)
        facts.given = cloud.normals is not None and keys.normals != "estimate"
        rows = _records(cloud, facts, facts.given)[good]
        if facts.given:
            rows["normal"] = _units(rows["normal"])
        home = cells.of_points(rows["point"])
        order = np.argsort(home, kind="stable")
        counts = np.bincount(home, minlength=len(sizes))
        for number, part in zip(
            np.flatnonzero(counts), np.split(order, np.cumsum(counts[counts > 0])[:-1]), strict=True
        ):
            with (folder / f"raw_{number:05}").open("ab") as handle:
                rows[part].tofile(handle)
        sizes += counts
        progress("sorting into tiles", done, seen.promised)
    np.save(folder / "kind.npy", rows[:0])
    facts.sizes = sizes.tolist()


def _units(normals: np.ndarray) -> np.ndarray:
    """Of length 1, NaN where they have no direction."""
    with np.errstate(invalid="ignore"):
        found = unit_normals(normals)[0]
    return np.full(normals.shape, np.nan) if found is None else found


def _each_place_once(folder: Path, keys: Keys, facts: Facts, seen: _Seen, progress: Progress) -> None:
    """The files of the tiles as they are read from then on: each place once, and none at the origin for nothing."""
    kind = np.load(folder / "kind.npy").dtype
    raw, facts.sizes = facts.sizes, [0] * len(facts.sizes)
    near_origin = ORIGIN * float(np.median(np.abs(seen.sample).max(1)))
    unseen_raw, doubtful = 0, []
    for number, size in enumerate(raw):
        progress("each place once", number, len(raw))
        rows = np.fromfile(folder / f"raw_{number:05}", kind) if size else np.empty(0, kind)
        unseen_raw += int((np.abs(rows["point"]).max(1, initial=0) <= near_origin).sum())
        rows = rows[first_of_each_place(rows["point"], rows["normal"] if facts.given else None)]
        unseen = int((np.abs(rows["point"]).max(1, initial=0) <= near_origin).sum())
        if unseen:
            doubtful.append((number, unseen))
        facts.sizes[number] = len(rows)
        facts.missing += int(np.isnan(rows["normal"][:, 0]).sum()) if facts.given else 0
        if size:
            np.save(folder / f"points_{number:05}.npy", rows)
            (folder / f"raw_{number:05}").unlink()
    progress("each place once", len(raw), len(raw))
    total, places = sum(facts.sizes), sum(count for _, count in doubtful)
    left = seen.count
    if places and unseen_raw / places > UNSEEN * seen.count / total:
        for number, _ in doubtful:
            rows = np.load(folder / f"points_{number:05}.npy")
            rows = rows[np.abs(rows["point"]).max(1) > near_origin]
            facts.sizes[number] = len(rows)
            np.save(folder / f"points_{number:05}.npy", rows)
        facts.notes.append(f"{unseen_raw} of {seen.count} points left out: at the origin, where a sensor saw nothing")
        left -= unseen_raw
    facts.points = sum(facts.sizes)
    if facts.points < left:
        facts.notes.append(f"{left - facts.points} of {left} points left out: at the place of another")
    if facts.points < SMALLEST:
        raise ValueError(f"{keys.input}: holds {facts.points} different points; at least {SMALLEST} are needed")


def _decided(folder: Path, keys: Keys, facts: Facts, progress: Progress) -> None:
    """What holds for all tiles, from what a few places of the cloud are like."""
    full = [number for number, size in enumerate(facts.sizes) if size]
    chosen = full[:: -(-len(full) // PLACES)]
    found: list[dict[str, Any]] = []
    for done, number in enumerate(chosen):
        progress("looking at places", done, len(chosen))
        rows = _block(np.load(folder / f"points_{number:05}.npy"))
        if len(rows) >= SMALLEST:
            found.append(_look(rows["point"], rows["normal"] if facts.given else None, keys, len(rows)))
    progress("looking at places", len(chosen), len(chosen))
    weight = np.array([look["points"] for look in found], float)

    def most(name: str) -> bool:
        share = float(weight @ np.array([bool(look[name]) for look in found]))
        return share > float(weight.sum()) / 2

    def middle(name: str) -> float:
        values = np.array([look[name] for look in found if look[name] is not None])
        return float(np.median(values)) if len(values) else 0.0

    if facts.given and keys.normals == "auto" and most("poor"):
        facts.poor = next(look["poor"] for look in found if look["poor"])
    if most("lined") and keys.lines == "auto" and keys.keep is not True and not facts.trusted:
        facts.lined = middle("lined")
        facts.given = False  # what is fitted to lines has no sides either
    elif most("layered") and keys.noise == "auto" and keys.keep is not True:
        facts.layered = middle("layered")
        facts.given = facts.trusted and not most("turned")
    if most("steps"):
        facts.steps = middle("steps")
    facts.apart = max(look["apart" if facts.lined or facts.layered else "apart_raw"] for look in found)
    facts.smooth = most("noisy")
    facts.heights = most("heights")
    stray = float(weight @ np.array([look["stray"] for look in found])) / weight.sum()
    if facts.lined is not None:
        facts.character = "scanned"
    elif not facts.trusted:
        facts.character = "noisy" if most("loud") else "scanned" if stray > MANY else "clean"
    facts.keep = keys.keep if isinstance(keys.keep, bool) else most("even")
    if facts.given and keys.normals == "auto" and most("turned"):
        facts.turned = next(look["turned"] for look in found if look["turned"])
    _coarse_cloud(folder, keys, facts, full)


def _block(rows: NDArray[Any]) -> NDArray[Any]:
    """Of a tile's points those nearest to one in its middle."""
    if len(rows) <= BLOCK:
        return rows
    points = rows["point"]
    center = points[((points - np.median(points, 0)) ** 2).sum(1).argmin()]
    return rows[np.sort(np.argpartition(((points - center) ** 2).sum(1), BLOCK)[:BLOCK])]


def _look(points: np.ndarray, normals: np.ndarray | None, keys: Keys, size: int) -> dict[str, Any]:
    """What a block of the cloud is like."""
    steps = depth_steps(points) if keys.noise == "auto" and keys.keep is not True else None
    if steps is not None:
        points = smoothed_within_steps(points, steps)
    stray = stray_points(points) if keys.outliers == "auto" else np.zeros(len(points), bool)
    look: dict[str, Any] = {"points": size, "stray": float(stray.mean()), "heights": is_height_map(points)}
    look["steps"] = None if steps is None else float(np.median(steps.step))
    points, normals = points[~stray], None if normals is None else normals[~stray]
    look["apart_raw"] = float(np.quantile(local_spacing(points), 0.9))
    look["turned"] = "" if normals is None else contradiction(points, normals)
    known = None if normals is None else settled_normals(points, normals).normals
    look["poor"] = "" if known is None else poor_axes(points, known)
    thinned = thinned_lines(points) if known is None or look["poor"] else None
    look["lined"] = None
    if thinned is not None:
        points, known = points[thinned], None if known is None else known[thinned]
        look["lined"] = float(np.quantile(PointTree(points).among_themselves(2)[0][:, 0], 0.02))
    noise = layer_noise(points, BLOCK // 2) if thinned is None else None
    look["layered"] = noise
    if noise is not None:
        means = layer_means(points, noise, SMALLEST)
        points, known = means.points, None if known is None or look["poor"] else known[means.rows]
    look["apart"] = float(np.quantile(local_spacing(points), 0.9))
    known = settled_normals(points, None).normals if known is None else known
    scale = np.abs(points - points.mean(0)).max()
    cloud = np.hstack([(points - points.mean(0)) / scale, known])
    look["noisy"] = shows_noise(cloud)
    look["loud"] = is_noisy(points, known)
    look["even"] = thinned is None and is_even(cloud) and not look["noisy"]
    return look


def _coarse_cloud(folder: Path, keys: Keys, facts: Facts, full: list[int]) -> None:
    """Even points of the whole with normals on the side that is to be everywhere, where a tile cannot tell."""
    step = max(1, facts.points // (4 * COARSE))
    parts = [np.load(folder / f"points_{number:05}.npy", mmap_mode="r")[::step] for number in full]
    rows = np.concatenate([np.asarray(part) for part in parts])
    if keys.outliers == "auto":  # farthest points would be stray ones first
        rows = rows[~stray_points(rows["point"])]
    asked, found = asked_sight(keys.viewpoint, keys.up, keys.side), None
    if len(rows) > COARSE:
        kept = farthest_points_large(rows["point"], COARSE)
        if asked is None and not facts.given:  # whoever scanned it shows in what is not even yet
            lines, scans = complete_normals(rows["point"], None), scan_numbers(attributes_of(rows))
            found = sight_from_within(rows["point"], lines, scans)
            if found is not None and scans is not None and found.viewpoint is not None:
                found = found._replace(viewpoint=found.viewpoint[kept])
        rows = rows[kept]
    asked = asked_sight(keys.viewpoint, keys.up, keys.side, attributes_of(rows))
    found = sight_of(keys.input, attributes_of(rows)) or found
    if facts.poor and not facts.turned and asked is None and found is None:  # a tile does not see whether all is closed
        facts.turned = normals_on_sides(rows["point"], rows["normal"]).words
    settled = settled_normals(
        rows["point"], rows["normal"] if facts.given else None,
        choice=keys.normals if keys.normals != "auto" or not facts.turned else "orient",  # type: ignore[arg-type]
        asked=asked, found=found,
    )  # fmt: skip
    with atomic_path(folder / "coarse.npy") as temporary:
        np.save(temporary, np.hstack([rows["point"], settled.normals]))
