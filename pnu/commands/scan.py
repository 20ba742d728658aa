"""The whole way from a scan to its surface: `pnu scan input=scan.ply output=mesh.ply`."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands import _filled, _sides
from pnu.commands._entry import command, warn
from pnu.config.quoting import shell_line
from pnu.config.schema import doc
from pnu.runtime.progress import busy, stages

QUALITIES: dict[str, dict[str, float]] = {
    "best": {"fine": 9},  # all steps by the network itself
    "fast": {"seeds": 2, "candidates": 1.3, "shortlist": 1.0, "relaxation": 1, "refinements": 1, "fine": 1},
}  # how the surface network is used, see `pnu.networks.surface.Surface`


@dataclass
class Scan:
    """From a scan to its surface: cleaned, with normals, dense, a mesh; each step says what it found and did."""

    commas: ClassVar = ("columns", "viewpoint")
    input: str = doc("scan to read: ply, text (xyz, csv, pts ...), pcd, las, laz, e57, npy, npz")
    output: str = doc("mesh to write: ply (keeps colors), obj, off or stl")
    cloud: str | None = doc("file for the dense cloud with normals; null: none is written")
    page: str | None = doc("html file that shows scan, dense cloud and surface in 3D, and what was done; null: none")
    removed: str | None = doc("file for the points that were taken out; null: none is written")
    ratio: float = doc("points of the dense cloud for each point of the scan, any number >= 1")
    spacing: float | None = doc("instead of ratio: the distance wanted between points, in the scan's unit")
    quality: str = doc("best; fast: about half the time, by fewer candidates and projections and a coarser octree")
    holes: float | None = doc(_filled.HOLES)
    normals: str = doc(_sides.NORMALS)
    viewpoint: str | None = doc(_sides.VIEWPOINT)
    up: str | None = doc(_sides.UP)
    side: str | None = doc(_sides.SIDE)
    columns: str | None = doc(
        "of text, or an array without names: x,y,z,_,r,g,b (_ is left out); null: by its names or the usual order"
    )
    depth: int | None = doc("of the octree, 8 is usual, one more is twice as fine; null: from the points' spacing")
    reach: float | None = doc(
        "what lies farther from all points than so many of their spacings is cut off: an open sheet gets no bubble; "
        "null: nothing is"
    )
    timeout: float = doc("seconds that the surface may take")
    seed: int = doc("of models that draw random numbers")
    quiet: bool = doc("print nothing but warnings and errors")


def scan(cfg: Any) -> None:
    """Write the surface of a scan."""
    from pnu import io
    from pnu.geometry.mesh_topology import vertex_normals

    started = time.perf_counter()
    say: Callable[[str], None] = (lambda text: None) if cfg.quiet else print
    check_files(cfg)
    before = io.read_cloud(cfg.input, normals=cfg.normals != "estimate", columns=cfg.columns)
    origin = "with normals" if before.normals is not None else "without normals"
    say(f"scan:   {cfg.input}, {len(before.points)} points, {origin}")

    from pnu import reconstruction
    from pnu.geometry.cloud_statistics import describe_cloud
    from pnu.upsamplers import whole_clouds
    from pnu.upsamplers.inference import LoadedWeights, is_cpu

    wanted = cfg.ratio if cfg.spacing is None else whole_clouds.ratio_of_spacing(before.points, cfg.spacing)
    count = whole_clouds.output_count(len(before.points), wanted)
    cleaned, cloud = _sides.cleaned(cfg, before)
    stray = cleaned.stray
    look = describe_cloud(cloud.points, cloud.normals)
    for text in (*cloud.notes, str(look), *look.warnings()):
        say(f"        {text}")
    if cfg.removed is not None:
        gone = {name: values[stray] for name, values in before.attributes.items()}
        io.write_cloud(cfg.removed, before.points[stray], None, gone)
    network = LoadedWeights("surface").network(cleaned.cloud.normals, cleaned.character)
    for name, value in QUALITIES[cfg.quality].items():
        setattr(network, name, value)
    device = "cpu" if is_cpu("auto") else "cuda"
    options = whole_clouds.Densification(holes=cfg.holes, seed=cfg.seed)
    with stages(cfg.quiet) as progress:
        dense = whole_clouds.densified(cleaned, count, options, model=network, device=device, progress=progress)
    say(f"dense:  {len(dense)} points with unit normals, {time.perf_counter() - started:.1f} s")
    coarser = int(cfg.quality == "fast")
    depth = reconstruction.octree_depth(dense) - coarser if cfg.depth is None else cfg.depth
    with busy(f"surface, depth {depth}", cfg.quiet):
        surface = reconstruction.reconstruct(
            dense[:, :3], dense[:, 3:], depth=depth, outward=not cleaned.seen, timeout=cfg.timeout, name=cfg.input
        )
    if cfg.reach is not None:
        whole = len(surface.mesh.vertices)
        surface = reconstruction.cut_off(surface, dense, cfg.reach)
        if whole > len(surface.mesh.vertices):
            say(f"cut:    {whole - len(surface.mesh.vertices)} of {whole} vertices, far from all points")
    for text in surface.warnings():
        warn(text)
    mesh = surface.mesh
    colors = {}
    if "colors" in cloud.attributes:
        of_points = cloud.attributes["colors"][:, :3]
        colors = {"colors": reconstruction.interpolated_values(cloud.points, of_points, mesh.vertices) / 255}
    if cfg.cloud is not None:
        values, line = _filled.values_to_write(cfg, cfg.cloud, dense, cloud, count)
        if line:
            say(line)
        io.write_cloud(cfg.cloud, dense[:, :3], dense[:, 3:], values)
        say(f"cloud:  {cfg.cloud}")
    notes = io.write_mesh(cfg.output, mesh, vertex_normals=vertex_normals(mesh), **colors)
    if cfg.page is not None:
        from pnu.report.scan_page import write_scan_page

        size = write_scan_page(cfg.page, Path(cfg.input).name, before, stray, cloud.notes, dense, mesh)
        say(f"page:   {cfg.page}, {size / 1e6:.1f} MB; open it in a browser")
    counts = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces"
    say(f"output: {cfg.output}, {counts}, {time.perf_counter() - started:.1f} s")
    for note in notes:
        say(f"        {note}")
    say(f"next:   {shell_line('picture', inputs=[cfg.input, cfg.output], output='picture.png')}")


def check_files(cfg: Any) -> None:
    """Refuse what can be refused before the work begins."""
    from pnu.io import MESH_OUTPUTS, check_output, check_writable

    _sides.check_sides(cfg)
    if not 1 <= cfg.ratio < float("inf"):
        raise ValueError(f"ratio={cfg.ratio:g}: expected a number >= 1, the points out for each point in")
    _filled.check_holes(cfg)
    if cfg.quality not in QUALITIES:
        raise ValueError(f"quality={cfg.quality}: expected {' or '.join(QUALITIES)}")
    if cfg.reach is not None and not cfg.reach > 0:
        raise ValueError(f"reach={cfg.reach:g}: expected a number of spacings above 0, such as 4, or null")
    if Path(cfg.output).suffix.lower() not in MESH_OUTPUTS:
        raise ValueError(f"output={cfg.output}: expected a mesh, one of {', '.join(sorted(MESH_OUTPUTS))}")
    if cfg.page is not None and Path(cfg.page).suffix.lower() != ".html":
        raise ValueError(f"page={cfg.page}: expected a name that ends in .html")
    files = {name: cfg[name] for name in ("input", "output", "cloud", "page", "removed") if cfg[name] is not None}
    taken: dict[Path, str] = {}
    for name, path in files.items():
        place = Path(path).resolve()
        if place in taken:
            raise ValueError(f"{name}={path}: is the {taken[place]}; give another name")
        taken[place] = name
        if name in ("cloud", "removed"):
            check_output(path)
        elif name != "input":
            check_writable(path)


main = command(scan, Scan)

if __name__ == "__main__":
    main()
