"""Draw clouds and meshes side by side: `pnu picture inputs=[dense.ply,mesh.ply] output=figure.png`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands._entry import command
from pnu.config.schema import doc


@dataclass
class Picture:
    """Draw clouds and meshes side by side, seen from the same side, as PNG; no display or graphics card is needed."""

    commas: ClassVar = ("columns",)
    inputs: list[str] = doc("files to draw, a panel each: [a.ply,b.obj,...]; with faces as meshes, others as clouds")
    output: str = doc("png to write")
    captions: list[str] | None = doc("a caption for each panel; null: the names of the files")
    panels: int | None = doc("in a row; null: all, up to six")
    columns: str | None = doc(
        "of text, or an array without names: x,y,z,_,r,g,b (_ is left out); null: by its names or the usual order"
    )
    color: str = doc("auto: the first that a file has; quality: scalar of that name; stored; normal; plain")
    colormap: str = doc("of quality. error: red = zero to blue = high; perceptual: dark to light")
    limit: float | None = doc("quality at the end of the colors; null: what 98 % of the points stay below")
    label: str = doc("of the color bar")
    fit: int | None = doc(
        "panel whose camera shows all, counted from 1; 0: all of them together; null: 1, each its own if elsewhere"
    )
    azimuth: float = doc("degrees that the shape is turned about the axis up=")
    elevation: float = doc("degrees that the camera looks from above")
    up: str = doc("axis that points up: x, y or z")
    radius: float | None = doc("of a cloud's points, in the unit of the file; null: by their spacing")
    smooth: bool = doc("meshes: smooth shading, false: each triangle flat")
    size: int = doc("pixels of a panel's side")
    quiet: bool = doc("print nothing but errors")


def picture(cfg: Any) -> None:
    """Draw the files side by side."""
    from pnu import rendering
    from pnu.io import check_writable
    from pnu.io.cloud import columns_of
    from pnu.rendering.colors import COLORMAPS
    from pnu.rendering.file_panels import COLORS, quality_bar, read_shape

    started = time.perf_counter()
    inputs, captions = list(cfg.inputs), cfg.captions
    if not inputs:
        raise ValueError("inputs=[]: expected one file or more, such as inputs=[dense.ply,mesh.ply]")
    if captions is not None and len(captions) != len(inputs):
        raise ValueError(f"captions: found {len(captions)} for {len(inputs)} inputs; give one for each")
    if cfg.fit is not None and not 0 <= cfg.fit <= len(inputs):
        raise ValueError(f"fit={cfg.fit}: expected a panel, 1 to {len(inputs)}, or 0 for all")
    for name, value, choices in (("color", cfg.color, COLORS), ("colormap", cfg.colormap, tuple(COLORMAPS))):
        if value not in choices:
            raise ValueError(f"{name}={value}: expected one of {', '.join(choices)}")
    for name, value in (("limit", cfg.limit), ("radius", cfg.radius)):
        if value is not None and not value > 0:
            raise ValueError(f"{name}={value:g}: expected a number above 0")
    if cfg.panels is not None and cfg.panels < 1:
        raise ValueError(f"panels={cfg.panels}: expected a number above 0, the panels in a row")
    if cfg.columns is not None and cfg.columns.lstrip("-").isdecimal():
        raise ValueError(
            f"columns={cfg.columns}: expected names such as x,y,z,_,r,g,b; panels={cfg.columns} puts as many in a row"
        )
    if not 16 <= cfg.size <= 4096:
        raise ValueError(f"size={cfg.size}: expected 16 to 4096 pixels")
    if Path(cfg.output).suffix.lower() != ".png":
        raise ValueError(f"output={cfg.output}: expected a name that ends in .png")
    check_writable(cfg.output)
    columns = columns_of(inputs, cfg.columns, "inputs")
    shapes = [read_shape(path, names) for path, names in zip(inputs, columns, strict=True)]
    bar = quality_bar(shapes, cfg.color, cfg.limit, cfg.colormap, cfg.label)
    points = [shape.points for shape in shapes]
    apart = cfg.fit is None and not rendering.in_one_place(*points)
    side = {"azimuth": cfg.azimuth, "elevation": cfg.elevation, "up": cfg.up}
    one = rendering.look_at(*(points if cfg.fit == 0 else [points[(cfg.fit or 1) - 1]]), **side)
    cameras = [rendering.look_at(own, **side) if apart else one for own in points]
    panels = [
        shape.draw(camera, cfg.color, bar, size=cfg.size, radius=cfg.radius, smooth=cfg.smooth)
        for shape, camera in zip(shapes, cameras, strict=True)
    ]
    names = [Path(path).stem for path in inputs] if captions is None else list(captions)
    image = rendering.figure(panels, names, columns=cfg.panels, colorbar=bar)
    rendering.save_png(cfg.output, image)
    if not cfg.quiet:
        kinds = (f"{'mesh' if s.mesh is not None else 'cloud'}, color={s.source(cfg.color)}" for s in shapes)
        print(f"panels: {', '.join(f'{path} ({kind})' for path, kind in zip(inputs, kinds, strict=True))}")
        if apart:
            print("scale:  each panel its own, since the shapes differ in size or place; fit=1 shows all as the first")
        for shape in shapes:
            for note in shape.notes:
                print(f"        {shape.path}: {note}")
        height, width = image.shape[:2]
        print(f"output: {cfg.output}, {width} x {height} pixels, {time.perf_counter() - started:.1f} s")


main = command(picture, Picture)

if __name__ == "__main__":
    main()
