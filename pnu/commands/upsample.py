"""Densify a point cloud file: `pnu upsample input=cloud.ply output=dense.ply`."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pnu.commands import _filled, _sides, _tiles
from pnu.commands._entry import command
from pnu.commands._protocol import MERGE
from pnu.config.quoting import shell_line
from pnu.config.schema import doc
from pnu.runtime.progress import stages

if TYPE_CHECKING:
    from pnu.io import Cloud

LONG = 500_000  # points made, from which on finished parts are kept beside the output until it is there


@dataclass
class Upsample:
    """Densify a point cloud file with a trained network; `model=NAME` is `run=NAME`."""

    also: ClassVar = {"model": "run"}
    commas: ClassVar = ("columns", "viewpoint")
    jobs: ClassVar = ("tiles", "all", _tiles.jobs)
    input: str = doc(
        "file to read: ply, text (xyz, csv, pts ...), pcd, las, laz, e57, npy, npz; of a mesh its vertices"
    )
    output: str = doc("file to write; its suffix says the format")
    run: str = doc(
        "run folder, weights that come with pnu (surface, pnu ...), or no network: apss, poisson, midpoint, ear; lop, "
        "wlop and l0 denoise, then take midpoints; newest: the run that finished last"
    )
    ratio: float = doc("points out for each point in, any number >= 1")
    spacing: float | None = doc("instead of ratio: the distance wanted between points, in the cloud's unit")
    merge: str = doc(MERGE)
    density: str = doc(
        "of surface: even; follow: every point becomes as many; auto: even where no place loses points by it"
    )
    keep: str = doc(
        "of surface and networks of patches: true: the points read are among those written, unmoved; false: all are "
        "new; auto: surface keeps them where evenly spread and without noise"
    )
    normals: str = doc(_sides.NORMALS)
    viewpoint: str | None = doc(_sides.VIEWPOINT)
    up: str | None = doc(_sides.UP)
    side: str | None = doc(_sides.SIDE)
    columns: str | None = doc(
        "of text, or an array without names: x,y,z,_,r,g,b (_ is left out); null: by its names or the usual order"
    )
    sample: int | None = doc("of a mesh: as many points on its faces, with their normals; null: its vertices")
    outliers: str = doc("auto: stray points, which lie off the surface, are taken out first; keep: all stay")
    lines: str = doc("auto: scan lines, dense along and sparse across, are thinned out first; keep: they stay")
    noise: str = doc(
        "auto: where points lie in a layer thicker than their spacing, means take their place, and steps of depth that "
        "are as wide are smoothed; keep: they stay"
    )
    holes: float | None = doc(_filled.HOLES)
    removed: str | None = doc("file for the points that were taken out; null: none is written")
    memory: str | None = doc(_tiles.MEMORY)
    tiles: str | None = doc(_tiles.TILES)
    patch_size: int | None = doc("points of a patch, at least 16; null: what the network was made for")
    batch_size: int | None = doc("patches (surface: points) at once, bounds the memory; null: by the device")
    device: str = doc("auto, cpu, cuda, cuda:1 ...")
    devices: int = doc("CUDA devices, or processes on the CPU, that share the work; the result stays the same")
    seed: int = doc("of models that draw random numbers")
    allow: list[str] = doc("packages of your own whose networks a run may name; they run their code")
    quiet: bool = doc("print nothing but errors")


def upsample(cfg: Any) -> None:
    """Write the denser cloud of a file."""
    from pnu import io

    started = time.perf_counter()
    say: Callable[[str], None] = (lambda text: None) if cfg.quiet else print
    _sides.check_sides(cfg)
    if not 1 <= cfg.ratio < float("inf"):  # here too: the network's libraries take seconds to load
        raise ValueError(f"ratio={cfg.ratio:g}: expected a number >= 1, the points out for each point in")
    _filled.check_holes(cfg)
    io.check_output(cfg.output)
    if cfg.removed is not None:
        io.check_output(cfg.removed)
    for name, path in (("output", cfg.output), ("removed", cfg.removed)):
        if path is not None and Path(path).resolve() == Path(cfg.input).resolve():
            raise ValueError(f"{name}={path}: is the input; give another name")
    if _tiles.in_tiles(cfg):
        _tiles.upsample_in_tiles(cfg, say)
        return
    if cfg.sample is None:
        cloud = io.read_cloud(cfg.input, normals=cfg.normals != "estimate", columns=cfg.columns)
    else:
        cloud = _sampled(cfg.input, cfg.sample, cfg.normals != "estimate", cfg.seed)
    origin = "with normals" if cloud.normals is not None else "normals estimated and oriented"
    say(f"input:  {cfg.input}, {len(cloud.points)} points, {origin}")
    for note in cloud.notes:
        say(f"        {note}")

    from pnu import weights
    from pnu.geometry.cloud_statistics import describe_cloud
    from pnu.networks import checkpoints
    from pnu.networks.checkpoints import NEWEST
    from pnu.upsamplers import whole_clouds
    from pnu.upsamplers.inference import LoadedWeights, weights_source
    from pnu.upsamplers.selection import CLASSICAL

    # what is no network is refused before the work; which of four "surface" is, shows later
    if cfg.allow and cfg.run != "surface" and cfg.run not in CLASSICAL:
        model: Any = checkpoints.load(cfg.run, cfg.allow)
    else:
        model = LoadedWeights(cfg.run)
        if cfg.run != "surface":
            model.network(device=cfg.device)
    wanted = cfg.ratio if cfg.spacing is None else whole_clouds.ratio_of_spacing(cloud.points, cfg.spacing)
    count, before = whole_clouds.output_count(len(cloud.points), wanted), cloud
    keep = {"true": True, "false": False}.get(str(cfg.keep).lower(), cfg.keep)
    lines, noise = ("keep", "keep") if keep is True else (cfg.lines, cfg.noise)
    cleaned, cloud = _sides.cleaned(cfg, cloud, outliers=cfg.outliers, lines=lines, noise=noise)
    for note in cloud.notes[len(before.notes) :]:
        say(f"        {note}")
    if cfg.removed is not None:
        gone = {name: values[cleaned.stray] for name, values in before.attributes.items()}
        io.write_cloud(cfg.removed, before.points[cleaned.stray], None, gone)
        say(f"        the points left out: {cfg.removed}")
    look = describe_cloud(cloud.points, cloud.normals)
    say(f"        {look}")
    for text in look.warnings():
        say(f"        {text}")
    run = weights_source(cfg.run, cleaned.cloud.normals, cleaned.character)
    chosen = (
        " (the newest finished one)"
        if cfg.run == NEWEST
        else " (comes with pnu)"
        if run in weights.shipped_names()
        else ""
    )
    say(f"run:    {run}{chosen}")
    # a long one goes on, after an interruption, from the parts that are done
    parts = Path(f"{cfg.output}.parts") if count >= LONG else None
    if parts is not None and parts.is_dir():
        say(f"parts:  {parts}, of an earlier start; what fits is taken")
    options = whole_clouds.Densification(
        cfg.patch_size, cfg.merge, cfg.density, keep, cfg.holes, cfg.devices, cfg.batch_size, cfg.seed
    )
    with stages(cfg.quiet) as progress:
        dense = whole_clouds.densified(
            cleaned, count, options, model=model, device=cfg.device, progress=progress, parts=parts
        )
    kept = io.kept_attributes(cfg.output, cloud.attributes)
    held = cloud._replace(attributes={name: cloud.attributes[name] for name in kept})
    values, line = _filled.values_to_write(cfg, cfg.output, dense, held, count)
    if line:
        say(line)
    notes = io.write_cloud(cfg.output, dense[:, :3], dense[:, 3:], values)
    if parts is not None:
        shutil.rmtree(parts, ignore_errors=True)
    for told, names in (("carried over", kept), ("left out", [name for name in cloud.attributes if name not in kept])):
        if names:
            say(f"        {told}: {', '.join(names)}")
    for note in notes:
        say(f"        {note}")
    say(f"output: {cfg.output}, {len(dense)} points with unit normals, {time.perf_counter() - started:.1f} s")
    say(f"next:   {shell_line('reconstruct', input=cfg.output, output='mesh.ply')}")


def _sampled(path: str, count: int, normals: bool, seed: int) -> "Cloud":
    """So many points spread evenly over the faces of a mesh, with their normals."""
    import numpy as np

    from pnu import io
    from pnu.geometry.mesh_sampling import sample_poisson_disk

    if count < 16:
        raise ValueError(f"sample={count}: expected at least 16 points, such as 5000")
    if Path(path).suffix.lower() not in io.MESH_SUFFIXES:
        raise ValueError(f"sample={count}: {path} is no mesh; leave sample=null")
    mesh = io.read_mesh(path)
    try:
        points = sample_poisson_disk(mesh, count, np.random.default_rng(seed))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    note = f"a mesh: the points are on its {len(mesh.faces)} faces, not its {len(mesh.vertices)} vertices"
    return io.Cloud(points[:, :3], points[:, 3:] if normals else None, {}, (note,))


main = command(upsample, Upsample)

if __name__ == "__main__":
    main()
