"""Smooth procedural shapes: animals and plants, vessels, knots, noise. Each function returns a closed mesh."""

from collections.abc import Callable

import numpy as np

from pnu.data.implicit import Field, capsule, cut, ellipsoid, polyline, sphere, surface_nets, torus, union
from pnu.data.parametric import revolution, smooth_curve, star_shaped, tube, waves
from pnu.io import Mesh


def mirrored(*parts: Field) -> list[Field]:
    """The parts and their mirror images in y."""
    flip = np.array([1, -1, 1])
    return [*parts, *((lambda p, part=part: part(p * flip)) for part in parts)]


def quadruped(
    leg: float = 0.5, body: float = 0.4, girth: float = 0.17, neck: float = 0.4, head: float = 0.13, tail: float = 0.35
) -> Mesh:
    """Four-legged animal; lengths of its parts relative to the box of half size 1."""
    front, back = np.array([body, 0, 0.05]), np.array([-body, 0, 0.02])
    nape = front + [0.5 * neck, 0, neck]
    muzzle = nape + [1.9 * head, 0, -0.5 * head]
    parts = [
        capsule(back, front, girth, 1.1 * girth),
        capsule(front + [0, 0, 0.05], nape, 0.7 * girth, 0.7 * head),
        capsule(nape, muzzle, head, 0.55 * head),
        polyline(
            back + np.array([[0, 0, 0.1], [-0.3, 0, 0.1], [-0.6, 0, -0.3]]) * [tail, 1, tail], [0.05, 0.035, 0.03]
        ),
    ]
    parts += mirrored(
        polyline(np.array([[body, 0.7 * girth, 0], [body + 0.04, 0.8 * girth, -0.5 * leg], [body, 0.8 * girth, -leg],
                           [body + 0.07, 0.8 * girth, -leg]]), np.array([0.5, 0.36, 0.3, 0.3]) * girth),
        polyline(np.array([[-body, 0.7 * girth, 0], [-body - 0.08, 0.8 * girth, -0.5 * leg], [-body, 0.8 * girth, -leg],
                           [-body + 0.07, 0.8 * girth, -leg]]), np.array([0.6, 0.36, 0.3, 0.3]) * girth),
        capsule(nape + [-0.02, 0.6 * head, 0.5 * head], nape + [-0.1, 0.9 * head, 1.5 * head], 0.04, 0.025),
    )  # fmt: skip
    return surface_nets(union(*parts, k=0.025), [1, 0.4, 0.95])


def person(arm: tuple[float, float] = (0.35, -0.25), stride: float = 0.12, lean: float = 0.0) -> Mesh:
    """Human figure; `arm` is where the left hand goes (sideways, up), mirrored for the right; legs part by `stride`."""
    hip, chest, neck = np.array([0, 0, 0.0]), np.array([lean, 0, 0.33]), np.array([1.4 * lean, 0, 0.5])
    parts = [
        ellipsoid((0, 0, 0.02), (0.13, 0.17, 0.13)),
        ellipsoid(chest, (0.12, 0.19, 0.2)),
        capsule(hip, chest, 0.12),
        capsule(neck - [0, 0, 0.05], neck + [0, 0, 0.1], 0.055),
        ellipsoid(neck + [0.02, 0, 0.2], (0.125, 0.1, 0.145)),
    ]
    shoulder = chest + [0, 0.2, 0.1]
    for side, swing in ((1, stride), (-1, -stride)):
        flip = np.array([1, side, 1])
        hand = shoulder + [0.08 - swing, *arm]
        elbow = (shoulder + hand) / 2 + [-0.06, 0.05, -0.03]
        parts.append(polyline(np.array([shoulder, elbow, hand]) * flip, [0.07, 0.052, 0.045]))
        parts.append(sphere(hand * flip, 0.06))
        knee, foot = np.array([0.5 * swing + 0.05, 0.12, -0.4]), np.array([swing, 0.13, -0.8])
        parts.append(polyline(np.array([[0, 0.1, -0.03], knee, foot, foot + [0.14, 0.02, -0.03]]) * flip,
                              [0.1, 0.075, 0.055, 0.045]))  # fmt: skip
    return surface_nets(union(*parts, k=0.022), [0.7, 0.85, 0.95], 88)


def bird() -> Mesh:
    """A bird, around the origin."""
    tail = ellipsoid((-0.62, 0, 0.16), (0.3, 0.16, 0.035))
    parts = [ellipsoid((0, 0, 0), (0.5, 0.3, 0.3)), capsule((0.35, 0, 0.1), (0.5, 0, 0.5), 0.16, 0.1), tail,
             sphere((0.53, 0, 0.58), 0.16), capsule((0.62, 0, 0.57), (0.85, 0, 0.52), 0.07, 0.02)]  # fmt: skip
    parts += mirrored(
        ellipsoid((-0.12, 0.29, 0.06), (0.4, 0.05, 0.2)),
        polyline(np.array([[0.05, 0.12, -0.2], [0.02, 0.13, -0.55], [0.18, 0.14, -0.58]]), [0.05, 0.035, 0.03]),
    )
    return surface_nets(union(*parts, k=0.02), [0.95, 0.4, 0.78])


def fish(height: float = 0.34, width: float = 0.16) -> Mesh:
    """A fish, around the origin."""
    fin = ellipsoid((-0.1, 0, 0.95 * height), (0.3, 0.03, 0.16))
    parts = [ellipsoid((0.1, 0, 0), (0.65, width, height)), capsule((-0.4, 0, 0), (-0.65, 0, 0), 0.1, 0.05), fin]
    parts += [ellipsoid((-0.75, 0, 0.16 * s), (0.09, 0.03, 0.26), tilt(1, -0.6 * s)) for s in (1, -1)]
    parts += mirrored(
        ellipsoid((0.15, 1.1 * width, -0.4 * height), (0.16, 0.09, 0.035)), sphere((0.5, 0.7 * width, 0.08), 0.06)
    )
    return surface_nets(union(*parts, k=0.02), [0.95, 0.4, 0.7])


def octopus() -> Mesh:
    """An octopus, around the origin."""
    parts = [ellipsoid((0, 0, 0.35), (0.26, 0.26, 0.36))]
    for i in range(8):
        a = np.pi * (2 * i + 1) / 8
        out, lift = np.array([np.cos(a), np.sin(a), 0]), np.array([0, 0, 0.07 * (-1) ** i])
        joints = np.stack(
            [0.12 * out, 0.35 * out + [0, 0, -0.1], 0.62 * out + [0, 0, -0.3], 0.88 * out - [0, 0, 0.16] + lift]
        )
        parts.append(polyline(smooth_curve(joints, 5), np.linspace(0.12, 0.035, 5)))
    parts += mirrored(sphere((0.2, 0.13, 0.2), 0.07))
    return surface_nets(union(*parts, k=0.025), [1, 1, 0.8], 80)


def hand() -> Mesh:
    """A hand, around the origin."""
    parts = [ellipsoid((0, 0, -0.12), (0.31, 0.13, 0.34)), capsule((0, 0, -0.3), (0, 0, -0.75), 0.15, 0.17)]
    for x, length, spread in ((-0.23, 0.42, -0.12), (-0.08, 0.52, -0.03), (0.07, 0.49, 0.05), (0.21, 0.38, 0.14)):
        joints = np.array(
            [[x, 0, 0.1], [x + 0.5 * spread, -0.03, 0.12 + 0.55 * length], [x + spread, 0.04, 0.12 + length]]
        )
        parts.append(polyline(joints, [0.08, 0.07, 0.058]))
    parts.append(polyline(np.array([[-0.2, 0.02, -0.25], [-0.42, 0.1, -0.08], [-0.5, 0.14, 0.12]]), [0.11, 0.09, 0.07]))
    return surface_nets(union(*parts, k=0.018), [0.66, 0.35, 0.98], 80)


def head() -> Mesh:
    """A head, around the origin."""
    parts = [ellipsoid((-0.05, 0, 0.2), (0.43, 0.35, 0.42)), ellipsoid((0.1, 0, -0.12), (0.3, 0.25, 0.34)),
             capsule((-0.05, 0, -0.2), (-0.12, 0, -0.75), 0.2, 0.22), ellipsoid((-0.1, 0, -0.8), (0.28, 0.5, 0.12)),
             capsule((0.37, 0, 0.12), (0.47, 0, -0.06), 0.035, 0.065), ellipsoid((0.37, 0, -0.2), (0.06, 0.12, 0.03)),
             ellipsoid((0.36, 0, -0.26), (0.06, 0.1, 0.035)), sphere((0.33, 0, -0.4), 0.08)]  # fmt: skip
    parts += mirrored(
        torus((-0.06, 0.35, 0.05), 0.08, 0.03, axis=1), capsule((0.36, 0.05, 0.2), (0.28, 0.24, 0.2), 0.05)
    )
    eyes = mirrored(ellipsoid((0.4, 0.13, 0.1), (0.09, 0.09, 0.06)))
    pupils = mirrored(sphere((0.33, 0.13, 0.1), 0.06))
    return surface_nets(union(cut(union(*parts, k=0.025), *eyes), *pupils, k=0.01), [0.65, 0.66, 0.98], 84)


def teddy() -> Mesh:
    """A teddy, around the origin."""
    parts = [
        ellipsoid((0, 0, -0.2), (0.3, 0.33, 0.36)),
        sphere((0, 0, 0.37), 0.3),
        ellipsoid((0.26, 0, 0.3), (0.13, 0.14, 0.11)),
    ]
    parts += mirrored(
        ellipsoid((-0.02, 0.24, 0.62), (0.06, 0.13, 0.13)),
        capsule((0.02, 0.28, 0), (0.25, 0.5, -0.12), 0.12, 0.11),
        capsule((0.1, 0.2, -0.45), (0.48, 0.28, -0.5), 0.15, 0.14),
        sphere((0.26, 0.11, 0.43), 0.04),
    )
    return surface_nets(union(*parts, k=0.018), [0.7, 0.72, 0.85])


def mushroom() -> Mesh:
    """A mushroom, around the origin."""
    return revolution([(0, -0.7), (0.2, -0.69), (0.27, -0.55), (0.17, -0.2), (0.16, 0.1), (0.3, 0.08), (0.6, 0),
                       (0.72, 0.05), (0.66, 0.25), (0.4, 0.5), (0.15, 0.58), (0, 0.6)])  # fmt: skip


def cactus() -> Mesh:
    """A cactus, around the origin."""

    def ribs(p: np.ndarray) -> np.ndarray:
        depth: np.ndarray = (
            0.018 * np.cos(10 * np.arctan2(p[:, 1], p[:, 0])) * np.minimum(np.hypot(p[:, 0], p[:, 1]) / 0.15, 1)
        )
        return depth

    trunk = capsule((0, 0, -0.7), (0, 0, 0.7), 0.2, 0.19)
    arms = [polyline(np.array([[0.1, 0, -0.1], [0.45, 0, 0], [0.5, 0, 0.4]]), [0.1, 0.11, 0.1]),
            polyline(np.array([[-0.1, 0, -0.35], [-0.4, 0.05, -0.25], [-0.45, 0.08, 0.2]]), [0.1, 0.1, 0.09])]  # fmt: skip
    pot = ellipsoid((0, 0, -0.75), (0.34, 0.34, 0.16))
    return surface_nets(union(lambda p: trunk(p) + ribs(p), *arms, pot, k=0.025), [0.7, 0.5, 1])


def tree(seed: int = 5, levels: int = 3) -> Mesh:
    """Branches that fork and thin out."""
    rng = np.random.default_rng(seed)
    parts: list[Field] = [ellipsoid((0, 0, -0.85), (0.26, 0.26, 0.06))]

    def grow(start: np.ndarray, direction: np.ndarray, length: float, radius: float, level: int) -> None:
        end = start + length * direction
        parts.append(capsule(start, end, radius, 0.75 * radius))
        for _ in range(0 if level == 0 else 3 if level == levels else 2):
            fork = direction + 0.75 * rng.normal(size=3) + [0, 0, 0.15]
            grow(end, fork / np.linalg.norm(fork), 0.68 * length, 0.68 * radius, level - 1)

    grow(np.array([0, 0, -0.85]), np.array([0, 0, 1.0]), 0.7, 0.13, levels)
    return surface_nets(union(*parts, k=0.02), [1.3, 1.3, 1.2], 88)


def vase() -> Mesh:
    """A vase, around the origin."""
    return revolution([(0, -0.9), (0.3, -0.9), (0.36, -0.8), (0.52, -0.3), (0.5, 0.1), (0.24, 0.5), (0.22, 0.7), (0.36, 0.9),
                       (0.33, 0.92), (0.18, 0.7), (0.2, 0.5), (0.44, 0.1), (0.46, -0.3), (0.3, -0.74), (0, -0.8)])  # fmt: skip


def goblet() -> Mesh:
    """A goblet, around the origin."""
    return revolution([(0, -0.9), (0.42, -0.88), (0.43, -0.85), (0.1, -0.75), (0.06, -0.4), (0.12, -0.3), (0.06, -0.2),
                       (0.2, -0.08), (0.42, 0.2), (0.45, 0.5), (0.38, 0.85), (0.35, 0.85), (0.41, 0.5), (0.37, 0.2),
                       (0.15, 0), (0, -0.03)])  # fmt: skip


def bottle() -> Mesh:
    """A bottle, around the origin."""
    return revolution([(0, -0.9), (0.3, -0.9), (0.34, -0.84), (0.34, -0.2), (0.34, 0.1), (0.15, 0.42), (0.12, 0.7), (0.12, 0.82),
                       (0.16, 0.84), (0.16, 0.94), (0.1, 0.95), (0.09, 0.82), (0, 0.8)])  # fmt: skip


def pawn() -> Mesh:
    """A pawn, around the origin."""
    return revolution([(0, -0.8), (0.42, -0.8), (0.45, -0.72), (0.38, -0.58), (0.4, -0.52), (0.26, -0.42), (0.15, 0), (0.13, 0.16),
                       (0.28, 0.24), (0.28, 0.29), (0.15, 0.34), (0.25, 0.45), (0.28, 0.57), (0.22, 0.74), (0, 0.84)])  # fmt: skip


def queen() -> Mesh:
    """Chess queen: a turned body with a notched crown."""
    body = revolution([(0, -1), (0.42, -1), (0.44, -0.9), (0.33, -0.76), (0.35, -0.7), (0.2, -0.52), (0.12, 0), (0.13, 0.3),
                       (0.26, 0.36), (0.14, 0.42), (0.17, 0.5), (0.3, 0.78), (0.24, 0.82), (0.1, 0.74), (0.1, 0.85),
                       (0, 0.93)])  # fmt: skip
    x, y, z = body.vertices.T
    notch = 1 + 0.14 * np.cos(8 * np.arctan2(y, x)) * np.clip((z - 0.5) / 0.25, 0, 1) * (np.hypot(x, y) > 0.12)
    return Mesh(np.stack([x * notch, y * notch, z], axis=1), body.faces)


def bell() -> Mesh:
    """A bell, around the origin."""
    return revolution([(0, 0.38), (0.2, 0.32), (0.3, 0), (0.36, -0.3), (0.58, -0.63), (0.65, -0.6), (0.44, -0.3),
                       (0.37, 0), (0.3, 0.42), (0.14, 0.54), (0.07, 0.62), (0.12, 0.72), (0, 0.8)])  # fmt: skip


def bowl() -> Mesh:
    """A bowl, around the origin."""
    return revolution([(0, -0.4), (0.28, -0.4), (0.3, -0.34), (0.6, -0.15), (0.85, 0.35), (0.83, 0.38), (0.79, 0.35), (0.55, -0.08),
                       (0.25, -0.26), (0, -0.28)])  # fmt: skip


def mug() -> Mesh:
    """A mug, around the origin."""
    body = union(drum(0.5, 0.6, 0.05), torus((0.52, 0, 0), 0.32, 0.075, axis=1), k=0.02)
    return surface_nets(cut(body, lambda p: drum(0.41, 0.6, 0.1)(p - [0, 0, 0.15]), k=0.012), [1, 0.6, 0.7], 84)


def teapot() -> Mesh:
    """A teapot, around the origin."""
    body = union(
        ellipsoid((0, 0, -0.05), (0.55, 0.55, 0.42)),
        ellipsoid((0, 0, 0.33), (0.3, 0.3, 0.09)),
        sphere((0, 0, 0.47), 0.08),
        ellipsoid((0, 0, -0.42), (0.36, 0.36, 0.06)),
        polyline(
            np.array([[0.4, 0, -0.15], [0.68, 0, 0.02], [0.78, 0, 0.28], [0.93, 0, 0.36]]), [0.15, 0.1, 0.07, 0.07]
        ),
        torus((-0.55, 0, 0), 0.3, 0.055, axis=1),
        k=0.02,
    )
    spout = capsule((0.84, 0, 0.3), (1.08, 0, 0.44), 0.03, 0.045)
    return surface_nets(cut(body, spout, k=0.008), [1.05, 0.62, 0.62], 96)


def pear() -> Mesh:
    """A pear, around the origin."""

    def radius(d: np.ndarray) -> np.ndarray:
        z = d[:, 2]
        r: np.ndarray = (
            0.62 + 0.25 * np.clip(z, 0, 1) ** 2 - 0.12 * np.sin(2.2 * z) - 0.1 * np.exp(-((z + 1) ** 2) / 0.02)
        )
        return r

    return star_shaped(radius)


def apple() -> Mesh:
    """An apple, around the origin."""
    fruit = star_shaped(lambda d: 0.75 - 0.45 * np.exp((d[:, 2] - 1) / 0.08) - 0.2 * np.exp(-(d[:, 2] + 1) / 0.05))
    lobes = 1 + 0.03 * np.cos(5 * np.arctan2(*fruit.vertices[:, 1::-1].T)) * np.clip(-fruit.vertices[:, 2], 0, 1)
    return Mesh(fruit.vertices * lobes[:, None], fruit.faces)


def pumpkin() -> Mesh:
    """A pumpkin, around the origin."""

    def radius(d: np.ndarray) -> np.ndarray:
        rim = np.hypot(d[:, 0], d[:, 1])
        ribs = np.abs(np.cos(5 * np.arctan2(d[:, 1], d[:, 0]))) ** 0.7
        r: np.ndarray = (0.62 + 0.3 * rim**2) * (1 - 0.13 * rim * (1 - ribs)) - 0.15 * np.exp((d[:, 2] - 1) / 0.05)
        return r

    return star_shaped(radius, 240)


def banana() -> Mesh:
    """A banana, around the origin."""

    def curve(t: np.ndarray) -> np.ndarray:
        a = 2.4 * (t - 0.5)
        return np.stack([0.75 * np.sin(a), 0 * a, -0.75 * np.cos(a)], axis=1)

    return tube(curve, lambda t: 0.05 + 0.14 * np.sin(np.pi * t) ** 0.6, closed=False, flat=0.85, samples=200)


def nautilus() -> Mesh:
    """Shell: a tube that widens along a flat spiral, its coils blended."""
    a = np.linspace(0, 4.4 * np.pi, 48)
    growth = np.exp(0.115 * (a - a[-1]))
    coil = np.stack([0.62 * growth * np.cos(a), 0.06 * a / a[-1], 0.62 * growth * np.sin(a)], axis=1)
    ahead = (coil[-1] - coil[-2]) / np.linalg.norm(coil[-1] - coil[-2])
    mouth = sphere(coil[-1] + 0.24 * ahead, 0.25)
    return surface_nets(cut(polyline(coil, 0.36 * growth, k=0.006), mouth, k=0.01), [1.05, 0.5, 1.05], 64)


def snail() -> Mesh:
    """A snail, around the origin."""
    a = np.linspace(0, 5 * np.pi, 44)
    growth = np.exp(0.1 * (a - a[-1]))
    coil = np.stack([0.34 * growth * np.cos(a) - 0.1, 0.2 * (1 - growth), 0.34 * growth * np.sin(a) + 0.15], axis=1)
    foot = polyline(
        np.array([[-0.75, 0, -0.35], [-0.3, 0, -0.3], [0.3, 0, -0.3], [0.55, 0, 0.0]]), [0.04, 0.13, 0.13, 0.12]
    )
    horns = mirrored(capsule((0.58, 0.05, 0.05), (0.72, 0.12, 0.3), 0.035, 0.04))
    return surface_nets(union(polyline(coil, 0.2 * growth), foot, *horns, k=0.008), [0.85, 0.45, 0.75], 76)


def bone() -> Mesh:
    """A bone, around the origin."""
    parts = [capsule((-0.6, 0, 0), (0.6, 0, 0), 0.15)]
    parts += mirrored(sphere((0.7, 0.14, 0.02), 0.2), sphere((-0.7, 0.13, -0.03), 0.21))
    return surface_nets(union(*parts, k=0.06), [1, 0.5, 0.4])


def starfish() -> Mesh:
    """A starfish, around the origin."""

    def body(p: np.ndarray) -> np.ndarray:
        a, r = np.arctan2(p[:, 1], p[:, 0]), np.hypot(p[:, 0], p[:, 1])
        reach = 0.42 + 0.36 * np.cos(5 * a) * np.minimum(r / 0.3, 1)
        distance: np.ndarray = 0.5 * (np.hypot(r / np.maximum(reach, 0.05) * 0.5, p[:, 2] / 0.26 * 0.5) - 0.5)
        return distance

    bumps = waves(3, 14, 22)
    return surface_nets(lambda p: body(p) + 0.006 * bumps(p), [0.95, 0.95, 0.4])


def urchin() -> Mesh:
    """Ball with blunt spikes along a Fibonacci spiral."""
    n = 40
    z = 1 - (2 * np.arange(n) + 1) / n
    a = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    tips = np.stack([np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), z], axis=1)
    return star_shaped(lambda d: 0.6 + 0.35 * np.exp((np.max(d @ tips.T, axis=1) - 1) / 0.012), 352)


def blob(seed: int, balls: int = 9) -> Mesh:
    """Random balls along a wandering path, blended."""
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(scale=0.32, size=(balls, 3)), axis=0)
    path -= path.mean(0)
    path *= 0.7 / np.abs(path).max()
    parts = [sphere(c, r) for c, r in zip(path, rng.uniform(0.12, 0.3, balls), strict=True)]
    return surface_nets(union(*parts, polyline(path, np.full(balls, 0.08)), k=0.05), 1.15)


def rock(seed: int, low: float = 1.5, high: float = 5, amount: float = 0.12, flat: float = 0.75) -> Mesh:
    """Ball displaced by noise of wave numbers low..high; craters and lumps stay star-shaped."""
    noise, stretch = waves(seed, low, high), np.array([1, 0.9, flat])
    body = star_shaped(lambda d: 0.75 * np.exp(amount * noise(d)))
    return Mesh(body.vertices * stretch, body.faces)


def wrinkled(seed: int = 8) -> Mesh:
    """Ball with ridges and grooves, like a walnut or a brain."""
    noise = waves(seed, 7, 11)
    return star_shaped(
        lambda d: 0.8 - 0.08 * np.exp(-(noise(d) ** 2) / 0.12) - 0.14 * np.exp(-(d[:, 1] ** 2) / 0.004), 352
    )


def harmonic(m: int, n: int, depth: float) -> Mesh:
    """Ball with m lobes around and n along its axis."""
    return star_shaped(lambda d: 0.7 * (1 + depth * np.cos(m * np.arctan2(d[:, 1], d[:, 0]))
                                        * (1 - d[:, 2] ** 2) ** (m / 2) * np.cos(n * np.arccos(d[:, 2]))))  # fmt: skip


def superquadric(power: float, pinch: float) -> Mesh:
    """Box-like for powers above 2, star-like below 1; pinched towards one end."""
    body = star_shaped(lambda d: 0.8 * (np.abs(d) ** power).sum(1) ** (-1 / power), 220)
    x, y, z = body.vertices.T
    return Mesh(np.stack([x * (1 - pinch * z), y * (1 - pinch * z), z], axis=1), body.faces)


def knot(p: int, q: int, radius: float = 0.13, flat: float = 1.0, turns: float = 0.0) -> Mesh:
    """Torus knot (p, q) as a tube."""

    def curve(t: np.ndarray) -> np.ndarray:
        a = 2 * np.pi * t
        ring = 0.6 + 0.28 * np.cos(q * a)
        return np.stack([ring * np.cos(p * a), ring * np.sin(p * a), 0.28 * np.sin(q * a)], axis=1)

    return tube(curve, radius, samples=500, flat=flat, turns=turns)


def figure_eight() -> Mesh:
    """A figure eight, around the origin."""

    def curve(t: np.ndarray) -> np.ndarray:
        a = 2 * np.pi * t
        ring = 0.55 + 0.27 * np.cos(2 * a)
        return np.stack([ring * np.cos(3 * a), ring * np.sin(3 * a), 0.4 * np.sin(4 * a)], axis=1)

    return tube(curve, lambda t: 0.1 + 0.025 * np.cos(8 * np.pi * t), samples=500)


def ring(turns: float, flat: float) -> Mesh:
    """Torus with a flat section that turns on its way round (half a turn: a thick Moebius band)."""

    def curve(t: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t), 0 * t], axis=1)

    return tube(curve, 0.36, flat=flat, turns=turns, samples=300, segments=64)


def coil() -> Mesh:
    """Spring of four turns."""

    def curve(t: np.ndarray) -> np.ndarray:
        a = 8 * np.pi * t
        return np.stack([0.5 * np.cos(a), 0.5 * np.sin(a), 1.4 * t - 0.7], axis=1)

    return tube(curve, 0.1, closed=False, samples=500)


def chain() -> Mesh:
    """Three links that hang in each other."""
    links = [torus((x, 0, 0), 0.26, 0.075, axis=axis) for x, axis in ((-0.33, 2), (0, 1), (0.33, 2))]
    return surface_nets(union(*links), [0.75, 0.42, 0.42], 90)


def holes(count: int) -> Mesh:
    """Plump plate with `count` holes in a ring."""
    angle = 2 * np.pi * np.arange(count) / count
    rings = [torus((0.42 * np.cos(a), 0.42 * np.sin(a), 0), 0.3, 0.13) for a in angle]
    return surface_nets(union(*rings, k=0.04), [0.95, 0.95, 0.35], 80)


def gyroid(level: float = 0.35) -> Mesh:
    """Gyroid sheet cut by a ball: thin curved walls, many handles."""

    def sheet(p: np.ndarray) -> np.ndarray:
        x, y, z = (4.4 * p).T
        value = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
        distance: np.ndarray = (np.abs(value) - level) / 6
        return distance

    return surface_nets(cut(sheet, lambda p: 0.85 - np.linalg.norm(p, axis=1), k=0.01), 0.95, 80)


def lattice() -> Mesh:
    """Schwarz P body in a rounded box: a smooth foam of pipes."""

    def pipes(p: np.ndarray) -> np.ndarray:
        distance: np.ndarray = np.cos(5.2 * p).sum(1) / 6 + 0.05
        return distance

    def outside(p: np.ndarray) -> np.ndarray:
        distance: np.ndarray = 0.75 - (p**8).sum(1) ** (1 / 8)
        return distance

    return surface_nets(cut(pipes, outside, k=0.02), 0.9, 80)


def cloth() -> Mesh:
    """Draped sheet, thin and wavy, with a rounded rim."""
    fold = waves(12, 2, 5)

    def sheet(p: np.ndarray) -> np.ndarray:
        height = p[:, 2] - 0.13 * fold(p * [1, 1, 0]) + 0.35 * (p[:, 0] ** 2 + p[:, 1] ** 2)
        side = np.hypot(p[:, 0], p[:, 1]) - 0.85
        distance: np.ndarray = np.hypot(np.maximum(side, 0), 0.75 * height) - 0.045
        return distance

    return surface_nets(sheet, [1, 1, 0.85], 90)


def coral(seed: int = 2) -> Mesh:
    """Noise carved out of a ball, largest holes open."""
    noise = waves(seed, 4.5, 7.5, 48)

    def field(p: np.ndarray) -> np.ndarray:
        return -union(lambda q: 0.8 - np.linalg.norm(q, axis=1), lambda q: (noise(q) - 0.9) / 7, k=0.02)(p)

    return surface_nets(field, 0.9, 72)


def drum(radius: float, half: float, edge: float) -> Field:
    """Upright cylinder with rounded edges."""

    def field(p: np.ndarray) -> np.ndarray:
        q = np.stack([np.hypot(p[:, 0], p[:, 1]) - radius + edge, np.abs(p[:, 2]) - half + edge])
        distance: np.ndarray = np.linalg.norm(np.maximum(q, 0), axis=0) + np.minimum(q.max(0), 0) - edge
        return distance

    return field


def tilt(axis: int, angle: float) -> np.ndarray:
    """Rotation by `angle` about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return matrix


SHAPES: dict[str, Callable[[], Mesh]] = {
    "horse": quadruped,
    "giraffe": lambda: quadruped(leg=0.62, body=0.28, girth=0.13, neck=0.75, head=0.09, tail=0.3),
    "pig": lambda: quadruped(leg=0.28, body=0.36, girth=0.27, neck=0.12, head=0.17, tail=0.15),
    "lizard": lambda: quadruped(leg=0.2, body=0.42, girth=0.12, neck=0.08, head=0.11, tail=0.7),
    "person": person,
    "runner": lambda: person(arm=(0.18, -0.3), stride=0.34, lean=0.06),
    "dancer": lambda: person(arm=(0.4, 0.38), stride=-0.2, lean=-0.03),
    "bird": bird,
    "fish": fish,
    "eel": lambda: fish(height=0.16, width=0.1),
    "octopus": octopus,
    "hand": hand,
    "head": head,
    "teddy": teddy,
    "mushroom": mushroom,
    "cactus": cactus,
    "tree": tree,
    "bush": lambda: tree(seed=11, levels=2),
    "vase": vase,
    "goblet": goblet,
    "bottle": bottle,
    "pawn": pawn,
    "queen": queen,
    "bell": bell,
    "bowl": bowl,
    "mug": mug,
    "teapot": teapot,
    "pear": pear,
    "apple": apple,
    "pumpkin": pumpkin,
    "banana": banana,
    "nautilus": nautilus,
    "snail": snail,
    "bone": bone,
    "starfish": starfish,
    "urchin": urchin,
    "blob_1": lambda: blob(1),
    "blob_2": lambda: blob(2, balls=14),
    "blob_3": lambda: blob(3, balls=6),
    "rock_1": lambda: rock(1),
    "rock_2": lambda: rock(2, low=3, high=9, amount=0.07, flat=0.95),
    "rock_3": lambda: rock(3, low=1, high=3, amount=0.25, flat=0.6),
    "walnut": wrinkled,
    "harmonic_1": lambda: harmonic(3, 2, 0.45),
    "harmonic_2": lambda: harmonic(6, 1, 0.3),
    "pillow": lambda: superquadric(4.0, 0.25),
    "caltrop": lambda: superquadric(0.8, 0.0),
    "trefoil": lambda: knot(2, 3),
    "cinquefoil": lambda: knot(2, 5, 0.1),
    "knot_3_4": lambda: knot(3, 4, 0.1, flat=0.7),
    "ribbon_knot": lambda: knot(2, 3, 0.17, flat=0.3, turns=1.5),
    "figure_eight": figure_eight,
    "moebius": lambda: ring(0.5, 0.22),
    "twisted_ring": lambda: ring(2.0, 0.5),
    "coil": coil,
    "chain": chain,
    "holes_3": lambda: holes(3),
    "holes_5": lambda: holes(5),
    "gyroid": gyroid,
    "lattice": lattice,
    "cloth": cloth,
    "coral": coral,
}
