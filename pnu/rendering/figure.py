"""Several panels in one figure, with captions and a color bar."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from pnu.extras import needed
from pnu.io import atomic_path
from pnu.rendering.colors import value_colors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Picture = NDArray[np.uint8]
READABLE = 12  # pixels of text
DPI = 100  # of the color bar: a unit of matplotlib's sizes


class ColorBar(NamedTuple):
    """What the colors of `value_colors` mean."""

    limits: tuple[float, float]
    label: str = ""
    colormap: str = "error"


def figure(
    panels: Sequence[Picture],
    captions: Sequence[str] | None = None,
    *,
    columns: int | None = None,
    colorbar: ColorBar | None = None,
    crop: bool = True,
) -> Picture:
    """Panels `(h, w, 3)` of one size in rows of `columns` (default: up to six), captions below, color bar right.

    crop: cut white margins that all panels have in common. Lines in a caption are parted by "\\n". ValueError for a
    blank panel, panels of different sizes or a wrong number of captions.
    """
    captions = [""] * len(panels) if captions is None else captions
    if not panels or len(captions) != len(panels):
        raise ValueError(
            f"figure: {len(panels)} panels and {len(captions)} captions; give one panel or more, one caption each"
        )
    if len({panel.shape for panel in panels}) > 1:
        raise ValueError(
            f"figure: panels of different sizes, {sorted({panel.shape for panel in panels})}; draw all at one size"
        )
    for i, panel in enumerate(panels):
        if not is_drawn(panel):
            raise ValueError(
                f"figure: panel {i + 1} of {len(panels)} ({captions[i] or 'no caption'}) is blank; check its camera"
            )
    side = panels[0].shape[1]
    columns = columns or min(len(panels), 6)
    gap = max(side // 30, 4)
    rows = [range(i, min(i + columns, len(panels))) for i in range(0, len(panels), columns)]
    left, right = extent(panels, 1, gap) if crop else (0, side)
    pad, width = gap, right - left
    size = max(side / 22, READABLE)
    font = fitting_font(captions, size, width)
    line = int(1.35 * font.size)
    strips = []
    for row in rows:
        top, bottom = extent([panels[i] for i in row], 0, gap) if crop else (0, panels[0].shape[0])
        below = line * max(len(captions[i].splitlines()) for i in row) + line // 2
        strip = Image.new("RGB", (columns * (width + pad) - pad, bottom - top + below), "white")
        for k, i in enumerate(row):
            x = k * (width + pad)
            strip.paste(Image.fromarray(panels[i][top:bottom, left:right]), (x, 0))
            for n, text in enumerate(captions[i].splitlines()):
                middle = (x + width / 2, bottom - top + (n + 0.6) * line)
                ImageDraw.Draw(strip).text(middle, text, "black", font, anchor="mm")
        strips.append(np.asarray(strip))
    picture = np.concatenate(strips)
    if colorbar is not None:
        picture = np.concatenate([picture, draw_colorbar(colorbar, len(picture), size)], axis=1)
    return np.pad(picture, ((gap, gap // 2), (gap, gap), (0, 0)), constant_values=255)


def save_png(path: str | Path, picture: Picture) -> None:
    """Write a PNG atomically. ValueError if the picture is blank or the path does not end in .png."""
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: pictures are written as .png; name the output so")
    if not is_drawn(picture):
        raise ValueError(f"{path}: the picture would be blank; it is not written")
    with atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, dpi=(300, 300))


def save_animation(path: str | Path, pictures: Sequence[Picture], seconds: float = 6) -> None:
    """Write pictures of one size atomically as an animated WebP that goes round. ValueError where one is blank."""
    if Path(path).suffix.lower() != ".webp":
        raise ValueError(f"{path}: animations are written as .webp; name the output so")
    if not all(map(is_drawn, pictures)):
        raise ValueError(f"{path}: a picture would be blank; it is not written")
    first, *others = map(Image.fromarray, pictures)
    with atomic_path(path) as temporary:
        first.save(
            temporary, "WEBP", save_all=True, append_images=others, duration=round(1000 * seconds / len(pictures)),
            loop=0, quality=80, method=6,
        )  # fmt: skip


def webp(picture: Picture, quality: int = 90) -> bytes:
    """A picture as WebP: a tenth of the PNG's bytes, at 90 no difference to be seen."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "WEBP", quality=quality)
    return buffer.getvalue()


def is_drawn(picture: Picture) -> bool:
    """Whether a picture shows more than its background."""
    return picture.size > 0 and bool((picture != picture.flat[0]).any())


def extent(panels: Sequence[Picture], axis: int, margin: int) -> tuple[int, int]:
    """First and last + 1 row (axis 0) or column (axis 1) that any of the panels uses, widened by a margin."""
    used = np.flatnonzero(np.any([(panel < 255).any((1 - axis, 2)) for panel in panels], axis=0))
    return max(int(used[0]) - margin, 0), min(int(used[-1]) + 1 + margin, panels[0].shape[axis])


def fitting_font(texts: Sequence[str], size: float, width: int) -> ImageFont.FreeTypeFont:
    """Pillow's own font, at most `size` high and small enough for the longest line."""
    font = typeface(size)
    longest = max((font.getlength(line) for text in texts for line in text.splitlines()), default=0)
    return font if longest <= width else typeface(max(size * width / longest, 8))


def typeface(size: float) -> ImageFont.FreeTypeFont:
    """The font of a size, in pixels."""
    font = ImageFont.load_default(max(size, 8))
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise RuntimeError("Pillow was built without FreeType; install its wheel: pip install --force-reinstall pillow")
    return font


def draw_colorbar(bar: ColorBar, height: int, size: float) -> Picture:
    """The bar and its label, `height` pixels high, with numbers of `size` pixels; cut to what it needs."""
    with needed("drawing plots"):
        from matplotlib import style
        from matplotlib.backends.backend_agg import FigureCanvasAgg

    with style.context("default"):
        canvas = FigureCanvasAgg(colorbar_figure(bar, height, size))
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return picture[:, : extent([picture], 1, int(0.4 * size))[1]]


def colorbar_figure(bar: ColorBar, height: int, size: float) -> "Figure":
    """The bar as matplotlib draws it, in the middle of a white strip."""
    with needed("drawing plots"):
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import ListedColormap, Normalize
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator

    pixels, length, points = 8 * size, min(0.8 * height, 24 * size), 0.85 * size * 72 / DPI
    figure = Figure(figsize=(pixels / DPI, height / DPI), dpi=DPI)
    axes = figure.add_axes((0.4 * size / pixels, (1 - length / height) / 2, 0.9 * size / pixels, length / height))
    colors = ListedColormap(value_colors(np.linspace(0, 1, 256), (0, 1), bar.colormap) / 255.0)
    scale = figure.colorbar(ScalarMappable(Normalize(*bar.limits), colors), cax=axes)
    scale.locator = MaxNLocator(7, steps=[1, 2, 5, 10], min_n_ticks=4)
    scale.update_ticks()
    axes.tick_params(labelsize=points)
    if bar.label:
        fitting = 1.6 * height * 72 / DPI / len(bar.label)  # a letter is about 0.6 of its size wide
        scale.set_label(bar.label, fontsize=min(points, fitting), parse_math=False)
    return figure
