"""Give a cloud normals with signs that agree: `pnu normals input=cloud.ply output=with_normals.ply`."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands import _sides
from pnu.commands._entry import command
from pnu.config.quoting import shell_line
from pnu.config.schema import doc


@dataclass
class Normals:
    """Write the same points, in the same order and with all that the file says of them, with normals that agree."""

    commas: ClassVar = ("columns", "viewpoint")
    input: str = doc(
        "cloud to read: ply, text (xyz, csv, pts ...), pcd, las, laz, e57, npy, npz; of a mesh its vertices"
    )
    output: str = doc("file to write; its suffix says the format")
    normals: str = doc(_sides.NORMALS)
    viewpoint: str | None = doc(_sides.VIEWPOINT)
    up: str | None = doc(_sides.UP)
    side: str | None = doc(_sides.SIDE)
    columns: str | None = doc(
        "of text, or an array without names: x,y,z,_,r,g,b (_ is left out); null: by its names or the usual order"
    )
    quiet: bool = doc("print nothing but errors")


def normals(cfg: Any) -> None:
    """Write the cloud of a file with normals."""
    from pnu import io

    started = time.perf_counter()
    say: Callable[[str], None] = (lambda text: None) if cfg.quiet else print
    _sides.check_sides(cfg)
    io.check_output(cfg.output)
    if Path(cfg.output).resolve() == Path(cfg.input).resolve():
        raise ValueError(f"output={cfg.output}: is the input; give another name")
    cloud = io.read_cloud(cfg.input, normals=cfg.normals != "estimate", columns=cfg.columns, pulses=True)
    say(f"input:   {cfg.input}, {len(cloud.points)} points, {'without' if cloud.normals is None else 'with'} normals")
    for note in cloud.notes:
        say(f"         {note}")
    settled = _sides.sided(cfg, cloud)
    say(f"normals: {settled.words}")
    for note in io.write_cloud(cfg.output, cloud.points, settled.normals, cloud.attributes):
        say(f"         {note}")
    say(f"output:  {cfg.output}, {len(cloud.points)} points with unit normals, {time.perf_counter() - started:.1f} s")
    say(f"next:    {shell_line('upsample', input=cfg.output, output='dense.ply')}")


main = command(normals, Normals)

if __name__ == "__main__":
    main()
