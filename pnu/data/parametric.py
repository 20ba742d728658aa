"""Closed meshes from parameters: surfaces of revolution, tubes along curves, star-shaped bodies; smooth noise."""

from collections.abc import Callable

import numpy as np
from manifold3d import Manifold
from scipy.interpolate import PchipInterpolator

from pnu.data.implicit import split_quads
from pnu.io import Mesh


def smooth_curve(control: np.ndarray, samples: int) -> np.ndarray:
    """Monotone cubic through control points (m, d), evenly sampled in chord length: (samples, d); never overshoots."""
    chord = np.concatenate([[0], np.linalg.norm(np.diff(control, axis=0), axis=1).cumsum()])
    curve: np.ndarray = PchipInterpolator(chord, control)(np.linspace(0, chord[-1], samples))
    return curve


def revolution(control: list[tuple[float, float]], segments: int = 128, samples: int = 160) -> Mesh:
    """Turns a smooth profile of (radius, height) points around z. Both ends must lie on the axis (radius 0)."""
    profile = smooth_curve(np.asarray(control, float), samples)
    angle = 2 * np.pi * np.arange(segments) / segments
    radius, height = profile[1:-1].T
    rings = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.tile(height[:, None], segments)], axis=-1
    )
    return tubular(rings, ends=(np.array([0, 0, profile[0, 1]]), np.array([0, 0, profile[-1, 1]])))


def tube(
    curve: Callable[[np.ndarray], np.ndarray],
    radius: Callable[[np.ndarray], np.ndarray] | float,
    *,
    closed: bool = True,
    samples: int = 400,
    segments: int = 40,
    flat: float = 1.0,
    turns: float = 0.0,
) -> Mesh:
    """Tube around curve(t), t in [0, 1), with a radius that may depend on t; open tubes get round ends.

    The section is an ellipse, flatter for flat < 1, that makes `turns` turns along the tube (a half turn closes too).
    """
    t = np.arange(samples) / samples if closed else np.linspace(0, 1, samples)
    center = curve(t)
    size = np.broadcast_to(radius if isinstance(radius, int | float) else radius(t), samples).copy()
    if not closed:
        length = np.linalg.norm(np.diff(center, axis=0), axis=1).sum()
        for distance, r in ((t * length, size[0]), ((1 - t) * length, size[-1])):
            near = np.clip(1 - distance / r, 0, 1)
            size *= np.sqrt(1 - near**2)
    tangent = np.roll(center, -1, 0) - np.roll(center, 1, 0) if closed else np.gradient(center, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = transported(tangent)
    angle = np.zeros(samples)
    if closed:  # the frame comes back turned: spread that angle over the tube
        back = transported(np.stack([tangent[-1], tangent[0]]), side[-1])[1]
        missing = np.arctan2(np.cross(side[0], back) @ tangent[0], back @ side[0])
        angle = (2 * np.pi * turns - missing) * t
    around = 2 * np.pi * np.arange(segments) / segments
    x, y = np.cos(around), flat * np.sin(around)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    up = np.cross(tangent, side)
    rings = center[:, None] + size[:, None, None] * (
        (c * x - s * y)[..., None] * side[:, None] + (s * x + c * y)[..., None] * up[:, None]
    )
    if closed:
        return tubular(rings, shift=round(turns * segments))
    return tubular(rings[1:-1], ends=(center[0], center[-1]))


def transported(tangent: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Unit vectors (m, 3) normal to the tangents (m, 3), carried along without turning about them."""
    side = np.empty_like(tangent)
    first = np.cross(tangent[0], np.eye(3)[np.abs(tangent[0]).argmin()]) if start is None else start
    for i, direction in enumerate(tangent):
        first = first - (first @ direction) * direction
        side[i] = first = first / np.linalg.norm(first)
    return side


def tubular(rings: np.ndarray, ends: tuple[np.ndarray, np.ndarray] | None = None, shift: int = 0) -> Mesh:
    """Mesh of rings (m, s, 3), closed by a point at both ends or, without, from last to first ring moved by `shift`."""
    m, s, _ = rings.shape
    grid = np.arange(m * s).reshape(m, s)
    below = grid if ends is None else grid[:-1]
    above = np.concatenate([grid[1:], np.roll(grid[:1], -shift, axis=1)]) if ends is None else grid[1:]
    quads = np.stack([below, np.roll(below, -1, 1), np.roll(above, -1, 1), above], axis=-1).reshape(-1, 4)
    vertices = rings.reshape(-1, 3)
    faces = split_quads(vertices, quads)
    if ends is not None:
        vertices = np.concatenate([vertices, ends])
        first, last, n = grid[0], grid[-1], m * s
        faces = np.concatenate(
            [
                faces,
                np.stack([np.full(s, n), np.roll(first, -1), first], axis=1),
                np.stack([np.full(s, n + 1), last, np.roll(last, -1)], axis=1),
            ]
        )
    return Mesh(vertices, faces)


def star_shaped(radius: Callable[[np.ndarray], np.ndarray], segments: int = 176) -> Mesh:
    """Body whose surface lies at distance radius(d) > 0 from the origin in each unit direction d (n, 3)."""
    ball = Manifold.sphere(1, segments).to_mesh64()
    direction = np.asarray(ball.vert_properties)[:, :3]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return Mesh(radius(direction)[:, None] * direction, np.asarray(ball.tri_verts, np.int64))


def waves(seed: int, low: float, high: float, count: int = 24) -> Callable[[np.ndarray], np.ndarray]:
    """Smooth noise of points (n, 3) with unit variance: plane waves with wave numbers in [low, high]."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction *= (rng.uniform(low, high, count) / np.linalg.norm(direction, axis=1))[:, None]
    phase = rng.uniform(0, 2 * np.pi, count)
    return lambda p: np.sqrt(2 / count) * np.sin(p @ direction.T + phase).sum(axis=1)
