"""Depths that a sensor gives in steps wider than the points lie apart, as depth cameras do far away: made smooth.

Points of such a cloud lie on terraces, which neighborhoods take for the surface. Where a terrace ends tells where the
surface is: each point lies somewhere within half a step of its own. So depths are smoothed over neighborhoods that
span several steps, and none leaves its step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.even_spacing import perpendicular
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import spacing
from pnu.runtime.threads import thread_count

Floats = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST = 1000  # points that tell
SAME = 1e-3  # spacings by which depths of one step differ at most
PER_STEP = 20  # points, as a mean over all steps
BESIDE = 3  # gaps either side, of which the least is the step: the others have none of the surface between
WIDE = 1.05  # spacings of a step from which on; even grids have 1
PLACES, AROUND = 500, 24  # of the cloud, and neighbors, of which those of the same step
BROAD, MOSTLY = 0.02, 0.3  # spread in two directions, squared width over length, at this share of the places
BESIDES, NEXT = 64, (0.2, 2.5)  # neighbors, and spacings across to the nearest of them at another level,
FIFTH = 0.2  # of the places where that is least
PLANE, FLAT = 12, 1e-8  # points of a place that lie in a plane, as squared thickness over width says;
ALIKE, TENTH = 1e-6, 0.1  # one less the cosine between such planes, and the share of the places that has to have them
CELL, MID = 0.5, 0.25  # steps, size of the cells whose means are smoothed; of a cell, so that no step is its border
NEIGHBORS, ROUNDS = 64, 10
NARROW = 4.5  # of the weights exp(-4.5 r^2), r = 1 at the farthest neighbor
RIDGE = 1e-5  # on curvatures, for neighbors that do not tell them
ASLANT = 0.3  # cosine of a ray with depth from which on points move along it
ROWS, BLOCK = 2**16, 2**12  # points at once: bounds the memory


class DepthSteps(NamedTuple):
    """Depths of points, known to half a step."""

    depth: Floats  # (n,)
    step: Floats  # (n,) its width at each point, in the unit of the points
    direction: Floats  # (n, 3) unit, along which depth is measured
    way: Floats  # (n, 3) by which a point moves where its depth grows by one: along its ray, where a camera is known
    spacings: float  # median width over that of the points


def depth_steps(points: Floats, camera: Floats | None = None) -> DepthSteps | None:
    """The steps in which depths of points (n, 3) come, where they are wider than the spacing; None: nowhere.

    Depth may be measured along an axis, along the normal of flat terraces wherever the cloud was turned, or be the
    distance from the origin or from the place (3,) of a camera. Curves one above the other, as slices and the lines of
    a scanner, are no terraces; nor are even grids, whose steps are as wide as the spacing.
    """
    if len(points) < FEWEST:
        return None
    apart = spacing(points)
    places = np.lexsort(points.T)[:: -(-len(points) // PLACES)]  # the same ones in whatever order points come
    axes = [*np.eye(3), _terrace_normal(points, places)]
    depths = [(points @ axis, np.broadcast_to(axis, points.shape)) for axis in axes if axis is not None]
    depths += [_rays(points, place) for place in (np.zeros(3), camera) if place is not None]
    for depth, direction in depths:
        found = _levels(depth, SAME * apart)
        if found is None:
            continue
        level, step = found
        wide = float(np.median(step)) / apart
        if wide > WIDE and _are_terraces(points, level, direction, places, apart):
            return DepthSteps(depth, step, direction, _ways(points, direction, camera), wide)
    return None


def smoothed_within_steps(points: Floats, steps: DepthSteps) -> Floats:
    """The points (n, 3) of these steps on the surface, each within half a step of where it was.

    Ten rounds of local quadratic fits to the depths, which are held within their steps after each.
    """
    order = np.lexsort(points.T)  # of neighbors equally far away the same ones, in whatever order they come
    points = points[order]
    steps = steps._replace(**{name: getattr(steps, name)[order] for name in steps._fields[:-1]})
    cells = np.floor((points - points.min(0)) / (CELL * np.median(steps.step)) + MID).astype(np.int64)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(cell)
    place, direction, way, depth, half = (
        (np.stack([np.bincount(cell, column) for column in np.atleast_2d(values.T)], 1) / count[:, None]).squeeze()
        for values in (points, steps.direction, steps.way, steps.depth, steps.step / 2)
    )
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    smooth, within = depth, (depth - half, depth + half)  # the mean of depths lies within the mean of their bounds
    near, weight = _quadratic_fits(PointTree(place), place, direction)
    for _ in range(ROUNDS):
        smooth = np.clip((weight * smooth[near]).sum(1), *within)
    tree, moved = PointTree(place + (smooth - depth)[:, None] * way), np.empty_like(points)
    for start in range(0, len(points), ROWS):
        part = slice(start, start + ROWS)
        near, weight = _quadratic_fits(tree, points[part], steps.direction[part])
        half = steps.step[part] / 2
        change = np.clip((weight * smooth[near]).sum(1) - steps.depth[part], -half, half)
        moved[order[part]] = points[part] + change[:, None] * steps.way[part]
    return moved


def steps_words(steps: DepthSteps) -> str:
    """How wide they are."""
    return f"steps of depth of about {np.median(steps.step):.2g}, {steps.spacings:.1f} spacings"


def _rays(points: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Distance (n,) of points (n, 3) from a place (3,), and unit ways (n, 3) from it to them."""
    away = np.linalg.norm(points - place, axis=1)
    return away, (points - place) / np.maximum(away, 1e-300)[:, None]


def _ways(points: Floats, direction: Floats, camera: Floats | None) -> Floats:
    """`DepthSteps.way`."""
    if camera is None:
        return direction
    ray = _rays(points, camera)[1]
    along = (ray * direction).sum(1, keepdims=True)
    return np.where(np.abs(along) > ASLANT, ray / np.where(along == 0, 1, along), direction)


def _levels(depth: Floats, same: float) -> tuple[Index, Floats] | None:
    """Which of the levels each depth (n,) is of, from below, and how wide the step is there; None: there are none."""
    order = np.argsort(depth, kind="stable")
    gap = np.diff(depth[order])
    level = np.empty(len(depth), np.int64)
    level[order] = np.concatenate([[0], np.cumsum(gap > same)])
    count = int(level.max()) + 1
    if not 3 <= count <= len(depth) / PER_STEP:
        return None
    beside = np.pad(gap[gap > same], BESIDE, constant_values=np.inf)
    return level, np.lib.stride_tricks.sliding_window_view(beside, 2 * BESIDE).min(1)[level]


def _are_terraces(points: Floats, level: Index, direction: Floats, places: Index, apart: float) -> bool:
    """Whether points (n, 3) of one level spread over areas, not along curves, as some of them show, and those of the
    next level lie beside them: neither above each other nor far apart, as the corners of parts with walls do."""
    idx = PointTree(points).nearest(points[places], min(BESIDES, len(points)), threads=thread_count())[1]
    like = level[idx] == level[places, None]
    same = like[:, :AROUND, None].astype(np.float64)
    near = points[idx[:, :AROUND]]
    near = near - (same * near).sum(1, keepdims=True) / same.sum(1, keepdims=True)
    size = np.linalg.eigvalsh(near.swapaxes(1, 2) @ (same * near))
    if (size[:, 1] > BROAD * size[:, 2]).mean() <= MOSTLY:
        return False
    way, along = points[idx] - points[places, None], direction[places, None]
    across = np.linalg.norm(way - (way * along).sum(-1, keepdims=True) * along, axis=-1)
    beside = np.where(like, np.inf, across).min(1)
    beside = beside[np.isfinite(beside)]
    low, high = NEXT
    return len(beside) < TENTH * len(places) or low * apart < float(np.quantile(beside, FIFTH)) < high * apart


def _terrace_normal(points: Floats, places: Index) -> Floats | None:
    """The direction (3,) to which most planes through few neighbors of some of the points (n, 3) are exactly normal, if
    a tenth of them is."""
    near = points[PointTree(points).nearest(points[places], PLANE, threads=thread_count())[1]]
    near = near - near.mean(1, keepdims=True)
    size, axes = np.linalg.eigh(near.swapaxes(1, 2) @ near)
    normals = axes[size[:, 0] <= FLAT * size[:, 1], :, 0]
    if len(normals) < TENTH * len(places):
        return None
    alike = np.abs(normals @ normals.T) > 1 - ALIKE
    best = alike.sum(1).argmax()
    if alike[best].sum() < TENTH * len(places):
        return None
    mean = (normals[alike[best]] * np.sign(normals[alike[best]] @ normals[best])[:, None]).sum(0)
    normal: Floats = mean / np.linalg.norm(mean)
    return normal


def _quadratic_fits(sources: PointTree, target: Floats, direction: Floats) -> tuple[Index, Floats]:
    """For each target (m, 3) its neighbors among the sources, (m, k), and weights (m, k): with values at these
    their sum is that of a quadratic fit, over the plane across the direction (m, 3), at the target."""
    distance, near = sources.nearest(target, min(NEIGHBORS, len(sources.points)), threads=thread_count())
    radius = np.maximum(distance[:, -1:], 1e-300)
    aside = perpendicular(direction)
    across = np.stack([aside, np.cross(direction, aside)], -1)
    weights: Floats = np.exp(-NARROW * (distance / radius) ** 2)
    for start in range(0, len(target), BLOCK):
        part = slice(start, start + BLOCK)
        offset = (sources.points[near[part]] - target[part, None]) @ across[part] / radius[part, None]
        u, v = np.moveaxis(offset, -1, 0)
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)
        weighted = weights[part, :, None] * terms
        normal = terms.swapaxes(1, 2) @ weighted
        normal += normal[:, :1, :1] * np.diag([0.0, 1e-9, 1e-9, RIDGE, RIDGE, RIDGE])
        at_target = np.linalg.solve(normal, np.eye(6)[:, :1])
        weights[part] = (weighted @ at_target)[..., 0]
    return near, weights
