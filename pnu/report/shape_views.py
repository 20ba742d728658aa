"""Surfaces with their errors, figures and views of one shape."""

import functools
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
from pnu.geometry.spacing import spacing
from pnu.io import Mesh
from pnu.rendering.colors import typical_limit, value_colors
from pnu.report import offline_page

Picture = NDArray[np.uint8]

BYTES_POINT, BYTES_VERTEX = 12.0, 21.0  # in a page, packed
FEWEST = 1000  # points of a cloud that still show a shape
BALL = 0.9  # radius of a point in a picture of normals, in spacings of as many even points
FARTHEST = 1.25  # of what the true shape takes: what reaches beyond that is cut off in pictures
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


def shape_figure(shown: ShownCase, rebuilt: Mapping[str, Rebuilt], look: Look) -> Picture:
    """The paper's figure of one shape: clouds by normals; where rebuilt, surfaces; and the surfaces by error."""
    truth = shown.case.truth
    camera = camera_of(shown, rebuilt, look)
    names = [*shown.clouds, "truth"]
    clouds = [or_crossed(rendering.render_cloud, cloud, camera, look) for cloud in shown.clouds.values()]
    clouds.append(rendering.render_cloud(truth.samples, camera=camera, size=look.size))
    if not rebuilt or truth.mesh is None:
        return rendering.figure(clouds, names, columns=len(names))
    kept = [name for name in names if name in rebuilt or name == "truth"]
    panels = [panel for name, panel in zip(names, clouds, strict=True) if name in kept]
    bar = error_bar([rebuilt], look)
    panels += surface_panels(shown, rebuilt, kept, look, bar)
    captions = [""] * (2 * len(kept)) + [surface_caption(name, rebuilt) for name in kept]
    return rendering.figure(panels, captions, columns=len(kept), colorbar=bar)


def shapes_figure(shapes: Sequence[tuple[ShownCase, Mapping[str, Rebuilt]]], look: Look) -> Picture:
    """The paper's figure of several shapes, each seen by one camera: its surfaces and below them the same by error, on
    one scale for all."""
    names = [*shapes[0][0].clouds, "truth"]
    bar = error_bar([made for _, made in shapes], look)
    panels: list[Picture] = []
    captions: list[str] = []
    for one, made in shapes:
        panels += surface_panels(one, made, names, look, bar)
        captions += [""] * len(names) + [surface_caption(name, made) for name in names[:-1]]
        captions.append(f"truth\n{one.case.truth.shape}")
    return rendering.figure(panels, captions, columns=len(names), colorbar=bar)


def normals_figure(
    shown: Sequence[ShownCase], errors: Mapping[tuple[str, str, str], float | None], look: Look
) -> Picture:
    """Clouds by their normals, a row for each shape, seen by one camera; `errors` of the normals, in degrees, by shape,
    kind and method."""
    panels, captions = [], []
    for one in shown:
        truth, camera = one.case.truth, camera_of(one, {}, look)
        even = BALL * spacing(truth.samples[:, :3]) * len(truth.samples) ** 0.5  # of balls as close as the truth's
        for cloud in (*one.clouds.values(), truth.samples):
            render = functools.partial(rendering.render_cloud, radius=even / len(cloud) ** 0.5)
            panels.append(or_crossed(render, cloud, camera, look))
        for name in one.clouds:
            error = errors.get((truth.shape, one.case.kind, name))
            captions.append(name if error is None else f"{name}\n{error:.1f} degrees")
        captions.append(f"truth\n{truth.shape}")
    return rendering.figure(panels, captions, columns=len(panels) // len(shown))


def camera_of(shown: ShownCase, rebuilt: Mapping[str, Rebuilt], look: Look) -> rendering.Camera:
    """The camera that sees the true shape, and what the methods made of it unless that lies far off."""
    truth = rendering.look_at(shown.case.truth.samples, azimuth=look.azimuth, elevation=look.elevation, up=look.up)
    made = [
        *(cloud[:, :3] for cloud in shown.clouds.values()),
        *(surface.mesh.vertices for surface in rebuilt.values()),
    ]
    reach = max(float(np.abs(truth.view(points)[:, :2]).max()) for points in made)
    return truth._replace(half_size=truth.half_size * min(FARTHEST, max(1, 1.03 * reach)))


def error_bar(rebuilt: Sequence[Mapping[str, Rebuilt]], look: Look) -> rendering.ColorBar:
    """The scale of errors for all surfaces of some shapes, in thousandths of the true radius."""
    distances = [surface.errors.distance for made in rebuilt for name, surface in made.items() if name != "input"]
    label = "distance to the true surface, x 1e3 of its radius"
    return rendering.ColorBar((0, 1e3 * error_limit(distances)), label, look.colormap)


def surface_panels(
    shown: ShownCase, rebuilt: Mapping[str, Rebuilt], names: Sequence[str], look: Look, bar: rendering.ColorBar
) -> list[Picture]:
    """A row of the surfaces of these names, and one of the same colored by error; "truth" is gray in both."""
    camera = camera_of(shown, rebuilt, look)
    plain, colored = [], []
    for name in names:
        made = rebuilt.get(name)
        mesh = made.mesh if made else shown.case.truth.mesh if name == "truth" else None
        colors = value_colors(1e3 * made.errors.distance, bar.limits, bar.colormap) if made else None
        plain.append(or_crossed(rendering.render_mesh, mesh, camera, look))
        colored.append(or_crossed(rendering.render_mesh, mesh, camera, look, colors))
    return [*plain, *colored]


def surface_caption(name: str, rebuilt: Mapping[str, Rebuilt]) -> str:
    """The name, and the error of its surface where it has one."""
    if name not in rebuilt:
        return name
    return f"{name}\nRMS {1e3 * float(np.sqrt((rebuilt[name].errors.distance ** 2).mean())):.2f}"


def or_crossed(render: Callable[..., Picture], what: Any, camera: rendering.Camera, look: Look, *args: Any) -> Picture:
    """A panel, or a gray cross where a method has no result (None) or one nowhere near the true shape."""
    try:
        if what is None:
            raise ValueError("no surface")
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
