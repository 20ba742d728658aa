"""How the field compares: what goes in, what counts as the truth, and which distance is called CD, HD and P2F."""

import csv
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from pnu.geometry.unit_sphere import unit_sphere_frame
from pnu.metrics import METRICS, Metric, Pair, Shown
from pnu.metrics.declared import P2F, ChamferSq, HausdorffSq

PUBLISHED = Path(__file__).with_name("published.csv")
FRAMES = {
    "truth": "in the truth's unit sphere",
    "each": "each cloud in a unit sphere of its own",
}
CHAMFER = {"sum": "both directions added", "half": "mean of both directions"}
HAUSDORFF = {"max": "the larger maximum of the squared distances", "sum": "both maxima of the squared distances added"}


class Protocol:
    """Sampling, frame and definitions of a comparison; docs/metrics.md says whose code each choice of conf/ stands for.

    Args:
        points: of an input cloud; what the command's points= says goes before it
        truth_points: of the truth; null: ratio times those of the input
        inputs: how they are drawn: poisson, apart from the truth; random, by area; subset, some of the truth's points
        frame: of CD and HD: truth, its unit sphere; each, every cloud in one of its own, P2F in the mesh's unit
        chamfer: sum of both directions, or half of it
        hausdorff: max, the larger of both maxima of squared distances, or their sum
        noise_limit: greatest offset by noise along an axis, of the radius; null: none
        kinds: of input, where the command's kinds= says nothing
        published: rows that are printed beside: pugan or pu1k; null: none
    """

    def __init__(
        self,
        points: int = 5000,
        truth_points: int | None = None,
        inputs: Literal["poisson", "random", "subset"] = "poisson",
        frame: Literal["truth", "each"] = "truth",
        chamfer: Literal["sum", "half"] = "sum",
        hausdorff: Literal["max", "sum"] = "max",
        noise_limit: float | None = None,
        kinds: Sequence[str] = ("uniform",),
        published: str | None = None,
    ) -> None:
        for name, value, least in (("points", points, 64), ("truth_points", truth_points, 150)):
            if value is not None and value < least:
                raise ValueError(f"protocol.{name}={value}: expected at least {least}")
        self.points, self.inputs, self.kinds, self.published = points, inputs, tuple(kinds), published
        self.wanted_truth, self.noise_limit = truth_points, noise_limit
        self.frame, self.chamfer, self.hausdorff = frame, chamfer, hausdorff

    def truth_points(self, points: int, ratio: float) -> int:
        """Points of the truth for inputs of so many points and a ratio."""
        return self.wanted_truth or round(ratio * points)

    def metrics(self, metrics: Sequence[Metric] = METRICS) -> tuple[Metric, ...]:
        """The metrics, CD, HD and P2F as this protocol defines them."""
        if (self.frame, self.chamfer, self.hausdorff) == ("truth", "sum", "max"):
            return tuple(metrics)
        own = FrameChamfer(self.frame, self.chamfer), FrameHausdorff(self.frame, self.hausdorff), MeshUnitP2F()
        first = own if self.frame == "each" else (*own[:2], P2F())
        return (*first, *(m for m in metrics if not isinstance(m, ChamferSq | HausdorffSq | P2F)))

    @property
    def said(self) -> dict[str, Any]:
        """What a file of results keeps of it."""
        return dict(zip(("inputs", "frame", "chamfer", "hausdorff"), self.definition, strict=True))

    @cached_property
    def definition(self) -> tuple[str, ...]:
        """What must be equal for two tables to be set beside each other."""
        return self.inputs, self.frame, self.chamfer, self.hausdorff

    def published_rows(self, ratio: float) -> list["PublishedRow"]:
        """Published rows of the protocol with these very definitions and that ratio, without noise first."""
        return [
            row
            for row in published_rows()
            if row.protocol == self.published and row.ratio == ratio and row.definition == self.definition
        ]


class FrameChamfer(Metric):
    """Chamfer distance of squared distances in the frame of a protocol."""

    def __init__(self, frame: str, chamfer: str) -> None:
        self.frame, self.share = frame, 0.5 if chamfer == "half" else 1.0
        name = "chamfer_sq" + "_half" * (chamfer == "half") + "_each" * (frame == "each")
        self.shown = Shown(name, f"CD x 1e3 ({CHAMFER[chamfer]}, {FRAMES[frame]})", "CD", 1e3, "length squared", ".4f")
        self.words = f"CD: mean squared distances, {CHAMFER[chamfer]}, {FRAMES[frame]}"

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,)."""
        pair = framed(pair, self.frame)
        return self.share * (pair.forth.dist_sq.mean(1) + pair.back.dist_sq.mean(1))


class FrameHausdorff(Metric):
    """Hausdorff distance, squared, in the frame of a protocol."""

    def __init__(self, frame: str, hausdorff: str) -> None:
        self.frame, self.sum = frame, hausdorff == "sum"
        name = "hausdorff_sq" + "_sum" * self.sum + "_each" * (frame == "each")
        self.shown = Shown(name, f"HD x 1e3 ({HAUSDORFF[hausdorff]}, {FRAMES[frame]})", "HD", 1e3, "length squared")
        self.words = f"HD: {HAUSDORFF[hausdorff]}, {FRAMES[frame]}"

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,)."""
        pair = framed(pair, self.frame)
        forth, back = pair.forth.dist_sq.amax(1), pair.back.dist_sq.amax(1)
        return forth + back if self.sum else torch.maximum(forth, back)


class MeshUnitP2F(Metric):
    """Mean distance to the true mesh in the unit of its file."""

    shown = Shown("p2f_mesh_unit", "P2F x 1e3 (mesh's unit)", "P2F", 1e3, "length")
    needs = ("mesh",)
    words = "P2F: mean distance to the true mesh in the unit of its file"

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,)."""
        return pair.unit * pair.prediction.new_tensor(pair.on_mesh[0].mean(1))


def framed(pair: Pair, frame: str) -> Pair:
    """The pair itself, or one whose clouds are each centered and scaled by themselves, made once for all metrics."""
    if frame == "truth" or pair.target is None:
        return pair
    if pair.each is None:
        own = [unit_sphere_frame(cloud).to_unit(cloud)[..., :3] for cloud in (pair.prediction, pair.target)]
        pair.each = Pair(own[0], own[1])
    return pair.each


class PublishedRow(NamedTuple):
    """A row of somebody's table: CD, HD, P2F, all x 1e3."""

    protocol: str
    shapes: str
    ratio: float
    method: str
    cd: float
    hd: float
    p2f: float
    definition: tuple[str, ...]
    source: str


def published_rows() -> list[PublishedRow]:
    """All rows of published.csv."""
    with PUBLISHED.open(encoding="utf-8", newline="") as file:
        return [published_row(row) for row in csv.DictReader(file)]


def published_row(row: dict[str, Any]) -> PublishedRow:
    """A row as the file has it."""
    ratio, cd, hd, p2f = (float(row[name]) for name in ("ratio", "cd", "hd", "p2f"))
    definition = tuple(row[name] for name in ("inputs", "frame", "chamfer", "hausdorff"))
    return PublishedRow(row["protocol"], row["shapes"], ratio, row["method"], cd, hd, p2f, definition, row["source"])


def print_published(rows: Sequence[PublishedRow]) -> None:
    """A table of its own: none of these rows was measured here."""
    from rich.console import Console
    from rich.table import Table

    if not rows:
        return
    console = Console(width=max(Console().width, 118), highlight=False)
    title = f"Published on {rows[0].shapes}, x{rows[0].ratio:g}; not measured here"
    table = Table(title=title, title_justify="left", title_style="bold")
    for name in ("method", "CD", "HD", "P2F", "source"):
        table.add_column(name, justify="left" if name in ("method", "source") else "right")
    for row in rows:
        table.add_row(row.method, f"{row.cd:.3f}", f"{row.hd:.2f}", f"{row.p2f:.2f}", row.source)
    console.print(table)
