"""Show clouds and meshes in 3D, side by side: `pnu view FILE ...`."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands._entry import command
from pnu.config.schema import doc

SHOWN = 1_000_000  # points of a cloud in the browser, unless a key says more
UPWARD = {".las", ".laz", ".e57"}  # formats of scanners: z points up


@dataclass
class View:
    """Show clouds and meshes in the browser, side by side with one camera, or write the page to send to someone.

    `pnu view a.ply b.obj` is `pnu view inputs=[a.ply,b.obj]`.
    """

    commas: ClassVar = ("columns",)
    files: ClassVar = "inputs"
    inputs: list[str] = doc("files to show: a.ply b.obj ...; with faces as meshes, others as clouds")
    page: str | None = doc("html to write, which needs nothing else to be opened; null: none, the browser shows it now")
    points: int | None = doc("of each cloud that are shown; null: 1000000 in the browser, in a page what page_mb holds")
    page_mb: float = doc("size that the page should not exceed by much, in MB: fewer points of each cloud are shown")
    columns: str | None = doc(
        "of text, or an array without names: x,y,z,_,r,g,b (_ is left out); null: by its names or the usual order"
    )
    up: str = doc("axis that points up: x, y or z; auto: z where a file is las, laz or e57, else y")
    port: int | None = doc("of 127.0.0.1 where the browser finds it; 0: any; null: 8321 or the next that is free")
    open: bool = doc("start the browser; false: only say the address")
    quiet: bool = doc("print nothing but errors and the address")


def view(cfg: Any) -> None:
    """Show the files, or write the page."""
    from pnu.io import check_writable
    from pnu.io.cloud import columns_of

    inputs = list(cfg.inputs)
    if not inputs:
        raise ValueError("inputs=[]: expected one file or more, such as pnu view scan.ply mesh.ply")
    if cfg.up not in ("auto", "x", "y", "z"):
        raise ValueError(f"up={cfg.up}: expected x, y, z or auto")
    for key in ("points", "page_mb"):
        if cfg[key] is not None and not cfg[key] >= 1:
            raise ValueError(f"{key}={cfg[key]:g}: expected a number of 1 or more")
    if cfg.page is not None:
        if Path(cfg.page).suffix.lower() != ".html":
            raise ValueError(f"page={cfg.page}: expected a name that ends in .html")
        check_writable(cfg.page)
    columns = columns_of(inputs, cfg.columns, "inputs")

    from pnu.app.local_server import page_server, serve
    from pnu.rendering.file_panels import read_shape
    from pnu.report.view_page import points_that_fit, views_of, write_view_page

    shapes = [read_shape(path, names) for path, names in zip(inputs, columns, strict=True)]
    fitting = SHOWN if cfg.page is None else points_that_fit(shapes, cfg.page_mb)
    viewed = views_of(shapes, cfg.points or fitting)
    if not cfg.quiet:
        for path, shape in zip(inputs, shapes, strict=True):
            faces = f", {len(shape.mesh.faces)} faces" if shape.mesh is not None else ""
            print(f"input:  {path}, {len(shape.points)} points{faces}")
        for note in viewed.notes:
            print(f"        {note}")
    upward = "z" if any(Path(path).suffix.lower() in UPWARD for path in inputs) else "y"
    up = upward if cfg.up == "auto" else cfg.up
    title = ", ".join(Path(path).name for path in inputs)
    if cfg.page is not None:
        size = write_view_page(cfg.page, viewed, up=up, title=title)
        if not cfg.quiet:
            print(f"page:   {cfg.page}, {size / 1e6:.1f} MB; open it in a browser")
        return
    with tempfile.TemporaryDirectory() as folder:
        write_view_page(Path(folder, "view.html"), viewed, up=up, title=title)
        page = Path(folder, "view.html").read_bytes()
    server = page_server(page, cfg.port)
    print(f"open:   {server.address} (Ctrl+C ends)", flush=True)
    serve(server, browse=cfg.open)


main = command(view, View)

if __name__ == "__main__":
    main()
