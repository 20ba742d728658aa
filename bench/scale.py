"""Time and peak memory of `pnu.upsample` x4 over the size of the cloud, each in a process of its own. Linux only."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from pnu import weights
from pnu.networks.pnu import PNU

SHORT = [10_000, 30_000, 100_000]
RUN = """
import json, re, sys, time
from pathlib import Path
from bench.scale import network, wavy_sphere
from pnu.upsamplers.whole_clouds import upsample
from pnu.io import write_cloud
n, name, kept = int(sys.argv[1]), sys.argv[2], sys.argv[3]
cloud, model = wavy_sphere(n), network(name)
normals = None if name == "surface_estimated" else cloud[:, 3:]
upsample(cloud[:2000, :3], cloud[:2000, 3:], model=model)
begun = {}
status = lambda name: int(re.search(name + r":\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 2**20
Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
before, started, used = status("VmRSS"), time.perf_counter(), time.process_time()
say = lambda stage, done, total: begun.setdefault(stage.split(",")[0], time.perf_counter() - started)
dense = upsample(cloud[:, :3], normals, model=model, progress=say)
seconds, used = time.perf_counter() - started, time.process_time() - used
assert dense.shape == (4 * n, 6)
clouds = (cloud.nbytes + dense.nbytes) / 2**30
beyond = status("VmHWM") - before - dense.nbytes / 2**30
ends = [*list(begun.values())[1:], seconds]
print(json.dumps([seconds, used, beyond, clouds, {stage: end - begun[stage] for stage, end in zip(begun, ends)}]))
if kept:
    write_cloud(kept, dense[:, :3], dense[:, 3:])
"""


class Point(NamedTuple):
    """One size: seconds, those of the processors, and peak memory beyond input and output, both in GiB."""

    points: int
    model: str
    seconds: float
    processor_seconds: float
    beyond_gib: float
    clouds_gib: float
    stages: dict[str, float]  # seconds


def network(name: str) -> str | nn.Module:
    """Weights that ship, or the paper's network as it begins: with offsets, so that points lie near the surface."""
    if name in weights.shipped_names():
        return name
    torch.manual_seed(0)
    return PNU(residual=True)


def wavy_sphere(n: int) -> np.ndarray:
    """Points and normals (n, 6) of a sphere with smooth hills, uniform at random over directions."""
    x = np.random.default_rng(n).normal(size=(n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    gradient = 0.05 * 6 * np.cos(6 * x) * np.roll(np.sin(6 * x), 1, axis=1)
    gradient += 0.05 * 6 * np.roll(np.sin(6 * x), -1, axis=1) * np.cos(6 * x)
    radius = 1 + 0.05 * (np.sin(6 * x) * np.roll(np.sin(6 * x), 1, axis=1)).sum(1, keepdims=True)
    tangential = gradient - (gradient * x).sum(1, keepdims=True) * x
    normals = radius * x - tangential
    return np.hstack([radius * x, normals / np.linalg.norm(normals, axis=1, keepdims=True)])


def curve(
    sizes: list[int], threads: int, models: Sequence[str] = ("surface",), keep: Path | None = None
) -> list[Point]:
    """keep: folder for the last of the results."""
    found = []
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    for model in models:
        for n in sizes:
            kept = str(keep / f"{model}_{n}.ply") if keep and n == sizes[-1] else ""
            command = [sys.executable, "-c", RUN, str(n), model, kept]
            done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
            found.append(Point(n, model, *json.loads(done.stdout)))
            print(found[-1], flush=True)
    return found


def exponent(curve: list[Point]) -> float:
    """Slope of log seconds over log points, least squares."""
    x, y = (np.log([getattr(point, name) for point in curve]) for name in ("points", "seconds"))
    return float(np.polyfit(x, y, 1)[0]) if len(curve) > 1 else math.nan


def lines(curve: list[Point]) -> list[str]:
    text = [
        "| points | x4, model | s | us a point made | processors, s | memory beyond the clouds, GiB |",
        "|---|---|---|---|---|---|",
    ]
    for point in curve:
        each = f"{point.seconds:.1f} | {1e6 * point.seconds / (4 * point.points):.0f} | {point.processor_seconds:.1f}"
        text.append(f"| {point.points} | {point.model} | {each} | {point.beyond_gib:.2f} |")
    for model in dict.fromkeys(point.model for point in curve):
        slope = exponent([point for point in curve if point.model == model])
        text += ["", f"time of {model} grows with the number of points to the power {slope:.2f}"]
        last = [point for point in curve if point.model == model][-1]
        shares = [f"{stage} {100 * seconds / last.seconds:.0f} %" for stage, seconds in last.stages.items()]
        text += ["", f"where it goes at {last.points} points: {', '.join(shares)}"]
    return text


def plot(curve: list[Point], path: Path) -> None:
    """Seconds and memory over points, both axes logarithmic, drawn with Pillow."""
    from PIL import Image, ImageDraw

    width, height, left, top = 900, 400, 60, 30
    image = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(image)
    panels = (("seconds", "seconds"), ("beyond_gib", "memory beyond the clouds, GiB"))
    x = np.log10([point.points for point in curve])
    for panel, (name, title) in enumerate(panels):
        values = np.log10(np.maximum([getattr(point, name) for point in curve], 1e-3))
        x0, y0 = left + panel * width // 2, height - 50
        box = width // 2 - left - 30, y0 - top
        lows, highs = (math.floor(x.min()), math.floor(values.min())), (math.ceil(x.max()), math.ceil(values.max()))
        spans = [max(high - low, 1) for low, high in zip(lows, highs, strict=True)]

        def place(a: float, b: float, x0=x0, y0=y0, box=box, lows=lows, spans=spans) -> tuple[float, float]:  # type: ignore[no-untyped-def]
            return x0 + box[0] * (a - lows[0]) / spans[0], y0 - box[1] * (b - lows[1]) / spans[1]

        for tick in range(lows[0], lows[0] + spans[0] + 1):
            draw.line([place(tick, lows[1]), place(tick, lows[1] + spans[1])], "#dddddd")
            draw.text((place(tick, lows[1])[0] - 12, y0 + 5), f"1e{tick}", "black")
        for tick in range(lows[1], lows[1] + spans[1] + 1):
            draw.line([place(lows[0], tick), place(lows[0] + spans[0], tick)], "#dddddd")
            draw.text((x0 - 45, place(0, tick)[1] - 6), f"{10.0**tick:g}", "black")
        draw.text((x0, 8), title, "black")
        draw.text((x0 + box[0] // 2 - 15, y0 + 22), "points", "black")
        for model, color in zip(dict.fromkeys(p.model for p in curve), ("#1f77b4", "#d62728", "#2ca02c"), strict=False):
            spots = [place(a, b) for a, b, p in zip(x, values, curve, strict=True) if p.model == model]
            draw.line(spots, color, width=2)
            for a, b in spots:
                draw.ellipse([a - 4, b - 4, a + 4, b + 4], color)
            draw.text((spots[-1][0] - 60, spots[-1][1] - 18), model, color)
    image.save(path)
