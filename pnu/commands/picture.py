"""Draw clouds and meshes side by side: `pnu picture inputs=[dense.ply,mesh.ply] output=figure.png`."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pnu.commands._entry import command
from pnu.config.schema import doc
from pnu.runtime.progress import stages

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pnu.rendering import Camera


@dataclass
class Picture:
    """Draw clouds and meshes side by side, seen from the same side, as PNG, or turning, as animated WebP; no display or
    graphics card is needed."""

    commas: ClassVar = ("columns",)
    inputs: list[str] = doc("files to draw, a panel each: [a.ply,b.obj,...]; with faces as meshes, others as clouds")
    output: str = doc("png to write; with frames=36 an animated webp")
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
    frames: int = doc("pictures of a whole turn about it, six seconds long; 1: one picture")
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
    if not 1 <= cfg.frames <= 360:
        raise ValueError(f"frames={cfg.frames}: expected 1 to 360")
    suffix = ".png" if cfg.frames == 1 else ".webp"
    if Path(cfg.output).suffix.lower() != suffix:
        still = f"; frames={cfg.frames} are an animation" if cfg.frames > 1 else "; frames=36 makes an animated .webp"
        raise ValueError(f"output={cfg.output}: expected a name that ends in {suffix}{still}")
    check_writable(cfg.output)
    columns = columns_of(inputs, cfg.columns, "inputs")
    shapes = [read_shape(path, names) for path, names in zip(inputs, columns, strict=True)]
    bar = quality_bar(shapes, cfg.color, cfg.limit, cfg.colormap, cfg.label)
    points = [shape.points for shape in shapes]
    apart = cfg.fit is None and not rendering.in_one_place(*points)
    side = {"azimuth": cfg.azimuth, "elevation": cfg.elevation, "up": cfg.up}
    one = points if cfg.fit == 0 else [points[(cfg.fit or 1) - 1]]
    views = [cameras_of(own, cfg.frames, side) for own in ([[p] for p in points] if apart else [one])]
    names = [Path(path).stem for path in inputs] if captions is None else list(captions)
    pictures = []
    with stages(cfg.quiet or cfg.frames == 1) as progress:
        for number in range(cfg.frames):
            cameras = [own[number] for own in views] if apart else [views[0][number]] * len(points)
            panels = [
                shape.draw(camera, cfg.color, bar, size=cfg.size, radius=cfg.radius, smooth=cfg.smooth)
                for shape, camera in zip(shapes, cameras, strict=True)
            ]
            image = rendering.figure(panels, names, columns=cfg.panels, colorbar=bar, crop=cfg.frames == 1)
            pictures.append(image)
            progress("drawing", number + 1, cfg.frames)
    if cfg.frames == 1:
        rendering.save_png(cfg.output, image)
    else:
        rendering.save_animation(cfg.output, pictures)
    if not cfg.quiet:
        kinds = (f"{'mesh' if s.mesh is not None else 'cloud'}, color={s.source(cfg.color)}" for s in shapes)
        print(f"panels: {', '.join(f'{path} ({kind})' for path, kind in zip(inputs, kinds, strict=True))}")
        if apart:
            print("scale:  each panel its own, since the shapes differ in size or place; fit=1 shows all as the first")
        for shape in shapes:
            for note in shape.notes:
                print(f"        {shape.path}: {note}")
        height, width = image.shape[:2]
        turn = f"{cfg.frames} pictures of " if cfg.frames > 1 else ""
        print(f"output: {cfg.output}, {turn}{width} x {height} pixels, {time.perf_counter() - started:.1f} s")


def cameras_of(points: Sequence["NDArray[np.float64]"], frames: int, side: dict[str, Any]) -> list["Camera"]:
    """The cameras that see all points, one a frame."""
    from pnu import rendering

    return [rendering.look_at(*points, **side)] if frames == 1 else rendering.turntable(*points, frames=frames, **side)


main = command(picture, Picture)

if __name__ == "__main__":
    main()
