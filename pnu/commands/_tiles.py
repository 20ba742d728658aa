"""`pnu upsample` of clouds larger than memory: keys `memory` and `tiles`."""

import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnu.config.quoting import override, shell_line
from pnu.runtime.progress import stages

if TYPE_CHECKING:
    from pnu.upsamplers.tile_plan import Plan

MEMORY = "such as 4GiB: the cloud is worked on in tiles, read and written in parts; null: as a whole, in memory"
TILES = (
    "all: with -m each tile is a job of hydra/launcher; plan: only how many there are; a number: this tile alone, of "
    "such a plan; null: all in this process, where memory= is given"
)
USUAL = "4GiB"
UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}
# by `python -m bench.tiles --calibrate 20000 60000 180000`
PROGRAM = 0.65 * 2**30  # bytes of Python, torch, the kernels, a slice of a file and the coarse cloud
POINT_IN, POINT_OUT = 2200, 560  # bytes for each point of a tile and its margin, and for each made of it, at the peak
MARGINS = 24  # spacings that a tile and its margins are wider than the tile
FEWEST = 1000  # points of a tile
Say = Callable[[str], None]


def in_tiles(cfg: Any) -> bool:
    """Whether a cloud is to be worked on in tiles."""
    return cfg.memory is not None or cfg.tiles is not None


def tile_size(memory: str, ratio: float) -> int:
    """Points of a tile for which a process stays within so much memory.

    Raises:
        ValueError: it is no size, or too small.
    """
    found = re.fullmatch(r"\s*([\d.]+)\s*([KMGT]?)(i?B)?\s*", memory, re.IGNORECASE)
    try:
        size = float(found[1]) * UNITS[found[2].upper()] if found else 0.0
    except ValueError:
        size = 0.0
    if not size:
        raise ValueError(f"memory={memory}: expected a size such as 4GiB or 1500MiB")
    region = max(size - PROGRAM, 0) / (POINT_IN + POINT_OUT * ratio)
    wide = max(region, 0) ** 0.5 - MARGINS
    points = int(wide**2) if wide > 0 else 0
    if points < FEWEST:
        least = (PROGRAM + (FEWEST**0.5 + MARGINS + 1) ** 2 * (POINT_IN + POINT_OUT * ratio)) / 2**20
        raise ValueError(f"memory={memory}: is too little for this ratio; expected at least {least:.0f}MiB")
    return points


def check_tiles(cfg: Any) -> None:
    """`ValueError` for what does not go together with memory= and tiles=, before the work begins."""
    from pnu.io.point_stream import check_streamed
    from pnu.io.streamed_output import check_partwise

    if cfg.tiles is not None and not re.fullmatch(r"all|plan|\d+", str(cfg.tiles)):
        raise ValueError(f"tiles={cfg.tiles}: expected all, plan or the number of a tile")
    plain: dict[str, Any] = {
        "holes": None,
        "removed": None,
        "sample": None,
        "patch_size": None,
        "merge": "farthest",
        "devices": 1,
        "allow": [],
    }
    for name, usual in plain.items():
        if cfg[name] != usual:
            raise ValueError(f"{name}={cfg[name]}: takes the cloud as a whole; leave it out, or memory= and tiles=")
    tile_size(cfg.memory or USUAL, 4 if cfg.spacing is not None else cfg.ratio)
    check_streamed(cfg.input)
    check_partwise(cfg.output)


def upsample_in_tiles(cfg: Any, say: Say) -> None:
    """Write the denser cloud of a file of any size, or do a tile's part of it."""
    started = time.perf_counter()
    check_tiles(cfg)
    from pnu.upsamplers import tile_seams, tile_work
    from pnu.upsamplers.selection import CLASSICAL

    if cfg.run in CLASSICAL:
        raise ValueError(f"run={cfg.run}: takes the cloud as a whole, without memory= and tiles=; surface takes tiles")
    if str(cfg.tiles).isdigit():
        _one(cfg, say)
        return
    with stages(cfg.quiet) as progress:
        plan = _plan(cfg, progress)
    facts, tiles = plan.facts, plan.tiles
    origin = "with normals" if facts.given else "normals estimated and oriented"
    say(f"input:  {cfg.input}, {facts.points} points, {origin}")
    for note in facts.notes:
        say(f"        {note}")
    if facts.lined:
        say(f"        lies in lines: thinned out to {facts.lined:.3g} between points (lines=keep)")
    if facts.layered:
        say(f"        noise of about {facts.layered:.2g}, more than the spacing: means take their place (noise=keep)")
    if facts.steps:
        say(f"        steps of depth of about {facts.steps:.2g}: points moved within half of one (noise=keep)")
    if facts.turned:
        say(f"        normals: sides chosen anew, {facts.turned} (normals=keep)")
    if facts.poor:
        say(f"        normals: axes found anew, they are {facts.poor} (normals=keep)")
    run = tile_work.run_of(plan)
    say(f"run:    {run}")
    most = max(facts.sizes)
    say(f"tiles:  {len(tiles)}, of at most {most} points and a margin of {facts.margin:.3g}, in {plan.folder}")
    if cfg.tiles == "plan":
        say(f"        numbers {' '.join(map(str, tiles))}")
        return
    with tile_work.working(run, cfg.device) as upsampler, stages(cfg.quiet) as progress:
        for done, number in enumerate(tiles):
            progress("tiles prepared", done, len(tiles))
            tile_work.prepared(plan, number)
        progress("tiles prepared", len(tiles), len(tiles))
        whole = tile_work.whole_of(plan)
        stray = sum(share.stray for share in whole.tiles.values())
        for done, number in enumerate(tiles):
            progress("tiles made", done, len(tiles))
            tile_work.made(plan, number, whole, upsampler)
        progress("tiles made", len(tiles), len(tiles))
        for done, number in enumerate(tiles):
            progress("borders", done, len(tiles))
            tile_seams.seamed(plan, number, whole, upsampler)
        progress("borders", len(tiles), len(tiles))
        count, names = tile_seams.write_tiles(plan, whole, cfg.output, progress)
    shutil.rmtree(_parts(cfg), ignore_errors=True)
    if stray:
        say(f"        {stray} of {facts.points} points left out: stray, they lie off the surface (outliers=keep)")
    left = [name for name in facts.attributes if name not in names]
    for told, some in (("carried over", names), ("left out", left)):
        if some:
            say(f"        {told}: {', '.join(some)}")
    say(f"output: {cfg.output}, {count} points with unit normals, {time.perf_counter() - started:.1f} s")
    say(f"next:   {shell_line('reconstruct', input=cfg.output, output='mesh.ply')}")


def jobs(cfg: Any) -> Iterator[list[str]]:
    """The overrides of the jobs that a multirun of tiles=all consists of: first each tile prepared, then made.

    Between the two what a job that ended early has left is not waited for: see `upsample_in_tiles`.
    """
    check_tiles(cfg)
    from pnu.upsamplers import tile_work

    with stages(cfg.quiet) as progress:
        plan = _plan(cfg, progress)
    for kind in ("share", "made"):
        suffix = ".json" if kind == "share" else ".npy"
        left = [number for number in plan.tiles if not plan.path(kind, number, suffix).is_file()]
        if left:
            yield [override("hydra.sweep.dir", _parts(cfg) / "jobs"), f"tiles={','.join(map(str, left))}"]
        if kind == "share":
            for number in plan.tiles:
                tile_work.prepared(plan, number)


def _one(cfg: Any, say: Say) -> None:
    """What is next for one tile: preparing it or, once all are prepared, making it dense."""
    from pnu.kernels.compilation import compile_all
    from pnu.upsamplers import tile_work
    from pnu.upsamplers.tile_plan import Plan, folder_of

    started = time.perf_counter()
    folder = folder_of(_parts(cfg), _keys(cfg), _size(cfg))
    if not (folder / "plan.json").is_file():
        raise ValueError(f"tiles={cfg.tiles}: there is no plan in {folder}; begin with tiles=plan and the same keys")
    plan, number = Plan(folder, _keys(cfg)), int(cfg.tiles)
    if number not in plan.tiles:
        raise ValueError(
            f"tiles={number}: expected one of {len(plan.tiles)} tiles, {min(plan.tiles)} to {max(plan.tiles)}"
        )
    compile_all()
    if not plan.path("share", number, ".json").is_file():
        tile_work.prepared(plan, number)
        done = "prepared"
    elif all(plan.path("share", other, ".json").is_file() for other in plan.tiles):
        with tile_work.working(tile_work.run_of(plan), cfg.device) as upsampler:
            tile_work.made(plan, number, tile_work.whole_of(plan), upsampler)
        done = "made"
    else:
        done = "is prepared, others are not yet"
    say(f"tile {number} of {len(plan.tiles)}: {done}, {time.perf_counter() - started:.1f} s")


def _plan(cfg: Any, progress: Any) -> "Plan":
    from pnu.kernels.compilation import compile_all
    from pnu.upsamplers.tile_plan import planned

    compile_all()  # so that all tiles are worked on by the same code, whoever does it
    return planned(_parts(cfg), _keys(cfg), _size(cfg), progress)


def _parts(cfg: Any) -> Path:
    return Path(f"{cfg.output}.parts")


def _size(cfg: Any) -> int:
    return tile_size(cfg.memory or USUAL, 4 if cfg.spacing is not None else cfg.ratio)


def _keys(cfg: Any) -> Any:
    from pnu.upsamplers.tile_plan import Keys

    keep = {"true": True, "false": False}.get(str(cfg.keep).lower(), cfg.keep)
    return Keys(*(keep if name == "keep" else cfg[name] for name in Keys._fields))
