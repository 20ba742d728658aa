"""The same validation clouds for each setting, as the trainings drew them at their end."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pnu.rendering import figure
from pnu.report.sweep_results import Run, Study


def last_pictures(run: Run) -> dict[str, Path]:
    """Shape -> its picture of the latest step, in a run's pictures/<shape>_<step>.png."""
    found = sorted(run.folder.pictures.glob("*.png"))
    return {match[1]: path for path in found if (match := re.fullmatch(r"(.+)_\d+", path.stem))}


def sheets(study: Study, width: int = 560) -> dict[str, NDArray[np.uint8]]:
    """Shape -> one picture (h, w, 3): input, prediction and target of each setting's first seed, with its name."""
    by_setting = [(f"{i} {s.name}", last_pictures(s.runs[0])) for i, s in enumerate(study.settings)]
    shapes = dict.fromkeys(shape for _, pictures in by_setting for shape in pictures)
    found = {}
    for shape in shapes:
        having = [(name, pictures[shape]) for name, pictures in by_setting if shape in pictures]
        panels = [Image.open(path).convert("RGB") for _, path in having]
        for panel in panels:
            panel.thumbnail((width, width))
        size = max(panel.width for panel in panels), max(panel.height for panel in panels)
        padded = [np.asarray(pad(panel, size)) for panel in panels]
        found[shape] = figure(padded, [name for name, _ in having], columns=min(2, len(padded)))
    return found


def pad(picture: Image.Image, size: tuple[int, int]) -> Image.Image:
    """A picture on white, of a given size."""
    canvas = Image.new("RGB", size, "white")
    canvas.paste(picture, ((size[0] - picture.width) // 2, (size[1] - picture.height) // 2))
    return canvas
