"""The keys of several commands that decide the side of normals: what they may be, and what they do to a cloud."""

from typing import TYPE_CHECKING, Any

from pnu.runtime.progress import stages

if TYPE_CHECKING:
    from pnu.cleaning import Cleaned
    from pnu.geometry.cloud_normals import Settled
    from pnu.io import Cloud
    from pnu.io.sensor import Sight

CHOICES = ("auto", "orient", "estimate", "keep")
NORMALS = (
    "auto: the file's, turned over where they contradict each other, estimated where missing; of poor ones, such as "
    "plane fits, the sides alone, but pnu normals keeps their axes; orient: the file's axes, all sides chosen; "
    "estimate: all estimated; keep: the file's as they are"
)
VIEWPOINT = (
    "x,y,z, place of the sensor, or a file of its places, with times or without, as a scanner's way: normals look to "
    "where they were seen from; null: where the file says so"
)
UP = "x, y, z, -x, -y or -z: the direction from which all was seen, as from the air; null: of airborne scans"
SIDE = "out or in: of closed shapes, in for rooms and tunnels; of open ones in is the other side; null: out"


def check_sides(cfg: Any) -> None:
    """Refuse values of normals=, viewpoint=, up= and side= before the work begins."""
    from pnu.io.sensor import asked_sight

    if cfg.normals not in CHOICES:
        raise ValueError(f"normals={cfg.normals}: expected {', '.join(CHOICES[:-1])} or {CHOICES[-1]}")
    if asked_sight(cfg.viewpoint, cfg.up, cfg.side) is not None and cfg.normals == "keep":
        name = next(name for name in ("viewpoint", "up", "side") if cfg[name] is not None)
        raise ValueError(f"{name}={cfg[name]}: decides nothing where normals=keep; take normals=orient")


def sided(cfg: Any, cloud: "Cloud", *, learned: bool = True, places: "Sight | None" = None) -> "Settled":
    """A normal for each point of a cloud, as the keys and the file say. Without `learned` those that are estimated are
    plane fits. places: what those of the points say, where that is known already."""
    from pnu.geometry.cloud_normals import settled_normals, settled_through_noise
    from pnu.io.scan_columns import scan_numbers
    from pnu.io.sensor import asked_sight, sight_of
    from pnu.upsamplers.learned_normals import learned_normals

    with stages(cfg.quiet) as progress:
        return (settled_through_noise if learned else settled_normals)(
            cloud.points,
            cloud.normals,
            choice=cfg.normals,
            asked=asked_sight(cfg.viewpoint, cfg.up, cfg.side, cloud.attributes),
            found=sight_of(cfg.input, cloud.attributes) or places,
            scans=scan_numbers(cloud.attributes),
            refine=learned_normals if learned else None,
            progress=progress,
        )


def with_normals(cloud: "Cloud", settled: "Settled") -> "Cloud":
    """A cloud with these, and a line on them as its last note where something was done."""
    notes = (*cloud.notes, *[f"normals: {settled.words}"] * bool(settled.side))
    return cloud._replace(normals=settled.normals, notes=notes)


def with_good_axes(cfg: Any, cloud: "Cloud", settled: "Settled") -> tuple["Settled", str]:
    """The normals of a cloud for its surface, with normals=auto their axes found anew where given ones are poor, and a
    line on that."""
    from pnu.cleaning import axes_anew
    from pnu.geometry.cloud_normals import normals_on_sides
    from pnu.geometry.unit_sphere import unit_sphere_frame
    from pnu.upsamplers.learned_normals import learned_normals
    from pnu.upsamplers.poor_axes import poor_axes

    if cloud.normals is None or cfg.normals != "auto":
        return settled, ""
    why = poor_axes(cloud.points, settled.normals)
    if not why:
        return settled, ""
    unit = unit_sphere_frame(cloud.points).to_unit(cloud.points)
    sides = normals_on_sides(cloud.points, settled.normals, sure=settled.seen)
    with stages(cfg.quiet) as progress:
        found = learned_normals(unit, sides.normals, progress)
    note = axes_anew(cloud.normals, why)
    return settled._replace(normals=found), f"{note}; {sides.words}" if sides.words else note


def cleaned(
    cfg: Any, cloud: "Cloud", *, outliers: Any = "auto", lines: Any = "auto", noise: Any = "auto"
) -> tuple["Cleaned", "Cloud"]:
    """A cloud as `clean_cloud` leaves it, and the same with a normal for each point, its own or rough estimates.

    Where keys or file say more of the side of normals than the shape of the cloud does, they decide it. With
    normals=auto the axes of poor ones are found anew.
    """
    from pnu.cleaning import clean_cloud, with_axes_anew, without_normals
    from pnu.geometry.cloud_normals import sight_by_places
    from pnu.io.sensor import asked_sight, sight_of
    from pnu.upsamplers.poor_axes import poor_axes

    told = asked_sight(cfg.viewpoint, cfg.up, cfg.side) is not None or cfg.normals == "orient"
    places = sight_by_places(cloud.points)
    told = told or sight_of(cfg.input, cloud.attributes) is not None or places is not None
    signs: Any = "keep" if told or cfg.normals == "keep" else "auto"
    found = clean_cloud(cloud, outliers=outliers, lines=lines, noise=noise, signs=signs, doubts=poor_axes)
    own = found.cloud.normals is not None
    if own and not told:
        return found, found.cloud
    settled = found.estimated if found.estimated is not None and not told else None
    settled = settled or sided(cfg, found.cloud, learned=False, places=places)
    whole = with_normals(found.cloud, settled)
    found = found._replace(seen=settled.seen)
    if not own:
        return found._replace(estimated=settled), whole
    found = found._replace(cloud=whole)
    why = poor_axes(whole.points, settled.normals) if cfg.normals == "auto" else ""
    if not why:
        return found, whole
    if (bare := without_normals(cloud, why)) is not None:
        return cleaned(cfg, bare, outliers=outliers, lines=lines, noise=noise)
    found = with_axes_anew(found, why, lines=lines, noise="keep")  # which is averaged already
    known = found.estimated is not None and (not told or found.estimated.seen)
    settled = (found.estimated if known else None) or sided(cfg, found.cloud, learned=False, places=places)
    return found._replace(estimated=settled), found.cloud._replace(normals=settled.normals)
