"""Scenes whose normals are known: land with houses, a room, a corridor. Points and unit normals (n, 3) each."""

import numpy as np

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
