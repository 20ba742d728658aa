"""Procedural machine parts: exact booleans with sharp edges, thin walls, holes. Each function returns a closed mesh."""

from collections.abc import Callable, Sequence

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, OpType
from numpy.typing import ArrayLike

from pnu.io import Mesh

SEGMENTS = 96  # of a full circle


def mesh_of(solid: Manifold) -> Mesh:
    """Vertices and faces of a solid."""
    made = solid.to_mesh64()
    return Mesh(np.asarray(made.vert_properties)[:, :3].astype(float), np.asarray(made.tri_verts).astype(np.int64))


def block(x: float, y: float, z: float, at: Sequence[float] = (0, 0, 0)) -> Manifold:
    """Box of these lengths, centered at a point."""
    return Manifold.cube((x, y, z), True).translate(tuple(at))


def rod(radius: float, height: float, at: Sequence[float] = (0, 0, 0), top: float | None = None,
        segments: int = SEGMENTS) -> Manifold:  # fmt: skip
    """Cylinder along z, or a cone with another radius at its top, centered at a point."""
    return Manifold.cylinder(height, radius, radius if top is None else top, segments, True).translate(tuple(at))


def pipe(radius: float, wall: float, height: float, at: Sequence[float] = (0, 0, 0)) -> Manifold:
    """A hollow cylinder."""
    return rod(radius, height, at) - rod(radius - wall, 2 * height, at)


def around(solid: Manifold, count: int) -> Manifold:
    """Copies turned about z, united."""
    return Manifold.batch_boolean([solid.rotate((0, 0, 360 * i / count)) for i in range(count)], OpType.Add)


def plate(x: float, y: float, z: float, corner: float) -> Manifold:
    """Plate with rounded corners."""
    outline = CrossSection.square((x - 2 * corner, y - 2 * corner), True).offset(
        corner, JoinType.Round, circular_segments=SEGMENTS
    )
    return outline.extrude(z).translate((0, 0, -z / 2))


def polygon(points: ArrayLike, height: float) -> Manifold:
    """Prism of an outline, centered in z."""
    return CrossSection([np.asarray(points, float)]).extrude(height).translate((0, 0, -height / 2))


def profile(points: ArrayLike) -> Manifold:
    """Body of revolution about z of an outline (radius, z)."""
    return CrossSection([np.asarray(points, float)]).revolve(SEGMENTS)


def bracket() -> Mesh:
    """A bracket, around the origin."""
    body = block(1.2, 0.7, 0.12, (0, 0, 0.06)) + block(0.12, 0.7, 1.0, (-0.54, 0, 0.5))
    rib = polygon([(-0.5, 0.1), (0.35, 0.1), (-0.5, 0.8)], 0.08).rotate((90, 0, 0))
    holes = sum_of([rod(0.09, 1, (x, y, 0)) for x in (0.05, 0.4) for y in (-0.2, 0.2)])
    side = rod(0.12, 1).rotate((0, 90, 0)).translate((-0.54, 0, 0.72))
    return mesh_of(body + rib - holes - side)


def sum_of(solids: Sequence[Manifold]) -> Manifold:
    """The union of solids."""
    return Manifold.batch_boolean(list(solids), OpType.Add)


def gear(teeth: int = 18, helix: float = 0.0, hub: float = 0.3) -> Mesh:
    """A gear, around the origin."""
    angle = np.linspace(0, 2 * np.pi, 4 * teeth, endpoint=False)
    radius = np.tile([0.82, 1.0, 1.0, 0.82], teeth)
    shift = np.tile([0.12, 0.06, -0.06, -0.12], teeth) * 2 * np.pi / teeth
    outline = np.stack([radius * np.cos(angle + shift), radius * np.sin(angle + shift)], 1)
    body = CrossSection([outline]).extrude(0.35, 24 if helix else 0, helix)
    web = pipe(0.7, 0.7 - hub - 0.05, 0.12, (0, 0, 0.35)) + pipe(0.7, 0.7 - hub - 0.05, 0.12, (0, 0, 0))
    key = block(0.1, 0.12, 1, (hub - 0.12, 0, 0))
    return mesh_of(body - web - rod(hub - 0.14, 2) - key)


def flange() -> Mesh:
    """A flange, around the origin."""
    body = rod(1, 0.16) + rod(0.5, 0.8, (0, 0, 0.4)) - rod(0.38, 4)
    return mesh_of(body - around(rod(0.08, 1, (0.78, 0, 0)), 8))


def nut(sides: int = 6) -> Mesh:
    """A nut, around the origin."""
    body = rod(1, 0.7, segments=sides) ^ rod(0.75, 0.7, top=1.4) ^ rod(1.4, 0.7, top=0.75)
    return mesh_of(body - rod(0.5, 2))


def bolt() -> Mesh:
    """A bolt, around the origin."""
    head = rod(0.42, 0.28, (0, 0, 1.0), segments=6)
    grooves = sum_of([pipe(0.4, 0.22, 0.05, (0, 0, z)) for z in np.arange(-0.75, 0.3, 0.11)])
    return mesh_of(head + rod(0.22, 1.9) + rod(0.22, 0.12, (0, 0, -1.0), 0.2) - grooves)


def washer() -> Mesh:
    """A washer, around the origin."""
    return mesh_of(rod(1, 0.14) - rod(0.5, 1))


def spring_clip() -> Mesh:
    """A spring clip, around the origin."""
    ring = pipe(0.6, 0.05, 1.0) - block(0.5, 2, 2, (0.6, 0, 0))
    ears = [block(0.5, 0.05, 1.0, (0.55, 0.45 * side, 0)).rotate((0, 0, -12 * side)) for side in (1, -1)]
    return mesh_of(sum_of([ring, *ears]))


def enclosure() -> Mesh:
    """An enclosure, around the origin."""
    shell = plate(1.6, 1.1, 0.6, 0.12) - plate(1.5, 1.0, 0.6, 0.08).translate((0, 0, 0.06))
    posts = sum_of([pipe(0.09, 0.05, 0.5, (x, y, 0)) for x in (-0.62, 0.62) for y in (-0.38, 0.38)])
    slots = sum_of([block(0.06, 0.3, 1, (x, 0, 0)) for x in np.linspace(-0.35, 0.35, 6)])
    return mesh_of(shell + posts - slots)


def pulley() -> Mesh:
    """A pulley, around the origin."""
    outline = [(0.2, -0.3), (0.9, -0.3), (0.9, -0.22), (0.62, 0.0), (0.9, 0.22), (0.9, 0.3), (0.2, 0.3)]
    return mesh_of(profile(outline) - around(rod(0.11, 1, (0.42, 0, 0)), 5))


def knob() -> Mesh:
    """A knob, around the origin."""
    body = rod(0.7, 0.5, (0, 0, 0.25), 0.6) + rod(0.3, 0.5, (0, 0, -0.2))
    return mesh_of(body - around(rod(0.1, 2, (0.74, 0, 0)), 14) - rod(0.12, 3) - block(0.1, 1.0, 0.12, (0.4, 0, 0.5)))


def crankshaft() -> Mesh:
    """A crankshaft, around the origin."""
    journal = [rod(0.14, 0.4, (0, 0, z)) for z in (-0.9, 0, 0.9)]
    pins = [rod(0.11, 0.42, (0.32 * s, 0, z)) for s, z in ((1, -0.45), (-1, 0.45))]
    webs = [
        plate(0.75, 0.34, 0.1, 0.16).translate((0.16 * s, 0, z))
        for s, z in ((1, -0.68), (1, -0.22), (-1, 0.22), (-1, 0.68))
    ]
    return mesh_of(sum_of([*journal, *pins, *webs]))


def connecting_rod() -> Mesh:
    """A connecting rod, around the origin."""
    beam = block(1.3, 0.2, 0.16) - block(0.9, 0.1, 0.06, (0, 0, 0.08)) - block(0.9, 0.1, 0.06, (0, 0, -0.08))
    ends = rod(0.32, 0.24, (-0.7, 0, 0)) + rod(0.2, 0.24, (0.7, 0, 0))
    return mesh_of(beam + ends - rod(0.22, 1, (-0.7, 0, 0)) - rod(0.11, 1, (0.7, 0, 0)))


def stairs(steps: int = 6) -> Mesh:
    """Stairs, around the origin."""
    parts = [block(0.25, 1.0, 0.2 * (i + 1), (0.25 * i - 0.75, 0, 0.1 * (i + 1))) for i in range(steps)]
    return mesh_of(sum_of(parts) - block(2, 0.5, 0.1, (0, 0, 0.05)))


def heat_sink(fins: int = 9) -> Mesh:
    """A heat sink, around the origin."""
    base = block(1.4, 1.0, 0.14)
    return mesh_of(sum_of([base, *(block(0.05, 1.0, 0.6, (x, 0, 0.35)) for x in np.linspace(-0.66, 0.66, fins))]))


def hinge() -> Mesh:
    """A hinge, around the origin."""
    leaf = plate(0.9, 1.2, 0.07, 0.1).translate((0.5, 0, 0)) - sum_of(
        [rod(0.07, 1, (0.65, y, 0)) + rod(0.13, 0.08, (0.65, y, 0.02), 0.16) for y in (-0.4, 0, 0.4)]
    )
    knuckle = sum_of([pipe(0.13, 0.06, 0.22).rotate((90, 0, 0)).translate((0, y, 0)) for y in (-0.48, 0, 0.48)])
    return mesh_of(leaf + knuckle)


def pipe_tee() -> Mesh:
    """A pipe tee, around the origin."""
    outside = rod(0.34, 2.0) + rod(0.3, 1.0).rotate((0, 90, 0)).translate((0.5, 0, 0))
    lips = rod(0.44, 0.14, (0, 0, 0.93)) + rod(0.44, 0.14, (0, 0, -0.93))
    return mesh_of(outside + lips - rod(0.27, 4) - rod(0.23, 2).rotate((0, 90, 0)).translate((1.0, 0, 0)))


def star_prism(points: int = 5) -> Mesh:
    """A star prism, around the origin."""
    angle = np.arange(2 * points) * np.pi / points
    radius = np.where(np.arange(2 * points) % 2, 0.45, 1.0)
    return mesh_of(polygon(np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1), 0.4))


def lattice_cube() -> Mesh:
    """A lattice cube, around the origin."""
    return mesh_of(
        block(1, 1, 1) - sum_of([block(2, 0.6, 0.6), block(0.6, 2, 0.6), block(0.6, 0.6, 2)]) + block(0.25, 0.25, 0.25)
        + sum_of([block(1, 0.08, 0.08), block(0.08, 1, 0.08), block(0.08, 0.08, 1)])
    )  # fmt: skip


def dice() -> Mesh:
    """Dice, around the origin."""
    body = block(1, 1, 1) ^ Manifold.sphere(0.72, SEGMENTS)
    pips = [(0, 0, 0.5), (0.25, 0.25, -0.5), (-0.25, -0.25, -0.5), (0.5, 0.2, 0.2), (0.5, 0, 0), (0.5, -0.2, -0.2)]
    return mesh_of(body - sum_of([Manifold.sphere(0.09, 48).translate(p) for p in pips]))


def wedge() -> Mesh:
    """A wedge, around the origin."""
    return mesh_of(polygon([(-1, 0), (1, 0), (1, 0.15), (-1, 0.9)], 0.8) - rod(0.15, 2, (-0.4, 0.3, 0)))


def dovetail() -> Mesh:
    """A dovetail, around the origin."""
    body = block(1.2, 1.0, 0.6)
    groove = polygon([(-0.34, -0.3), (0.34, -0.3), (0.2, 0), (-0.2, 0)], 2).rotate((90, 0, 0)).translate((0, 0, 0.31))
    return mesh_of(body - groove - sum_of([rod(0.07, 2, (x, y, 0)) for x in (-0.48, 0.48) for y in (-0.35, 0.35)]))


def cup() -> Mesh:
    """A cup, around the origin."""
    outline = [(0, -0.7), (0.45, -0.7), (0.62, 0.7), (0.56, 0.7), (0.4, -0.63), (0, -0.63)]
    return mesh_of(profile(outline))


def impeller(blades: int = 9) -> Mesh:
    """An impeller, around the origin."""
    disk = rod(0.95, 0.08) + rod(0.25, 0.5, (0, 0, 0.22), 0.16)
    blade = CrossSection.square((0.68, 0.05), True).extrude(0.36, 16, 35).translate((0.58, 0, 0))
    return mesh_of(disk + around(blade, blades) - rod(0.1, 3))


def wrench() -> Mesh:
    """A wrench, around the origin."""
    handle = plate(1.4, 0.22, 0.12, 0.1)
    head = rod(0.3, 0.14, (-0.75, 0, 0)) + rod(0.24, 0.14, (0.75, 0, 0))
    jaw = block(0.4, 0.26, 1, (-0.9, 0, 0)).rotate((0, 0, 0))
    return mesh_of(handle + head - jaw - rod(0.15, 1, (0.75, 0, 0), segments=6))


def clamp() -> Mesh:
    """A clamp, around the origin."""
    frame = block(1.4, 1.2, 0.3) - block(1.0, 0.8, 1, (0.25, 0, 0))
    screw = rod(0.1, 1.3).rotate((90, 0, 0)).translate((0.5, -0.5, 0)) + rod(0.2, 0.08).rotate((90, 0, 0)).translate(
        (0.5, 0.12, 0)
    )
    return mesh_of(frame + screw)


def perforated_plate() -> Mesh:
    """A perforated plate, around the origin."""
    holes = [rod(0.07, 1, (x + 0.1 * (i % 2), y, 0)) for i, y in enumerate(np.linspace(-0.5, 0.5, 6))
             for x in np.linspace(-0.8, 0.7, 8)]  # fmt: skip
    return mesh_of(plate(2, 1.3, 0.06, 0.1) - sum_of(holes))


SHAPES: dict[str, Callable[[], Mesh]] = {
    "bolt": bolt,
    "bracket": bracket,
    "clamp": clamp,
    "connecting_rod": connecting_rod,
    "crankshaft": crankshaft,
    "cup": cup,
    "dice": dice,
    "dovetail": dovetail,
    "enclosure": enclosure,
    "flange": flange,
    "gear": gear,
    "gear_helical": lambda: gear(24, 25, 0.35),
    "gear_pinion": lambda: gear(9, 0, 0.4),
    "heat_sink": heat_sink,
    "hinge": hinge,
    "impeller": impeller,
    "knob": knob,
    "lattice_cube": lattice_cube,
    "nut": nut,
    "nut_square": lambda: nut(4),
    "perforated_plate": perforated_plate,
    "pipe_tee": pipe_tee,
    "pulley": pulley,
    "spring_clip": spring_clip,
    "stairs": stairs,
    "star_prism": star_prism,
    "washer": washer,
    "wedge": wedge,
    "wrench": wrench,
}
