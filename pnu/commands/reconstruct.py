"""Make a surface from a cloud with normals: `pnu reconstruct input=dense.ply output=mesh.ply`."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands import _sides
from pnu.commands._entry import command, warn
from pnu.config.quoting import shell_line
from pnu.config.schema import doc
from pnu.runtime.progress import busy


@dataclass
class Reconstruct:
    """Make a triangle mesh from a point cloud file, and measure it against the true surface where there is one."""

    commas: ClassVar = ("columns", "viewpoint")
    input: str = doc(
        "cloud to read: ply, text (xyz, csv, pts ...), pcd, las, laz, e57, npy, npz; of a mesh its vertices"
    )
    output: str = doc("mesh to write: ply (keeps colors and errors), obj, off or stl")
    normals: str = doc(_sides.NORMALS)
    viewpoint: str | None = doc(_sides.VIEWPOINT)
    up: str | None = doc(_sides.UP)
    side: str | None = doc(_sides.SIDE)
    columns: str | None = doc(
        "of text, or an array without names: x,y,z,_,r,g,b (_ is left out); null: by its names or the usual order"
    )
    depth: int | None = doc("of the octree, 8 is usual, one more is twice as fine; null: from the points' spacing")
    trim: float = doc("share of the least supported vertices to cut off, for open surfaces, such as 0.05")
    reach: float | None = doc(
        "what lies farther from all points than so many of their spacings is cut off: an open sheet gets no bubble; "
        "null: nothing is"
    )
    truth: str | None = doc("mesh of the true surface: the error of each vertex is measured, stored and colored")
    report: str | None = doc("json for the summary of the errors; null: the output's name with .json")
    colormap: str = doc("of errors. error: red = zero to blue = high, as the paper; perceptual: dark to light")
    limit: float | None = doc(
        "error at the end of the colors, in the cloud's unit; null: 98 % of the vertices' are below"
    )
    timeout: float = doc("seconds that the reconstruction may take")
    seed: int = doc("of the points on the true surface whose distance to the mesh is measured")
    quiet: bool = doc("print nothing but warnings and errors")


def reconstruct(cfg: Any) -> None:
    """Write the surface of a cloud."""
    import numpy as np

    from pnu import io, reconstruction
    from pnu.cleaning import without_clutter, without_depth_steps
    from pnu.geometry.cloud_statistics import describe_cloud
    from pnu.geometry.mesh_topology import open_edges, vertex_normals
    from pnu.geometry.single_view import camera_place

    started = time.perf_counter()
    say: Callable[[str], None] = (lambda text: None) if cfg.quiet else print
    _check_options(cfg)
    cloud = io.read_cloud(cfg.input, normals=cfg.normals != "estimate", columns=cfg.columns)
    if cfg.normals != "keep":
        camera = camera_place(cloud.points)
        cloud = without_clutter(cloud, unless="normals=keep") if camera is None else cloud
        cloud = without_depth_steps(cloud, camera, unless="normals=keep")
    origin = "with normals" if cloud.normals is not None else "normals estimated and oriented"
    say(f"input:  {cfg.input}, {len(cloud.points)} points, {origin}")
    for note in cloud.notes:
        say(f"        {note}")
    points, truth = cloud.points, None
    if cfg.truth:
        truth = io.read_mesh(cfg.truth)
        if holes := open_edges(truth):
            warn(f"{cfg.truth}: is not watertight ({holes} open edges); errors are large where surface is missing")
        reconstruction.check_frame(points, truth, name=cfg.input, truth_name=cfg.truth)
    settled = _sides.sided(cfg, cloud)
    if settled.side:
        say(f"        normals: {settled.words}")
    settled, note = _sides.with_good_axes(cfg, cloud, settled)
    if note:
        say(f"        {note}")
    normals = settled.normals
    for text in describe_cloud(points, normals).warnings():
        warn(text)
    depth = reconstruction.octree_depth(points) if cfg.depth is None else cfg.depth
    with busy(f"Poisson reconstruction, depth {depth}", cfg.quiet):
        surface = reconstruction.reconstruct(
            points, normals, depth=depth, outward=not settled.seen, timeout=cfg.timeout, name=cfg.input
        )
    if cfg.reach is not None:
        before, surface = len(surface.mesh.vertices), reconstruction.cut_off(surface, points, cfg.reach)
        if gone := before - len(surface.mesh.vertices):
            say(f"cut:    {gone} of {before} vertices, far from all points (reach=null keeps them)")
    for text in surface.warnings():
        warn(text)
    if cfg.trim:
        before, surface = len(surface.mesh.vertices), reconstruction.trim(surface, cfg.trim)
        say(f"trim:   {before} vertices before, {len(surface.mesh.vertices)} after")
    mesh = surface.mesh
    extra: dict[str, Any] = {}
    if "colors" in cloud.attributes:
        colors = cloud.attributes["colors"][:, :3]
        extra["colors"] = reconstruction.interpolated_values(points, colors, mesh.vertices) / 255
    if truth is not None:
        errors = reconstruction.surface_errors(mesh, truth, rng=np.random.default_rng(cfg.seed))
        extra = {"quality": errors.distance, "colors": errors.colors(cfg.limit, cfg.colormap)}
    notes = io.write_mesh(cfg.output, mesh, vertex_normals=vertex_normals(mesh), **extra)
    if truth is not None:
        report = cfg.report or str(Path(cfg.output).with_suffix(".json"))
        io.write_json(report, {"input": cfg.input, "truth": cfg.truth, "depth": surface.depth} | errors.summary())
        say(f"{errors.table()}\nreport: {report}")
    counts = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces, depth {surface.depth}"
    say(f"output: {cfg.output}, {counts}, {time.perf_counter() - started:.1f} s")
    for note in notes:
        say(f"        {note}")
    names = {"columns": cfg.columns} if cfg.columns else {}
    say(f"next:   {shell_line('picture', inputs=[cfg.input, cfg.output], output='picture.png', **names)}")


def _check_options(cfg: Any) -> None:
    """Refuse what can be refused before the work begins."""
    from pnu.io import MESH_OUTPUTS, check_writable
    from pnu.rendering.colors import COLORMAPS

    _sides.check_sides(cfg)
    if cfg.colormap not in COLORMAPS:
        raise ValueError(f"colormap={cfg.colormap}: expected {' or '.join(COLORMAPS)}")
    if cfg.reach is not None and not cfg.reach > 0:
        raise ValueError(f"reach={cfg.reach:g}: expected a number of spacings above 0, such as 4, or null")
    if not 0 <= cfg.trim < 1:
        raise ValueError(f"trim={cfg.trim:g}: expected a share of the vertices from 0 to below 1, such as 0.05")
    if cfg.limit is not None and not cfg.limit > 0:
        raise ValueError(f"limit={cfg.limit:g}: expected a distance above 0")
    if Path(cfg.output).suffix.lower() not in MESH_OUTPUTS:
        raise ValueError(f"output={cfg.output}: expected a mesh, one of {', '.join(sorted(MESH_OUTPUTS))}")
    if Path(cfg.output).resolve() == Path(cfg.input).resolve():
        raise ValueError(f"output={cfg.output}: is the input; give another name")
    check_writable(cfg.output)


main = command(reconstruct, Reconstruct)

if __name__ == "__main__":
    main()
