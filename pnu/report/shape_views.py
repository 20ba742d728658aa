"""Surfaces with their errors, figures and views of one shape."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu import reconstruction, rendering
from pnu.benchmark import SCANS, Case, Row
from pnu.benchmark.measuring import normals_of
from pnu.geometry.mesh_sampling import closest_points
from pnu.io import Mesh
from pnu.rendering.colors import typical_limit, value_colors
from pnu.report import offline_page

Picture = NDArray[np.uint8]

BYTES_POINT, BYTES_VERTEX = 12.0, 21.0  # in a page, packed
FEWEST = 1000  # points of a cloud that still show a shape
REACH = 4.0  # spacings from all points beyond which the surface of a scan is cut off


class ShownCase(NamedTuple):
    """A case with what the methods made of it; "input" comes first, with estimated normals if it had none."""

    case: Case
    clouds: dict[str, NDArray[np.float32]]  # (n, 3) or (n, 6)

    @classmethod
    def of(cls, case: Case) -> "ShownCase":
        """A case before any method: the input alone."""
        return cls(case, {"input": np.hstack([case.points, normals_of(case)]).astype(np.float32)})


class Look(NamedTuple):
    """How figures are drawn."""

    up: str = "y"
    azimuth: float = 30
    elevation: float = 15
    size: int = 320
    colormap: str = "error"


class Rebuilt(NamedTuple):
    """A surface made of a cloud, and its errors."""

    mesh: Mesh
    errors: reconstruction.SurfaceErrors


def rebuild(shown: ShownCase, seed: int = 0) -> tuple[dict[str, Rebuilt], list[str]]:
    """The surface of each cloud with normals, measured against the truth; and what went wrong, a line each.

    Those of scans end where the points end, as `pnu reconstruct` makes them.
    """
    made, notes = {}, []
    truth = shown.case.truth
    if truth.mesh is None:
        return {}, [f"{truth.shape}: has no true mesh to measure surfaces against"]

    def surface_of(cloud: np.ndarray) -> reconstruction.ReconstructedSurface | str:
        try:
            surface = reconstruction.reconstruct(cloud[:, :3], cloud[:, 3:])
            return reconstruction.cut_off(surface, cloud, REACH) if shown.case.kind in SCANS else surface
        except ValueError as error:
            return str(error)

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # of child processes with one thread each
        clouds = {name: cloud for name, cloud in shown.clouds.items() if cloud.shape[1] >= 6}
        found = dict(zip(clouds, pool.map(surface_of, clouds.values()), strict=True))
    for name, surface in found.items():
        where = f"{name}, {truth.shape}, {shown.case.kind}"
        if isinstance(surface, str):
            notes.append(f"{where}: {surface}")
            continue
        notes += [f"{where}: {text}" for text in surface.warnings()]
        count, rng = len(truth.samples), np.random.default_rng(seed)
        errors = reconstruction.surface_errors(surface.mesh, truth.mesh, rng=rng, samples=count)
        made[name] = Rebuilt(surface.mesh, errors)
    return made, notes


def error_limit(errors: Sequence[np.ndarray]) -> float:
    """One end of the colors for all: what 98 % of the errors of the median method stay below."""
    return float(np.median([typical_limit(error) for error in errors])) if errors else 1e-2


def view(shown: ShownCase, rebuilt: Mapping[str, Rebuilt], points: int) -> offline_page.ShapeView:
    """For the page's viewer: at most `points` points of each cloud, every k-th."""
    truth = shown.case.truth
    drawings, errors = [], []
    for name, full in shown.clouds.items():
        cloud = thinned(full, points)
        error = None if truth.mesh is None else closest_points(truth.mesh, cloud[:, :3].astype(np.float64))[1]
        if error is not None and name != "input":
            errors.append(error)
        surface = rebuilt.get(name)
        drawings.append(
            offline_page.Drawing(name, cloud, error, surface and surface.mesh, surface and surface.errors.distance)
        )
    drawings.append(
        offline_page.Drawing("truth", thinned(truth.samples, points), None, truth.mesh if rebuilt else None)
    )
    if rebuilt:
        errors = [surface.errors.distance for name, surface in rebuilt.items() if name != "input"]
    return offline_page.ShapeView(truth.shape, shown.case.kind, drawings, np.zeros(3), 1.0, error_limit(errors))


def thinned(cloud: np.ndarray, points: int) -> np.ndarray:
    """At most so many points of a cloud, evenly taken."""
    return cloud[:: -(-len(cloud) // points)]


def points_for(size_mb: float, clouds: int, vertices: int) -> int:
    """How many points of each cloud a page of that size holds beside surfaces of so many vertices in all."""
    points = int((size_mb * 1e6 - vertices * BYTES_VERTEX) / (BYTES_POINT * max(clouds, 1)))
    if points < FEWEST:
        raise ValueError(
            f"page_mb={size_mb:g}: too small for {clouds} clouds and {vertices} vertices of surfaces; "
            "raise it, or show fewer shapes, methods or kinds"
        )
    return points


def shape_figure(shown: ShownCase, rebuilt: Mapping[str, Rebuilt], look: Look) -> NDArray[np.uint8]:
    """The paper's figure of one shape: clouds by normals; where rebuilt, surfaces; and the surfaces by error."""
    truth = shown.case.truth
    camera = rendering.look_at(truth.samples, azimuth=look.azimuth, elevation=look.elevation, up=look.up)
    names = [*shown.clouds, "truth"]
    clouds = [or_crossed(rendering.render_cloud, cloud, camera, look) for cloud in shown.clouds.values()]
    clouds.append(rendering.render_cloud(truth.samples, camera=camera, size=look.size))
    if not rebuilt or truth.mesh is None:
        return rendering.figure(clouds, names, columns=len(names))
    kept = [name for name in names if name in rebuilt or name == "truth"]
    panels = [panel for name, panel in zip(names, clouds, strict=True) if name in kept]
    limit = error_limit([surface.errors.distance for name, surface in rebuilt.items() if name != "input"])
    bar = rendering.ColorBar((0, 1e3 * limit), "distance to the true surface, x 1e3 of its radius", look.colormap)
    rms = {name: 1e3 * float(np.sqrt((surface.errors.distance**2).mean())) for name, surface in rebuilt.items()}
    plain, colored = [], []
    for name in kept:
        mesh = rebuilt[name].mesh if name in rebuilt else truth.mesh
        colors = value_colors(rebuilt[name].errors.distance, (0, limit), look.colormap) if name in rebuilt else None
        plain.append(or_crossed(rendering.render_mesh, mesh, camera, look))
        colored.append(or_crossed(rendering.render_mesh, mesh, camera, look, colors))
    below = [f"{name}\nRMS {rms[name]:.2f}" if name in rms else name for name in kept]
    captions = [""] * (2 * len(kept)) + below
    return rendering.figure([*panels, *plain, *colored], captions, columns=len(kept), colorbar=bar)


def or_crossed(render: Callable[..., Picture], what: Any, camera: rendering.Camera, look: Look, *args: Any) -> Picture:
    """A panel, or a gray cross where a method's result is nowhere near the true shape."""
    try:
        return render(what, *args, camera=camera, size=look.size)
    except ValueError:
        panel = np.full((look.size, look.size, 3), 255, np.uint8)
        middle = np.arange(look.size // 3, 2 * look.size // 3)
        panel[middle, middle] = panel[middle, look.size - 1 - middle] = 160
        return panel


def surface_rows(case: Case, rebuilt: Mapping[str, Rebuilt]) -> list[Row]:
    """Errors of the surfaces, a row for each method, in units of the true radius."""
    head = {"shape": case.truth.shape, "kind": case.kind}
    return [head | {"method": name} | surface.errors.summary() for name, surface in rebuilt.items()]
