"""Simulated scans: what a scanner, a depth camera, a laser or photogrammetry would give of a mesh.

Meshes are of the unit sphere (`pnu.data.shapes.unit_mesh`), faces outward. Rays are cast by Open3D.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pnu.data.mesh_scene import ray_casting_scene
from pnu.extras import needed
from pnu.geometry.mesh_sampling import sample_area, sample_poisson_disk
from pnu.geometry.sphere_directions import sphere_directions
from pnu.io import Mesh

STEEPEST = 0.3  # cosine of incidence below which noise along the ray grows no further
UP = np.array([0.0, 0.0, 1.0])


class SimulatedScan(NamedTuple):
    """What a scan gives, and what is true of it; one row a point."""

    points: np.ndarray  # (n, 3) as measured
    normals: np.ndarray | None  # (n, 3) as given; None: the scanner knows none
    clean: np.ndarray  # (n, 6) the surface point that was meant, and its outward normal
    sensor: np.ndarray  # (n, 3) place of the sensor; NaN where there is none
    stray: np.ndarray  # (n,) True for what is no measurement of the surface


@dataclass(frozen=True)
class DepthCamera:
    """A sensor that casts a grid of rays, and its faults; lengths in radii of the shape.

    Args:
        distance: of the sensor from the center
        half: of the picture, at distance 1
        across: rays along the first axis of the picture
        down: rays along the second
        noise: standard deviation along the ray, at right angles to the surface; more at a slant
        slant: cosine of incidence below which nothing is seen
        step: of depth along the ray; 0: none
        disparity: step of one over depth along the axis of the picture, as two eyes or a pattern measure it; 0: none
        turn: by which views are misaligned, standard deviation in degrees
        shift: the same in lengths
        torn: share of the points at edges of depth that float between front and background,
        in_place: instead of the points there, one a pixel, as a camera has it; else beside them
        false: share of the pixels whose depth is any
    """

    distance: float = 3.0
    half: float = 0.36
    across: int = 46
    down: int = 46
    noise: float = 0.002
    slant: float = 0.3
    step: float = 0.0
    disparity: float = 0.0
    turn: float = 0.0
    shift: float = 0.0
    torn: float = 0.0
    in_place: bool = False
    false: float = 0.0


@dataclass(frozen=True)
class Photogrammetry:
    """Points matched between pictures: uneven, lumpy, with strays and holes; lengths in radii of the shape.

    Args:
        points: on the surface
        unevenness: densest over sparsest
        noise: of the points, half of it in waves
        near: share of strays around the surface
        far: share of strays anywhere around the shape
        holes: where nothing was matched
        hole: their radius
    """

    points: int = 6000
    unevenness: float = 30.0
    noise: float = 0.006
    near: float = 0.02
    far: float = 0.01
    holes: int = 4
    hole: float = 0.1


class Scanner:
    """A mesh, and the scans of it. The scene of its rays is built once, at the first of them."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.scene: Any = None

    def views(self, sensors: np.ndarray, camera: DepthCamera, rng: np.random.Generator) -> SimulatedScan:
        """What the same camera sees from sensors (v, 3), looking at the center."""
        return _together([self._view(sensor, camera, rng) for sensor in sensors])

    def photogrammetry(self, of: Photogrammetry, rng: np.random.Generator) -> SimulatedScan:
        """Points matched in pictures taken from all sides."""
        many = sample_area(self.mesh, 10 * of.points, rng)
        x = many[:, :3]
        centers = x[rng.integers(len(x), size=6)]
        bumps = np.exp(-((x[:, None] - centers) ** 2).sum(2) / 0.08).sum(1)
        weight = 1 / of.unevenness + np.minimum(bumps, 1)
        holes = x[rng.integers(len(x), size=of.holes)]
        if of.holes:
            weight[((x[:, None] - holes) ** 2).sum(2).min(1) < of.hole**2] = 0
        count = min(of.points, int(np.count_nonzero(weight)))
        clean = many[rng.choice(len(x), count, replace=False, p=weight / weight.sum())]
        waves = np.sin(clean[:, :3] @ (9 * rng.standard_normal((3, 3))).T + rng.uniform(0, 2 * np.pi, 3)).mean(1)
        lump = of.noise * (0.5 * waves + 0.7 * rng.standard_normal(count))
        near = clean[rng.choice(count, round(of.near * count))]
        far = rng.uniform(-1.2, 1.2, (round(of.far * count), 3))
        points = [
            clean[:, :3] + lump[:, None] * clean[:, 3:],
            near[:, :3] + 0.06 * rng.standard_normal((len(near), 3)),
            far,
        ]
        lost = np.full((len(far), 6), np.nan)
        stray = np.repeat([False, True, True], [len(part) for part in points])
        return SimulatedScan(
            np.vstack(points), None, np.vstack([clean, near, lost]), np.full((len(stray), 3), np.nan), stray
        )

    def turned_over(self, n: int, noise: float, share: float, rng: np.random.Generator) -> SimulatedScan:
        """n even points with normals, noisy; the normals of a share of 40 patches look inward."""
        clean = sample_poisson_disk(self.mesh, n, rng)
        patches = clean[rng.choice(n, 40, replace=False), :3]
        patch = ((clean[:, None, :3] - patches) ** 2).sum(2).argmin(1)
        sign = np.where(np.isin(patch, rng.choice(40, round(40 * share), replace=False)), -1.0, 1.0)
        points = clean[:, :3] + noise * rng.standard_normal((n, 3))
        return SimulatedScan(points, clean[:, 3:] * sign[:, None], clean, np.full((n, 3), np.nan), np.zeros(n, bool))

    def _view(self, sensor: np.ndarray, camera: DepthCamera, rng: np.random.Generator) -> SimulatedScan:
        if self.scene is None:
            self.scene = ray_casting_scene([self.mesh], [np.zeros(3)])
        rays = _rays(sensor, camera)
        depth, normals = _cast(self.scene, sensor, rays)
        slant = np.abs((normals * rays).sum(1))
        hit = np.isfinite(depth) & (slant > camera.slant)
        shape = (camera.down, camera.across)
        border = (hit.reshape(shape) & _beside_a_gap(hit.reshape(shape))).ravel()[hit]
        depth, normals, rays, slant = depth[hit], normals[hit], rays[hit], slant[hit]
        measured = depth + camera.noise * rng.standard_normal(len(depth)) / np.maximum(slant, STEEPEST)
        if camera.step:
            measured = np.round(measured / camera.step) * camera.step
        if camera.disparity:
            ahead = rays @ (-sensor / np.linalg.norm(sensor))
            measured = 1 / (np.round(1 / (measured * ahead) / camera.disparity) * camera.disparity * ahead)
        turn, shift = _rotation(rng, camera.turn), camera.shift * rng.standard_normal(3)
        clean = np.hstack([sensor + depth[:, None] * rays, normals])
        edge = np.flatnonzero(border)
        torn = rng.choice(edge, round(camera.torn * len(edge)), replace=False)
        between = measured[torn] + rng.uniform(0.02, 0.4, len(torn))
        measured, rays = np.concatenate([measured, between]), np.vstack([rays, rays[torn]])
        stray = np.arange(len(measured)) >= len(clean)
        clean = np.vstack([clean, clean[torn]])
        if camera.false:
            wrong = rng.choice(len(measured), round(camera.false * len(measured)), replace=False)
            measured[wrong] = camera.distance + rng.uniform(-1, 1, len(wrong))
            stray[wrong] = True
        points = (sensor + measured[:, None] * rays) @ turn.T + shift
        if camera.in_place:
            stays = np.setdiff1d(np.arange(len(points)), torn)
            points, clean, stray = points[stays], clean[stays], stray[stays]
        return SimulatedScan(points, None, clean, np.broadcast_to(sensor, points.shape), stray)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "scene": None}  # a scene cannot be pickled


def orbit(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """Structured light from ten sides, the views not quite aligned."""
    return scanner.views(3.0 * sphere_directions(10, random_turn(rng)), DepthCamera(turn=0.2, shift=0.002), rng)


def oneview(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """One depth camera: one side only, depth in steps, points torn off at edges."""
    camera = DepthCamera(half=0.42, across=110, down=110, slant=0.1, step=0.004, torn=0.25)
    return scanner.views(2.6 * sphere_directions(7, random_turn(rng))[rng.integers(7)][None], camera, rng)


def depth(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """One depth camera of many pixels that measures disparities: steps of depth two or three pixels wide."""
    camera = DepthCamera(half=0.42, across=220, down=220, slant=0.1, disparity=0.005)
    return scanner.views(2.6 * sphere_directions(7, random_turn(rng))[rng.integers(7)][None], camera, rng)


def lines(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """A laser from four places, ten times as dense along a line as across lines."""
    camera = DepthCamera(half=0.38, across=260, down=26, noise=0.0015, slant=0.12)
    return scanner.views(2.8 * sphere_directions(4, random_turn(rng)), camera, rng)


def photo(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """Photogrammetry: uneven 30 to 1, lumpy, 3 % strays, four holes."""
    return scanner.photogrammetry(Photogrammetry(), rng)


def flipped(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """5000 even points with normals, of which a quarter look inward, in patches."""
    return scanner.turned_over(5000, 0.004, 0.25, rng)


def clutter(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """5000 points of little noise, and a quarter as many strewn all around them."""
    return scanner.photogrammetry(Photogrammetry(5000, unevenness=1, noise=0.002, near=0, far=0.25, holes=0), rng)


KINDS: dict[str, Callable[[Scanner, np.random.Generator], SimulatedScan]] = {
    "orbit": orbit, "oneview": oneview, "depth": depth, "lines": lines, "photo": photo, "flipped": flipped,
    "clutter": clutter,
}  # fmt: skip


def any_scan(scanner: Scanner, rng: np.random.Generator) -> SimulatedScan:
    """A scan to train on: any kind, resolution, noise and faults around those of `KINDS`."""
    kind = rng.choice(["views", "one", "lines", "photo"], p=[0.3, 0.2, 0.25, 0.25])
    noise = _log_uniform(rng, 0.0007, 0.006)
    if kind == "photo":
        of = Photogrammetry(
            int(_log_uniform(rng, 1500, 9000)), _log_uniform(rng, 2, 60), _log_uniform(rng, 0.001, 0.012),
            rng.uniform(0, 0.05), rng.uniform(0, 0.02), int(rng.integers(0, 6)), rng.uniform(0.03, 0.15),
        )  # fmt: skip
        return scanner.photogrammetry(of, rng)
    distance = rng.uniform(2.2, 4)
    fit = 1.08 / np.sqrt(distance**2 - 1)  # the whole shape, tightly
    camera = DepthCamera(
        distance, fit * rng.uniform(0.7, 1.1), noise=noise, slant=rng.uniform(0.05, 0.4),
        step=rng.uniform(0.001, 0.006) if rng.random() < 0.3 else 0.0,
        turn=rng.uniform(0, 0.4), shift=rng.uniform(0, 0.004), torn=rng.uniform(0, 0.4) if rng.random() < 0.6 else 0.0,
    )  # fmt: skip
    if kind == "one":
        side = int(_log_uniform(rng, 45, 140))
        count, size = 1, (side, side)
    elif kind == "views":
        count, side = int(rng.integers(2, 14)), int(_log_uniform(rng, 24, 70))
        size = side, side
    else:
        count, down = int(rng.integers(1, 6)), int(_log_uniform(rng, 16, 45))
        size = int(down * _log_uniform(rng, 3, 16)), down
    camera = replace(camera, across=size[0], down=size[1])
    return scanner.views(distance * sphere_directions(max(count, 3), random_turn(rng))[:count], camera, rng)


def random_turn(rng: np.random.Generator) -> float:
    """An angle for `sphere_directions`."""
    return float(rng.uniform(0, 2 * np.pi))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _rays(sensor: np.ndarray, camera: DepthCamera) -> np.ndarray:
    """Unit directions of a grid of rays through the center, (down across, 3), row by row."""
    ahead = -sensor / np.linalg.norm(sensor)
    right = np.cross(ahead, UP if abs(ahead[2]) < 0.9 else UP[[2, 1, 0]])
    right /= np.linalg.norm(right)
    u, v = np.meshgrid(*(np.linspace(-camera.half, camera.half, count) for count in (camera.across, camera.down)))
    rays = u[..., None] * right + v[..., None] * np.cross(ahead, right) + ahead
    units: np.ndarray = rays.reshape(-1, 3) / np.linalg.norm(rays, axis=-1).reshape(-1, 1)
    return units


def _cast(scene: Any, sensor: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth along unit rays (m,), infinite where nothing is hit, and unit normals there (m, 3)."""
    with needed("the simulated scanner"):
        import open3d

    origin = np.broadcast_to(sensor, rays.shape)
    hits = scene.cast_rays(open3d.core.Tensor.from_numpy(np.hstack([origin, rays]).astype(np.float32)), nthreads=1)
    depth, normals = hits["t_hit"].numpy().astype(float), hits["primitive_normals"].numpy().astype(float)
    return depth, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _beside_a_gap(hit: np.ndarray) -> np.ndarray:
    """Which pixels (h, w) have one of their four neighbors empty or outside the picture."""
    padded = np.pad(hit, 1)
    inner: np.ndarray = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return ~inner


def _rotation(rng: np.random.Generator, degrees: float) -> np.ndarray:
    """Rotation about a random axis by a normal angle of that standard deviation (Rodrigues' formula)."""
    axis = rng.standard_normal(3)
    x, y, z = axis / np.linalg.norm(axis)
    angle = np.radians(degrees * rng.standard_normal())
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: np.ndarray = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotation


def _together(scans: Sequence[SimulatedScan]) -> SimulatedScan:
    return SimulatedScan(
        np.vstack([s.points for s in scans]), None,
        *(np.concatenate([getattr(s, name) for s in scans]) for name in ("clean", "sensor", "stray")),
    )  # fmt: skip
