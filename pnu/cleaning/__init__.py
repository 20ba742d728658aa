"""What is done to a cloud before it becomes denser, and said: strays taken out, lines thinned, normals turned."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.cleaning.outliers import MANY, stray_points
from pnu.geometry.anisotropy import averaged, mean_normals, thinned_lines
from pnu.geometry.cloud_normals import (
    Settled,
    camera_sight,
    camera_words,
    contradiction,
    normals_on_sides,
    settled_normals,
)
from pnu.geometry.clutter import clutter_points
from pnu.geometry.depth_steps import depth_steps, smoothed_within_steps, steps_words
from pnu.geometry.noise_level import is_louder_in_places, noise_level
from pnu.geometry.single_view import camera_place
from pnu.geometry.spacing import spacing
from pnu.geometry.thick_layers import LayerMeans, layer_means, layer_noise
from pnu.io import Cloud
from pnu.io.cloud import chosen
from pnu.io.scan_columns import scan_numbers
from pnu.io.sensor import Sight

Treatment = Literal["auto", "keep"]
TREATMENTS = ("auto", "keep")
Doubts = Callable[[NDArray[np.float64], NDArray[np.float64]], str]
"""Points (n, 3), unit normals (n, 3) whose sides agree -> why their axes are better found anew; empty: they are not."""
Character = Literal["clean", "scanned", "noisy"]
"""What a cloud is like: clean and scanned ones show little noise, scanned ones lie in lines or have many strays."""
NOISY = 0.17  # spacings of noise from which on a cloud is noisy; then what looks stray says nothing of scans
MANY_ENOUGH = 1000  # points that tell noise from what they do not resolve
MANY_TO_SMOOTH = 4000  # points of which the 64 neighbors of the weights for noise are a small place
MOST_PLACES = 100_000  # points whose noise is looked for in places though the whole shows none

__all__ = [
    "TREATMENTS",
    "Character",
    "Cleaned",
    "Doubts",
    "Treatment",
    "axes_anew",
    "clean_cloud",
    "is_noisy",
    "stray_points",
    "with_axes_anew",
    "without_clutter",
    "without_depth_steps",
    "without_normals",
]


class Cleaned(NamedTuple):
    """A cloud after the treatments, and what became of the points of the one before."""

    cloud: Cloud  # its notes say what was done
    stray: NDArray[np.int64]  # rows of the cloud before that were taken out as stray
    character: Character = "clean"  # of a cloud without normals; what has them is "clean"
    estimated: Settled | None = (
        None  # rough normals, where known, of a cloud without, or of whose the sides alone count
    )
    seen: bool = False  # a sensor, or what was asked for, decided the side of its normals
    camera: NDArray[np.float64] | None = None  # place (3,) from which all of a cloud without normals was seen

    @property
    def sight(self) -> Sight | None:
        """That of the camera, where there is one."""
        return None if self.camera is None else camera_sight(self.camera)


def clean_cloud(
    cloud: Cloud, *, outliers: Treatment = "auto", lines: Treatment = "auto", noise: Treatment = "auto",
    signs: Treatment = "auto", doubts: Doubts | None = None,
) -> Cleaned:  # fmt: skip
    """A cloud without stray points (`outliers`), with lines thinned out (`lines`), layers of noise and steps of depth
    made smooth (`noise`), and normals that agree (`signs`).

    Lines are found where points are several times as dense along one direction as across it. As many points stay as lie
    about as far apart along lines as across; each moves to the mean of the points that it stands for, which takes most
    of the noise from them. Lines with normals stay as they are: then nothing is to be estimated from neighbors. Where
    noise is wider than the spacing, means about as far apart as it is wide take the place of the points; where depths
    come in wider steps than that, points move within half a step of where they are.

    Args:
        cloud: as `pnu.io.check_cloud` gives it.
        outliers: auto: stray points are taken out; keep: all stay.
        lines: auto: thinned out; keep: as they are.
        noise: auto: points of a layer thicker than their spacing are averaged, steps of depth smoothed; keep: all stay.
        signs: auto: of normals that contradict each other the axes are kept and the sides chosen anew; keep: as given.
        doubts: says, where signs are auto, of which normals the sides alone count (`with_axes_anew`); None: of none.

    Raises:
        ValueError: a treatment is neither auto nor keep, or hardly a point is none of the stray ones.
    """
    for name, value in (("outliers", outliers), ("lines", lines), ("noise", noise), ("signs", signs)):
        if value not in TREATMENTS:
            raise ValueError(f"{name}={value}: expected auto or keep")
    given, camera = cloud, camera_place(cloud.points) if cloud.normals is None else None
    if noise == "auto":
        cloud = without_depth_steps(cloud, camera, unless="noise=keep")
    notes = list(cloud.notes)
    stray = np.flatnonzero(stray_points(cloud.points, camera)) if outliers == "auto" else np.empty(0, np.int64)
    if len(stray):
        how = "they lie off the surface" if camera is None else f"torn off at edges, as a {camera_words(camera)} saw"
        notes.append(f"{len(stray)} of {len(cloud.points)} points left out: stray, {how} (outliers=keep)")
        cloud = chosen(cloud, np.setdiff1d(np.arange(len(cloud.points)), stray))
    if signs == "auto" and cloud.normals is not None and contradiction(cloud.points, cloud.normals):
        settled = settled_normals(cloud.points, cloud.normals, scans=scan_numbers(cloud.attributes))
        notes.append(f"normals: {settled.words} (normals=keep)")
        cloud = cloud._replace(normals=settled.normals)
    found = Cleaned(cloud._replace(notes=tuple(notes)), stray, camera=camera)
    if cloud.normals is None:
        return _with_character(found, lines, noise)
    why = "" if doubts is None or signs == "keep" else doubts(cloud.points, cloud.normals)
    if why and (bare := without_normals(given, why)) is not None:
        return clean_cloud(bare, outliers=outliers, lines=lines, noise=noise)
    if why:
        return with_axes_anew(found, why, lines=lines, noise=noise)
    level = layer_noise(cloud.points) if noise == "auto" else None
    return found if level is None else found._replace(cloud=_layer_averaged(found.cloud, level))


def without_depth_steps(cloud: Cloud, camera: NDArray[np.float64] | None, *, unless: str) -> Cloud:
    """A cloud whose depths come in no wide steps, as seen from the place (3,) of a camera or from elsewhere, and a note
    on that, with what leaves them."""
    steps = depth_steps(cloud.points, camera)
    if steps is None:
        return cloud
    note = f"{steps_words(steps)}: each point moved by half a step at most, onto the surface through them ({unless})"
    return cloud._replace(points=smoothed_within_steps(cloud.points, steps), notes=(*cloud.notes, note))


def without_clutter(cloud: Cloud, *, unless: str) -> Cloud:
    """A cloud without what is strewn all around it, and a note on that, with what leaves it."""
    strewn = clutter_points(cloud.points)
    if not strewn.any():
        return cloud
    note = f"{strewn.sum()} of {len(strewn)} points left out: strewn all around ({unless})"
    return chosen(cloud, np.flatnonzero(~strewn))._replace(notes=(*cloud.notes, note))


def without_normals(cloud: Cloud, why: str) -> Cloud | None:
    """A cloud without its poor normals where a single camera saw it, which says their sides too; None elsewhere."""
    assert cloud.normals is not None
    if camera_place(cloud.points) is None:
        return None
    return cloud._replace(normals=None, notes=(*cloud.notes, axes_anew(cloud.normals, why)))


def with_axes_anew(found: Cleaned, why: str, *, lines: Treatment = "auto", noise: Treatment = "auto") -> Cleaned:
    """A clean cloud whose normals are taken for their sides alone: as one without, but that their sides are known.

    Where no sensor says the sides (`found.seen`) the shape may (`normals_on_sides`).
    """
    assert found.cloud.normals is not None
    notes = (*found.cloud.notes, axes_anew(found.cloud.normals, why))
    return _with_character(found._replace(cloud=found.cloud._replace(notes=notes)), lines, noise)


def axes_anew(normals: NDArray[np.float64], why: str) -> str:
    """A line on given normals (n, 3) whose axes are poor."""
    count = int(np.isfinite(normals).all(1).sum())
    return (
        f"normals: of {count} given the sides alone are taken, their axes are found anew, they are {why} (normals=keep)"
    )


def _with_character(found: Cleaned, lines: Treatment, noise: Treatment) -> Cleaned:
    """A cloud without normals, or with such as tell the sides alone, lines thinned out and layers averaged: what it is
    like."""
    cloud, notes = found.cloud, found.cloud.notes
    rows = thinned_lines(cloud.points) if lines == "auto" else None
    if rows is not None:
        note = f"lies in lines: {len(rows)} points, less dense along them, stand for {len(cloud.points)} (lines=keep)"
        cloud = chosen(cloud, rows)._replace(points=averaged(cloud.points, rows), notes=(*notes, note))
    level = layer_noise(cloud.points) if noise == "auto" and rows is None else None
    if level is not None:
        cloud = _layer_averaged(cloud, level)
    share = len(found.stray) / (len(found.stray) + len(cloud.points))
    known = None  # what is fitted to lines, or within a layer, has no sides either
    if cloud.normals is not None and rows is None and level is None:
        known = normals_on_sides(cloud.points, cloud.normals, sure=found.seen)
    if known is not None and known.words:
        cloud = cloud._replace(notes=(*cloud.notes, f"normals: {known.words} (normals=keep)"))
    found = found._replace(cloud=cloud._replace(normals=None), estimated=known)
    scanned = found._replace(character="scanned" if share > MANY or found.camera is not None else "clean")
    if rows is not None:
        return scanned._replace(character="scanned")
    if not is_noisy(cloud.points) and not MANY_TO_SMOOTH <= len(cloud.points) <= MOST_PLACES:
        return scanned  # without noise, nor with thin walls, whose sides normals tell apart
    estimated = known or settled_normals(cloud.points, None, found=found.sight, scans=scan_numbers(cloud.attributes))
    in_places = scanned.character == "clean"  # weights trained on scans know such noise
    if is_noisy(cloud.points, estimated.normals, in_places=in_places):
        return found._replace(character=noisy_character(cloud.points), estimated=estimated)
    return scanned._replace(estimated=estimated)


def layer_words(layer: LayerMeans, count: int) -> str:
    """A line on a layer of so many points that means stand for."""
    return (
        f"noise of about {layer.noise:.2g}, more than the spacing: {len(layer.points)} means stand for {count} points "
        "(noise=keep)"
    )


def _layer_averaged(cloud: Cloud, noise: float) -> Cloud:
    """Means in place of a layer of so much noise, with mean normals where there are any."""
    layer = layer_means(cloud.points, noise)
    found = chosen(cloud, layer.rows)._replace(
        points=layer.points, notes=(*cloud.notes, layer_words(layer, len(cloud.points)))
    )
    if cloud.normals is None:
        return found
    return found._replace(normals=mean_normals(cloud.points, layer.rows, cloud.normals))


def noisy_character(points: NDArray[np.float64]) -> Character:
    """What a noisy cloud is taken for: of few points, weights for noise would smooth over parts and between walls."""
    return "noisy" if len(points) >= MANY_TO_SMOOTH else "clean"


def is_noisy(
    points: NDArray[np.float64], normals: NDArray[np.float64] | None = None, *, in_places: bool = True
) -> bool:
    """Whether points (n, 3), with normals (n, 3) where they are known, show much noise beside their spacing, everywhere
    or, as normals tell, in places.

    Never fewer than 1000: walls that so few do not resolve look like noise, with normals too.
    """
    if len(points) < MANY_ENOUGH:
        return False
    level = noise_level(points, normals)
    if level > NOISY * spacing(points):
        return True
    return in_places and normals is not None and is_louder_in_places(points, normals, level)
