"""What is done with one tile of a large cloud, on its own: prepared, then made dense.

Nothing but the plan and the facts of the prepared tiles enters, so tiles are made in any order, by any process of any
machine that sees the folder, and always the same. Where tiles meet, `pnu.upsamplers.tile_seams` evens the points out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.cleaning import stray_points
from pnu.geometry.anisotropy import averaged, mean_normals
from pnu.geometry.cloud_normals import normals_on_sides
from pnu.geometry.depth_steps import depth_steps, smoothed_within_steps
from pnu.geometry.even_spacing import RANK, tangent_discs
from pnu.geometry.farthest_sampling import thinned_to
from pnu.geometry.normal_estimation import complete_normals
from pnu.geometry.normal_sides import seen_signs, voted_signs
from pnu.geometry.point_tree import PointTree
from pnu.geometry.thick_layers import layer_means
from pnu.geometry.unit_sphere import Frame, unit_sphere_frame
from pnu.io import atomic_path, read_json, write_json
from pnu.io.sensor import asked_sight
from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.context import Context
from pnu.upsamplers.density import DENSITIES, SOME, THINNED, groups_of_like_spacing, point_areas
from pnu.upsamplers.inference import LoadedWeights, inferring, modules_of, on_device, weights_source
from pnu.upsamplers.selection import is_projection
from pnu.upsamplers.surface_projection import SurfaceProjection
from pnu.upsamplers.tile_plan import SMALLEST, Plan, attributes_of, structured
from pnu.upsamplers.unit_normals import with_unit_normals
from pnu.upsamplers.whole_clouds import output_count

SURPLUS = 0.01  # points made too many, so that an exact number is left where tiles come out a little different
PLACES = 20_000  # of a tile, around which its area is measured
SEEDS = 16  # around each of them
REMEMBERED = 1000  # areas of a tile that stand for all
EDGE = 0.65  # spacings that points are made beyond the last of a tile and its margin
VOTES = 0.75  # spacings around a point of the coarse cloud where it tells the side
WIDTH = 4.0  # spacings on each side of a border where points move

Known = Callable[[NDArray[np.float64]], NDArray[np.bool_]]
"""Which places (k, 3) in the unit sphere of a tile count, (k,)."""


def run_of(plan: Plan) -> str:
    """The weights for all tiles of a plan."""
    none_given = None if not plan.facts.trusted else np.empty((0, 3))
    return str(weights_source(plan.keys.run, none_given, plan.facts.character))


def loaded(run: str, device: str = "auto") -> Any:
    """The network of a run, which must be one that projects.

    Raises:
        ValueError: it is another one.
    """
    network = LoadedWeights(run).network(np.empty((0, 3)), device=device)
    if not is_projection(network):
        raise ValueError(f"run={run}: takes the cloud as a whole, without memory= and tiles=; surface takes tiles")
    return network


@contextmanager
def working(run: str, device: str = "auto") -> Iterator[SurfaceProjection]:
    """The upsampler with the network of a run on a device, made fast, without gradients."""
    network, _ = on_device(loaded(run, device), False, device)
    with inferring(network):
        yield SurfaceProjection(network)


def context_of(upsampler: SurfaceProjection, **options: Any) -> Context:
    """How an upsampler runs whose network may lie on a device."""
    modules = modules_of(upsampler.network)
    return Context(next(modules[0].parameters()).device if modules else "cpu", **options)


class Share(NamedTuple):
    """What a tile has of the whole, in the unit of the cloud."""

    points: int  # that it has after cleaning,
    area: float  # of the surface in its cell
    areas: list[float]  # that some of its points stand for,
    each: float  # as many points each
    spread: float  # sum of all such areas of the points as they were read; 0 where nobody asks
    stray: int


def prepared(plan: Plan, number: int) -> None:
    """A tile cleaned, with normals, and its share: files `cloud` and `share`."""
    if plan.path("share", number, ".json").is_file():
        return
    keys, facts = plan.keys, plan.facts
    rows = plan.region(number)
    own = len(np.load(plan.path("points", number), mmap_mode="r"))
    spread = float(point_areas(rows["point"])[:own].sum()) if keys.spacing is not None else 0.0
    if facts.steps is not None and (steps := depth_steps(rows["point"])) is not None:
        rows["point"] = smoothed_within_steps(rows["point"], steps)
    stray = stray_points(rows["point"]) if keys.outliers == "auto" else np.zeros(len(rows), bool)
    strays = int(stray[:own].sum())
    rows = rows[~stray]
    if facts.lined is not None and len(rows) > SMALLEST:
        kept = thinned_to(rows["point"], facts.lined)
        rows = _in_place(rows, kept, averaged(rows["point"], kept))
    elif facts.layered is not None and len(rows) > SMALLEST:
        means = layer_means(rows["point"], facts.layered, SMALLEST)
        turned = mean_normals(rows["point"], means.rows, rows["normal"]) if facts.given else None
        rows = _in_place(rows, means.rows, means.points)
        if turned is not None:
            rows["normal"] = turned
    rows = rows[np.lexsort(rows["point"].T)]
    points = rows["point"]
    if len(rows) < SMALLEST:  # a few points in the air
        normals = np.broadcast_to([0.0, 0.0, 1.0], (len(rows), 3))
    else:
        normals = _normals(plan, rows)
        if facts.poor:
            normals = normals_on_sides(points, normals, sure=True).normals
    attributes = attributes_of(rows)
    inside = plan.cells.inside(points, number)
    share = Share(int(inside.sum()), 0.0, [], 0.0, spread, strays)
    if share.points and len(rows) >= SMALLEST:
        cloud, frame = in_unit_sphere(points, normals)
        scale = frame.scale.item() ** 2
        areas = point_areas(points)[inside]
        some = np.sort(areas)[:: -(-len(areas) // REMEMBERED)]
        area = surface_area(cloud, inside, partial(_known, plan, number, frame)) * scale
        share = share._replace(area=area, areas=some.tolist(), each=share.points / len(some))
    with atomic_path(plan.path("cloud", number)) as temporary:
        np.save(temporary, structured(points, normals, attributes))
    write_json(plan.path("share", number, ".json"), share._asdict())


def _in_place(rows: NDArray[Any], kept: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[Any]:
    """Those of the rows (n,) that are kept (m,), at other points (m, 3)."""
    found = rows[kept]
    found["point"] = points
    return found


def _normals(plan: Plan, rows: NDArray[Any]) -> NDArray[np.float64]:
    """A unit normal for each point, on the side that holds all over the cloud."""
    facts, keys = plan.facts, plan.keys
    given = rows["normal"] if facts.given else None
    cloud, frame = in_unit_sphere(rows["point"], np.zeros((len(rows), 3)))
    unit = cloud[:, :3]
    known = np.zeros(len(rows), bool) if given is None else np.isfinite(given).all(1)
    asked = asked_sight(keys.viewpoint, keys.up, keys.side)
    anew = ~known | (keys.normals == "orient")
    if keys.normals == "auto" and (asked is not None or facts.turned):
        anew[:] = True
    if given is not None and not anew.any():
        return given
    lines = complete_normals(unit, given if known.any() else None)
    if known.any() and not anew[known].any() and asked is None:
        return lines  # those that were missing, to the side of the nearest
    sight = plan.sight(attributes_of(rows))
    if sight is not None and sight.inward is None:
        place = sight.viewpoint
        if place is not None:
            place = (place - frame.center) / frame.scale
            place = place[0] if sight.viewpoint is not None and sight.viewpoint.ndim == 1 else place
        places = None if sight.places is None else (sight.places - frame.center) / frame.scale
        sign = seen_signs(unit, lines, viewpoint=place, up=sight.up, places=places)
    else:
        sign = voted_signs(unit, lines, _votes(plan, rows["point"], lines))
    return lines * np.where(anew, sign, 1.0)[:, None]


def _votes(plan: Plan, points: NDArray[np.float64], lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """How the coarse cloud's normals speak for the lines at points (n, 3), (n,): 0 where it has none."""
    coarse = plan.coarse()
    distance, near = PointTree(coarse[:, :3]).nearest(points, 1)
    votes: NDArray[np.float64] = (lines * coarse[near[:, 0], 3:]).sum(1)
    votes[distance[:, 0] > VOTES * plan.facts.apart] = 0
    return votes


def in_unit_sphere(points: np.ndarray, normals: np.ndarray) -> tuple[NDArray[np.float64], Frame]:
    """A cloud (n, 6) in the unit sphere, and the way back."""
    cloud = np.hstack([points, normals])
    frame = unit_sphere_frame(cloud)
    return frame.to_unit(cloud), frame


def surface_area(cloud: NDArray[np.float64], inside: NDArray[np.bool_], known: Known) -> float:
    """Area of the surface around those points of a cloud (n, 6) that are `inside`, (n,).

    On a disc around each of some of them: the share that no other point is nearer to. known: which places (k, 3) count,
    those where a point would be among the cloud.
    """
    rows = np.flatnonzero(inside)
    some = rows[:: -(-len(rows) // PLACES)]
    cloud = cloud[np.concatenate([some, np.setdiff1d(np.arange(len(cloud)), some)])]
    discs: NDArray[Any] = tangent_discs(cloud[:, :3], cloud[:, 3:], SEEDS, first=len(some))
    tree = PointTree(cloud[:, :3])
    radius = tree.nearest(cloud[: len(some), :3], min(RANK, len(cloud) - 1) + 1)[0][:, -1]
    nearest = tree.nearest(discs.reshape(-1, 3), 1)[1].reshape(len(some), SEEDS)
    counts = known(discs.reshape(-1, 3)).reshape(len(some), SEEDS)
    own = (counts & (nearest == np.arange(len(some))[:, None])).mean(1)
    return float((np.pi * radius**2 * own).sum() * len(rows) / len(some))


def _known(plan: Plan, number: int, frame: Frame, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which places (k, 3) in the unit sphere of a tile lie where it gets points, in cell and margin, (k,)."""
    reach = plan.facts.margin + EDGE * plan.facts.apart
    return plan.cells.inside(frame.from_unit(places), number, reach)


class Whole(NamedTuple):
    """What the shares of all tiles come to."""

    points: int  # to be made
    density: float  # of them in an area, where they are spread evenly; 0: after the points' own
    level: float  # of `even_above_floor`: points in an area, and at least
    floor: float  # so many a point
    widest: float  # spacing of the points made, where it is widest
    tiles: dict[int, Share]


def whole_of(plan: Plan) -> Whole:
    """The shares of all tiles together.

    Raises:
        ValueError: a tile is not prepared, or ratio and spacing ask for what cannot be.
    """
    keys, facts = plan.keys, plan.facts
    shares = {number: Share(**read_json(plan.path("share", number, ".json"))) for number in plan.tiles}
    ratio = keys.ratio
    if keys.spacing is not None:
        ratio = round(sum(share.spread for share in shares.values()) / keys.spacing**2) / facts.points
        if ratio < 1:
            raise ValueError(
                f"spacing={keys.spacing:g}: the points are nearer to each other, {keys.spacing * ratio**0.5:.3g}; "
                "give a smaller one"
            )
    count = output_count(facts.points, ratio)
    left = sum(share.points for share in shares.values())
    area = sum(share.area for share in shares.values())
    if keys.density not in DENSITIES:
        raise ValueError(f"density={keys.density}: expected {', '.join(DENSITIES)}")
    areas = np.concatenate([share.areas or [0.0] for share in shares.values()])
    weight = np.concatenate([np.full(max(len(share.areas), 1), share.each) for share in shares.values()])
    total = float(weight @ areas)
    if not total:
        raise ValueError(f"{keys.input}: no tile has {SMALLEST} points; give more memory")
    if keys.density == "follow":
        return Whole(count, 0.0, 0.0, count / left, math.sqrt(areas.max() * left / count), shares)
    even = count * areas / total
    if keys.density == "even" or count < left or weight[even < THINNED].sum() < SOME * left:
        return Whole(count, count / area, 0.0, 0.0, math.sqrt(area / count), shares)
    level, floor = _level(areas, weight, count, left)
    counts = np.maximum(floor, level * areas)
    return Whole(count, 0.0, level, floor, float(np.sqrt(areas / counts).max()), shares)


def _level(areas: np.ndarray, weight: np.ndarray, count: int, left: int) -> tuple[float, float]:
    """As `even_above_floor` for areas that stand for several points each: points in an area, and at least a point."""
    floor = math.sqrt(count / left)
    low, high = 0.0, count / max(float(areas[areas > 0].min()), 1e-300)
    for _ in range(200):
        middle = (low + high) / 2
        if float(weight @ np.maximum(floor, middle * areas)) > count:
            high = middle
        else:
            low = middle
    return low, floor


def spacing_between(whole: Whole) -> float:
    """The distance between points made, where it is widest."""
    return 1.08 * whole.widest  # as in a hexagonal pattern


def beside_borders(whole: Whole) -> float:
    """How far on each side of a border points move when tiles are joined."""
    return WIDTH * spacing_between(whole)


def made(plan: Plan, number: int, whole: Whole, upsampler: SurfaceProjection, progress: Progress = silent) -> None:
    """A tile made dense, all tiles being prepared: file `made`, the points in its cell, those kept first."""
    if plan.path("made", number).is_file():
        return
    facts = plan.facts
    rows = np.load(plan.path("cloud", number))
    if whole.tiles[number].area == 0:
        _save(plan, number, np.empty((0, 6)), 0)
        return
    context = context_of(upsampler, progress=progress, keep=facts.keep)
    measured, smooth, frame = looked_at(plan, rows, upsampler, context)
    cloud = frame.to_unit(np.hstack([rows["point"], rows["normal"]]))
    near = plan.cells.depth(rows["point"], number) < beside_borders(whole) + facts.margin
    with atomic_path(plan.path("border", number)) as temporary:
        np.save(temporary, smooth[near].astype(np.float32))
    found: list[NDArray[np.float64]] = []
    kept = 0
    for group, count in _groups(rows["point"], cloud, frame, whole, partial(_known, plan, number, frame)):
        others = np.setdiff1d(np.arange(len(cloud)), group)
        fixed = measured[group if facts.keep else group[:0], :6]
        order = np.concatenate([group, others])
        raw = upsampler.spread(smooth[order], fixed, len(group), max(count, len(fixed)), context, part=True)
        dense = frame.from_unit(with_unit_normals(raw, smooth))
        if facts.keep:
            dense[: len(group), :3] = rows["point"][group]
            if facts.trusted:
                dense[: len(group), 3:] = rows["normal"][group]
            kept += int(plan.cells.inside(rows["point"][group], number).sum())
            found.insert(0, dense[: len(group)])
            found.append(dense[len(group) :])
        else:
            found.append(dense)
    points = np.concatenate(found)
    _save(plan, number, points[plan.cells.inside(points[:, :3], number)], kept)


def looked_at(
    plan: Plan, rows: NDArray[Any], upsampler: SurfaceProjection, context: Context
) -> tuple[NDArray[np.float64], NDArray[np.float64], Frame]:
    """The points of a tile as the network looks at them, measured, and smoothed where they are noisy, both (n, 6 +
    messages) in the unit sphere, and the way back."""
    cloud, frame = in_unit_sphere(rows["point"], rows["normal"])
    measured = upsampler.with_refined_normals(cloud, upsampler.network.passes, context)
    noisy = plan.facts.smooth and not plan.facts.keep
    return measured, (upsampler.smoothed if noisy else upsampler.settled)(measured, context), frame


def looked_at_beside_borders(
    plan: Plan, number: int, upsampler: SurfaceProjection, context: Context
) -> tuple[NDArray[np.float64], Frame]:
    """The points near the borders of a tile that was made, as the network looks at them, and the way back."""
    rows = np.load(plan.path("cloud", number))
    if not plan.path("border", number).is_file():  # of an older version
        return looked_at(plan, rows, upsampler, context)[1:]
    frame = in_unit_sphere(rows["point"], rows["normal"])[1]
    return np.load(plan.path("border", number)).astype(np.float64), frame


def _save(plan: Plan, number: int, dense: np.ndarray, kept: int) -> None:
    write_json(plan.path("kept", number, ".json"), kept)
    with atomic_path(plan.path("made", number)) as temporary:
        np.save(temporary, dense)


def _groups(
    points: NDArray[np.float64],
    cloud: NDArray[np.float64],
    frame: Frame,
    whole: Whole,
    known: Known,
) -> list[tuple[NDArray[np.int64], int]]:
    """Rows of points (n, 3) whose new points lie about as far apart, and how many these are."""
    everything = np.arange(len(points))
    if whole.density:
        area = surface_area(cloud, np.ones(len(points), bool), known) * frame.scale.item() ** 2
        return [(everything, round((1 + SURPLUS) * whole.density * area))]
    areas = point_areas(points)
    counts = (1 + SURPLUS) * np.maximum(whole.floor, whole.level * areas)
    return groups_of_like_spacing(points, counts, round(float(counts.sum())), widest=whole.widest)
