"""Normals of a whole cloud: whose axes are taken, what decides their side, and what is to be said of it."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from pnu.geometry.cloud_statistics import CONTRADICTING, contradicting
from pnu.geometry.clutter import clutter_points
from pnu.geometry.depth_steps import depth_steps, smoothed_within_steps, steps_words
from pnu.geometry.flipped_parts import flipped_share
from pnu.geometry.normal_estimation import complete_normals, orient_normals, refit_normals
from pnu.geometry.normal_sides import hidden, largest_piece, repaired_signs, seen_signs
from pnu.geometry.orientation import NeighborCloud, gauss_law
from pnu.geometry.point_tree import PointTree
from pnu.geometry.scanner_within import scanner_within
from pnu.geometry.single_view import camera_place, is_camera, seen_from_one_side
from pnu.geometry.thick_layers import layer_means, layer_noise
from pnu.geometry.unit_sphere import unit_sphere_frame
from pnu.io.sensor import Sight
from pnu.runtime.progress import Progress, silent

Choice = Literal["auto", "estimate", "orient", "keep"]
Refine = Callable[[np.ndarray, np.ndarray, Progress], np.ndarray]
"""points (n, 3) in the unit sphere, rough normals (n, 3) whose sides agree -> better ones (n, 3)."""
OUTWARD = "outward, by the winding field"
ONE_SIDE, FROM_ABOVE = "to where all of it was seen from, one side", "up, as land that was seen from above"
GROUND = "up, as ground and what stands on it"
UP = np.array([0.0, 0.0, 1.0])
LEVEL = 0.7  # height of the mean normal of what is mostly ground
TELLING, MISSED = 1000, 0.15  # points of a sensor that tell whether it saw them, and their share that it may not have
MOST_SCANS = 100  # whose scanners are looked for
FAR = 100.0  # extents of a cloud from it to where it was seen from
MISTAKEN = 0.02  # share of the points in a smooth piece on the wrong side from which on a closed shape decides
AGAINST = 0.2  # as much may Gauss' law speak for the other side: things on a ground are open below


class Settled(NamedTuple):
    """Normals, and what is to be said of them."""

    normals: np.ndarray  # (n, 3) of length 1
    words: str  # a line: how many are whose, how many were turned over, what decided their side
    side: str  # what decided that; empty where all are as given
    seen: bool = False  # it was a sensor, or what was asked for, and not the shape


def settled_normals(
    points: np.ndarray,
    normals: np.ndarray | None,
    *,
    choice: Choice = "auto",
    asked: Sight | None = None,
    found: Sight | None = None,
    scans: np.ndarray | None = None,
    neighbors: int = 16,
    refine: Refine | None = None,
    progress: Progress = silent,
) -> Settled:
    """A unit normal for each of different points (n, 3); neither their order nor their unit matters.

    Args:
        normals: (n, 3) of length 1, NaN where a point has none; None: none has.
        choice: "auto": axes of those given, their signs where they agree; "orient": their axes, all signs chosen;
            "keep": as they are; "estimate": none of those given. What is missing is estimated.
        asked: what shall decide the side of all that are not kept.
        found: what the file says; it decides where nothing is asked and given signs don't agree, or there are none;
            where it says nothing, `sight_by_places`. Sensors from which much is hidden are not believed.
        scans: (n,) which scan each point is of, if that is known: the scanner of each is looked for by itself.
        neighbors: of the plane fits that estimates begin with.
        refine: what makes better ones of those that are estimated.
        progress: called as progress(stage, done, total).

    Raises:
        ValueError: all points lie on a line.
    """
    order = np.lexsort(points.T)
    frame = unit_sphere_frame(points[order])
    unit = frame.to_unit(points[order])
    given = None if normals is None or choice == "estimate" else normals[order]
    known = np.zeros(len(points), bool) if given is None else np.isfinite(given).all(1)
    why = contradiction(unit, given) if choice == "auto" and given is not None else ""
    anew = ~known | (choice == "orient") | (choice == "auto" and (asked is not None or bool(why)))
    if given is not None and not anew.any():
        return Settled(np.array(normals, np.float64), _words(known, 0, "", ""), "")
    check_not_a_line(unit)
    progress("normals", 0, 1)
    lines = complete_normals(unit, given, neighbors)
    if refine is not None and not known.all():
        lines = np.where(known[:, None], lines, refine(unit, lines, progress))
    doubt = ""
    if asked is None and found is not None and found.viewpoint is not None and found.viewpoint.ndim == 2:
        found, doubt = _believed(found, points, _in_order(lines, order))
    sight = asked or found or sight_by_places(points)
    if sight is None and (anew[known].any() or not known.any()):
        sight = sight_from_within(points[order], lines, None if scans is None else scans[order])
        if sight is not None and sight.viewpoint is not None and sight.viewpoint.ndim == 2:
            sight = sight._replace(viewpoint=_in_order(sight.viewpoint, order))
    if sight is not None and sight.viewpoint is not None:
        of_each = sight.viewpoint.ndim == 2
        places = sight.viewpoint[order] if of_each else sight.viewpoint
        pixels = sight.pixels or (not of_each and is_camera(sight.viewpoint, points))
        sight = sight._replace(viewpoint=(places - frame.center[0]) / frame.scale.item(), pixels=pixels)
    if sight is not None and sight.places is not None:
        check_one_frame(sight.places, points)
        sight = sight._replace(places=(sight.places - frame.center[0]) / frame.scale.item())
    sign, side = _signs(unit, lines, known, anew, sight, repair=bool(why))
    progress("normals", 1, 1)
    sign = np.where(anew, sign, 1)
    settled = np.empty(points.shape)
    settled[order] = lines * sign[:, None]
    words = _words(known, int((sign[known] < 0).sum()), why, side + doubt)
    return Settled(settled, words, side, seen=sight is not None)


def settled_through_noise(
    points: np.ndarray,
    normals: np.ndarray | None,
    *,
    asked: Sight | None = None,
    found: Sight | None = None,
    scans: np.ndarray | None = None,
    **options: Any,
) -> Settled:
    """As `settled_normals`; but points (n, 3) without normals that are strewn all around others
    (`pnu.geometry.clutter`) have that of the nearest of these, those whose depths come in wide steps have the normals
    of the surface through these (`pnu.geometry.depth_steps`), and each of a layer thicker than their spacing that of
    the nearest of the means that stand for them (`pnu.geometry.thick_layers`)."""
    if normals is not None and options.get("choice") != "estimate":
        return settled_normals(points, normals, asked=asked, found=found, scans=scans, **options)
    camera = camera_place(points)
    strewn = clutter_points(points) if camera is None else np.zeros(len(points), bool)
    if strewn.any():
        rows = np.flatnonzero(~strewn)
        of_rows = {"asked": _of_rows(asked, rows), "found": _of_rows(found, rows)}
        some = None if scans is None else scans[rows]
        settled = settled_through_noise(points[rows], None, scans=some, **of_rows, **options)
        nearest = PointTree(points[rows]).nearest(points, 1)[1][:, 0]
        settled = settled._replace(normals=settled.normals[nearest])
        return _by_other_points(settled, f"without {strewn.sum()} that are strewn all around")
    steps = depth_steps(points, camera)
    if steps is not None:
        points = smoothed_within_steps(points, steps)
        found = found or (None if camera is None else camera_sight(camera))
    noise = layer_noise(points)
    if noise is None:
        settled = settled_normals(points, None, asked=asked, found=found, scans=scans, **options)
        return settled if steps is None else _by_other_points(settled, f"through {steps_words(steps)}")
    means = layer_means(points, noise)
    found = found or sight_by_places(points)  # which means do not tell any more
    asked, found = (_of_rows(sight, means.rows) for sight in (asked, found))
    some = None if scans is None else scans[means.rows]
    settled = settled_normals(means.points, None, asked=asked, found=found, scans=some, **options)
    nearest = PointTree(means.points).nearest(points, 1)[1][:, 0]
    settled = settled._replace(normals=settled.normals[nearest])
    return _by_other_points(settled, f"by {len(means.rows)} means, as noise is wider than the spacing")


def _by_other_points(settled: Settled, how: str) -> Settled:
    """Normals that were estimated by points that stand for those given, and that said."""
    _, separator, side = settled.words.partition("; side: ")
    return settled._replace(words=f"{len(settled.normals)} estimated, {how}{separator}{side}")


def _of_rows(sight: Sight | None, rows: np.ndarray) -> Sight | None:
    """What decides the side of some of the points."""
    if sight is None or sight.viewpoint is None or sight.viewpoint.ndim == 1:
        return sight
    return sight._replace(viewpoint=sight.viewpoint[rows])


def normals_on_sides(points: np.ndarray, normals: np.ndarray, *, sure: bool = False) -> Settled:
    """Rough normals of points (n, 3) on the sides of given ones (n, 3), of which the sides alone count.

    What orients the normals that come with points often takes the wrong side beyond an edge, for whole parts. On a
    closed shape all look outward, therefore, unless most look inward; but not if only scattered ones do not, as it is
    on thin walls that the shape misleads. sure: their sides are known, by a sensor.
    """
    order = np.lexsort(points.T)
    unit, found = unit_sphere_frame(points[order]).to_unit(points[order]), np.empty(points.shape)
    rough, words = complete_normals(unit, normals[order]), ""
    if not sure:
        repair = repaired_signs(unit, rough)
        wrong = repair.signs < 0
        if repair.side == "outward" and largest_piece(unit, rough, wrong) > MISTAKEN * len(wrong):
            rough, words = rough * repair.signs[:, None], f"{wrong.mean():.0%} of them turned over; side: {OUTWARD}"
    found[order] = refit_normals(unit, rough)
    return Settled(found, words, "", seen=sure)


def check_not_a_line(points: np.ndarray) -> None:
    """`ValueError` where all points (n, 3) lie on a line."""
    extent = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if extent[1] < 1e-9 * extent[0]:
        raise ValueError(f"points: all {len(points)} points lie on a line; expected points on a surface")


def check_one_frame(places: np.ndarray, points: np.ndarray) -> None:
    """`ValueError` where places (k, 3) of sensors are so far from all points (n, 3) that they are of another frame."""
    low, high = points.min(0), points.max(0)
    off = np.linalg.norm(np.maximum(np.maximum(low - places, places - high), 0), axis=1).min()
    extent = np.linalg.norm(high - low)
    if off > FAR * extent:
        raise ValueError(
            f"viewpoint: its places lie {off:.3g} and more from the points, which reach over {extent:.3g}; expected "
            "places in the frame and the unit of the cloud"
        )


def contradiction(points: np.ndarray, normals: np.ndarray) -> str:
    """How unit normals (n, 3), NaN where there is none, contradict each other, in words; empty where they don't."""
    known = np.isfinite(normals).all(1)
    if not known.any():
        return ""
    points, normals = points[known], normals[known]
    if flipped := flipped_share(points, normals):
        return f"at least {flipped:.0%} looked to the other side than those beside them"
    share = contradicting(points, normals)
    return f"{share:.0%} of neighbors contradicted each other" if share > CONTRADICTING else ""


def sight_by_places(points: np.ndarray) -> Sight | None:
    """From where points (n, 3) were seen, as these say: as a map of heights, or by a camera at some place."""
    if is_height_map(points):
        return Sight("up, as a map of heights", up=UP)
    place = camera_place(points)
    return None if place is None else camera_sight(place)


def camera_sight(place: np.ndarray) -> Sight:
    """That of a camera whose place (3,) was found."""
    return Sight(f"towards a {camera_words(place)}, whose pixels they are", viewpoint=place, pixels=True)


def scanner_sight(place: np.ndarray, radius: float) -> Sight:
    """That of a scanner whose place (3,) amid points within such a radius was found."""
    digits = max(0, 2 - int(np.floor(np.log10(radius))))  # a hundredth of it
    where = ",".join(f"{value:.{digits}f}" for value in place)
    return Sight(f"towards a scanner within, at about {where}, from which they thin out", viewpoint=place)


def sight_from_within(points: np.ndarray, lines: np.ndarray, scans: np.ndarray | None = None) -> Sight | None:
    """That of the scanner amid points (n, 3) with unit lines (n, 3), or of each of the scans (n,) that they are of."""
    if scans is None:
        place = scanner_within(points, lines)
        return None if place is None else scanner_sight(place, float(np.ptp(points, axis=0).max()) / 2)
    groups = groups_alike(scans, TELLING)
    looked = groups if len(groups) <= MOST_SCANS else groups[:: -(-len(groups) // MOST_SCANS)]
    of_each, places = np.full(points.shape, np.nan), []
    for rows in looked:
        place = camera_place(points[rows])
        place = scanner_within(points[rows], lines[rows]) if place is None else place
        if place is not None:
            of_each[rows] = place
            places.append(place)
    words = f"towards the scanners of {len(places)} scan{'s' * (len(places) > 1)}, found by their points"
    if not places:
        return None
    return Sight(words, viewpoint=of_each) if looked is groups else Sight(words, places=np.array(places))


def groups_alike(numbers: np.ndarray, least: int) -> list[np.ndarray]:
    """The rows of numbers (n,) that are the same, one array for each number that there is so often at least."""
    order = np.argsort(numbers, kind="stable")
    bounds = np.flatnonzero(np.diff(numbers[order], prepend=np.nan, append=np.nan) != 0)
    return [order[start:end] for start, end in pairwise(bounds) if end - start >= least]


def camera_words(place: np.ndarray) -> str:
    """Such a camera and about where it is."""
    return f"camera at {','.join(f'{value:.3g}' for value in place) if place.any() else 'the origin'}"


def is_height_map(points: np.ndarray) -> bool:
    """Whether points (n, 3) are heights z, one for each place of a grid in x and y, a third of which they fill."""
    x, y = np.unique(points[:, 0]), np.unique(points[:, 1])
    if len(x) * len(y) > 3 * len(points) or min(len(x), len(y)) < 3:
        return False
    cells = np.searchsorted(x, points[:, 0]) * len(y) + np.searchsorted(y, points[:, 1])
    return len(np.unique(cells)) == len(points)


def _in_order(sorted_values: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Values (n, c) of points sorted by an order (n,), as the points came."""
    values = np.empty_like(sorted_values)
    values[order] = sorted_values
    return values


def _believed(found: Sight, points: np.ndarray, lines: np.ndarray) -> tuple[Sight | None, str]:
    """What a file says of the sensor of each of points (n, 3) with lines (n, 3), without those that can't be, and that
    in words."""
    assert found.viewpoint is not None
    places = np.array(found.viewpoint, np.float64)
    known = np.flatnonzero(np.isfinite(places).all(1))
    number = np.unique(places[known], axis=0, return_inverse=True)[1].ravel()
    refuted = np.zeros(len(points), bool)
    for group in groups_alike(number, TELLING):
        rows = known[group]
        refuted[rows] = hidden(points[rows], lines[rows], places[rows[0]]).mean() > MISSED
    if not refuted.any():
        return found, ""
    places[refuted] = np.nan
    doubt = f"; what the file says of the sensors of {refuted.sum()} points can't be: these hide each other from there"
    return (found._replace(viewpoint=places) if np.isfinite(places).any() else None), doubt


def _signs(
    unit: np.ndarray, lines: np.ndarray, known: np.ndarray, anew: np.ndarray, sight: Sight | None, *, repair: bool
) -> tuple[np.ndarray, str]:
    """A sign for each line, and what decided those that are anew."""
    same = np.ones(len(known))
    if sight is not None and sight.inward is None:
        told = {"viewpoint": sight.viewpoint, "up": sight.up, "places": sight.places}
        return seen_signs(unit, lines, **told, surely=sight.pixels), sight.words
    if sight is None and known.any() and not anew[known].any():
        return same, "as the nearest given"
    if sight is None and repair:
        sign, by = repaired_signs(unit, lines)
        return sign, OUTWARD if by == "outward" else "that of most given"
    oriented = orient_normals(unit, lines) if known.any() else lines
    oriented, by = _by_shape(unit, oriented)
    sign = np.where((oriented * lines).sum(1) < 0, -1.0, 1.0)
    if sight is not None:
        return (-sign if sight.inward else sign), sight.words
    return sign, by


def _by_shape(unit: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, str]:
    """Normals (n, 3) whose sides agree, on the side that the shape tells, and how it does, in words."""
    cloud = NeighborCloud.of(unit)
    law = gauss_law(cloud, normals.astype(np.float32))
    if law.closed:
        return normals, OUTWARD
    view = seen_from_one_side(unit, normals)  # plates too thin to lie behind themselves are closed all the same
    if view is not None and view.above:
        return view.normals, FROM_ABOVE
    facing = normals if view is None else view.normals
    height = float(cloud.area @ facing[:, 2] / cloud.area.sum())  # of the mean normal
    outward = law.outward * np.sign(((normals * facing).sum(1) * cloud.area).sum() * height)
    if abs(height) > LEVEL and outward > -AGAINST:
        return facing * np.sign(height), GROUND
    return facing, "one and the same over an open surface" if view is None else ONE_SIDE


def _words(known: np.ndarray, turned: int, why: str, side: str) -> str:
    given, estimated = int(known.sum()), int((~known).sum())
    parts = [f"{given} given"] if given else []
    if turned:
        parts.append(f"{turned} of them turned over" + (f" ({why})" if why else ""))
    elif given:
        parts.append("none of them turned over")
    parts += [f"{estimated} estimated"] if estimated else []
    return ", ".join(parts) + (f"; side: {side}" if side else "")
