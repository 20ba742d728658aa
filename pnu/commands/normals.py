"""Give a cloud normals with signs that agree: `pnu normals input=cloud.ply output=with_normals.ply`."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands._entry import command
from pnu.config.quoting import shell_line
from pnu.config.schema import doc
from pnu.runtime.progress import stages


@dataclass
class Normals:
    """Write the same points, in the same order and with all that the file says of them, with normals that agree."""

    commas: ClassVar = ("columns", "viewpoint")
    input: str = doc(
        "cloud to read: ply, text (xyz, csv, pts ...), pcd, las, laz, e57, npy, npz; of a mesh its vertices"
    )
    output: str = doc("file to write; its suffix says the format")
    normals: str = doc(
        "auto: the file's, turned over where they contradict each other, estimated where missing; orient: the file's "
        "axes, all sides chosen; estimate: all estimated; keep: the file's as they are"
    )
    viewpoint: str | None = doc("x,y,z, place of the sensor: normals look to where they were seen from; null: see docs")
    up: str | None = doc("x, y, z, -x, -y or -z: the direction from which all was seen, as from the air")
    side: str | None = doc("out or in: of closed shapes, in for rooms and tunnels; of open ones in is the other side")
    columns: str | None = doc(
        "of text, or an array without names: x,y,z,_,r,g,b (_ is left out); null: by its names or the usual order"
    )
    quiet: bool = doc("print nothing but errors")


def normals(cfg: Any) -> None:
    """Write the cloud of a file with normals."""
    from pnu import io
    from pnu.io.sensor import CHOICES, asked_sight, sight_of

    started = time.perf_counter()
    say: Callable[[str], None] = (lambda text: None) if cfg.quiet else print
    if cfg.normals not in CHOICES:
        raise ValueError(f"normals={cfg.normals}: expected {', '.join(CHOICES)}")
    asked = asked_sight(cfg.viewpoint, cfg.up, cfg.side)
    io.check_output(cfg.output)
    if Path(cfg.output).resolve() == Path(cfg.input).resolve():
        raise ValueError(f"output={cfg.output}: is the input; give another name")
    cloud = io.read_cloud(cfg.input, normals=cfg.normals != "estimate", columns=cfg.columns, pulses=True)
    say(f"input:   {cfg.input}, {len(cloud.points)} points, {'without' if cloud.normals is None else 'with'} normals")
    for note in cloud.notes:
        say(f"         {note}")

    from pnu.geometry.cloud_normals import settled_normals

    with stages(cfg.quiet) as progress:
        settled = settled_normals(
            cloud.points,
            cloud.normals,
            choice=cfg.normals,
            asked=asked,
            found=sight_of(cfg.input, cloud.attributes),
            progress=progress,
        )
    say(f"normals: {settled.words}")
    for note in io.write_cloud(cfg.output, cloud.points, settled.normals, cloud.attributes):
        say(f"         {note}")
    say(f"output:  {cfg.output}, {len(cloud.points)} points with unit normals, {time.perf_counter() - started:.1f} s")
    say(f"next:    {shell_line('upsample', input=cfg.output, output='dense.ply')}")


main = command(normals, Normals)

if __name__ == "__main__":
    main()
