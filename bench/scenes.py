"""Scenes whose normals are known: land, a yard, rooms, a corridor. Points and unit normals (n, 3) each."""

import numpy as np

from pnu.geometry.sphere_directions import sphere_directions

Array = np.ndarray
FACES = [(axis, side) for axis in range(3) for side in (-1, 1)]  # of a box


def box(
    n: int, size: tuple[float, ...], center: tuple[float, ...] = (0, 0, 0), faces: list[tuple[int, int]] = FACES
) -> tuple[Array, Array]:
    """Points on faces (axis, side) of a box, and the normals that look out of it."""
    rng, extent = np.random.default_rng(len(faces)), np.array(size, float)
    areas = np.array([np.prod(np.delete(extent, axis)) for axis, _ in faces])
    points, normals = [], []
    for (axis, side), count in zip(faces, np.rint(n * areas / areas.sum()).astype(int), strict=True):
        on_face = rng.uniform(-0.5, 0.5, (count, 3)) * extent
        on_face[:, axis] = side * extent[axis] / 2
        points.append(on_face + center)
        normals.append(np.broadcast_to(side * np.eye(3)[axis], (count, 3)))
    return np.vstack(points), np.vstack(normals)


def land(noise: float = 0.0) -> tuple[Array, Array]:
    """Hills seen from the air with four houses, whose walls are vertical."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-50, 50, (2, 8000))

    def height(x: Array, y: Array) -> Array:
        return 3 * np.sin(x / 9) + 2 * np.cos(y / 7)

    slope = np.stack([-np.cos(x / 9) / 3, 2 / 7 * np.sin(y / 7), np.ones_like(x)], 1)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    points, normals, kept = [], [], np.ones(len(x), bool)
    for place in ((-20, -20), (15, 10), (20, -25), (-25, 22)):
        kept &= (np.abs(x - place[0]) > 8) | (np.abs(y - place[1]) > 6)
        house, outward = box(1200, (16, 12, 24), (*place, 4), FACES[:4] + FACES[5:])
        above = house[:, 2] > height(house[:, 0], house[:, 1])
        points.append(house[above])
        normals.append(outward[above])
    points = [np.stack([x, y, height(x, y)], 1)[kept], *points]
    cloud = np.vstack(points)
    return cloud + noise * rng.normal(size=cloud.shape), np.vstack([slope[kept], *normals])


def yard() -> tuple[Array, Array]:
    """Ground of 20 by 20 meters with three houses, evenly sampled as far as it is seen from its middle."""
    ground, up = box(5000, (20, 20, 1), (0, 0, -0.5), [(2, 1)])
    points, normals, kept = [], [], np.ones(len(ground), bool)
    for place, size in (((7, 6.5), (6, 5, 6)), ((-7.3, 0.5), (1.5, 11, 3.8)), ((-2, -6), (2, 2, 3))):
        kept &= (np.abs(ground[:, :2] - place) > np.array(size[:2]) / 2).any(1)
        area = 2 * (size[0] + size[1]) * size[2] + size[0] * size[1]
        house, outward = box(round(13 * area), size, (*place, size[2] / 2), FACES[:4] + FACES[5:])
        points.append(house)
        normals.append(outward)
    cloud, facing = np.vstack([ground[kept], *points]), np.vstack([up[kept], *normals])
    seen = ((np.array([0, 0, 1.6]) - cloud) * facing).sum(1) > 0
    return cloud[seen], facing[seen]


def scanned_room(place: Array, rays: int = 6000) -> tuple[Array, Array]:
    """Of six by four by three meters with a ball, as a scanner at a place (3,) in it sees it, but not steeply."""
    size, ball, radius = np.array([6.0, 4, 3]), np.array([4.5, 1, 1]), 0.6
    ways = sphere_directions(rays)
    ways = ways[np.abs(ways[:, 2]) < 0.9]
    reach = (np.where(ways > 0, size, 0.0) - place) / ways
    far, normals = reach.min(1), -np.sign(ways) * np.eye(3)[reach.argmin(1)]
    along = ways @ (ball - place)
    root = along**2 - ((ball - place) ** 2).sum() + radius**2
    hit = (root > 0) & (along > 0)
    far[hit] = (along - np.sqrt(np.maximum(root, 0)))[hit]
    points = place + far[:, None] * ways
    normals[hit] = (points[hit] - ball) / radius
    return points, normals


def rescanned_room() -> tuple[Array, Array, Array, Array]:
    """The same from two places: also the place of each point's scanner (n, 3), and which scan it is of (n,)."""
    places = np.array([[2, 2.4, 1.5], [5.2, 3.1, 1.6]])
    scans = [scanned_room(place) for place in places]
    number = np.repeat([0, 1], [len(points) for points, _ in scans])
    return np.vstack([points for points, _ in scans]), np.vstack([n for _, n in scans]), places[number], number


def room() -> tuple[Array, Array]:
    """Of eight by five by three meters, with a chest on the floor and a pillar: normals look into the air."""
    walls, outward = box(6000, (8, 5, 3), (0, 0, 1.5))
    chest = box(1000, (1.5, 1, 1), (1.5, 0.5, 0.5), FACES[:4] + FACES[5:])
    pillar = box(1000, (0.4, 0.4, 3), (-2, 1, 1.5), FACES[:4])
    return np.vstack([walls, chest[0], pillar[0]]), np.vstack([-outward, chest[1], pillar[1]])


def corridor() -> tuple[Array, Array]:
    """Round a corner: from one end half of it is not seen."""
    parts = [
        box(4000, (8, 3, 3), (0, 0, 0), [(0, -1), (1, -1), *FACES[4:]]),
        box(900, (5, 3, 3), (-1.5, 0, 0), [(1, 1)]),
        box(4000, (3, 6, 3), (2.5, 4.5, 0), [(0, -1), (0, 1), (1, 1), *FACES[4:]]),
        box(500, (3, 3, 3), (2.5, 0, 0), [(0, 1)]),
    ]
    return np.vstack([points for points, _ in parts]), -np.vstack([normals for _, normals in parts])
