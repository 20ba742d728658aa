"""Train a network that finds stray points: `python -m pnu.training.outlier_training MESHES FILE.safetensors`.

On simulated scans, on clean and noisy clouds, and on those with points strewn around them, of the procedural shapes and
the meshes of a folder. With `--doubtful` the one that looks again at what the first one, as it ships, leaves doubtful;
with `--pictures` the one for what a single camera saw, on such scans alone. Minutes on one core; the same seed gives
the same weights.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from pnu.cleaning.outliers import DOUBTFUL, stray_odds
from pnu.data import shapes
from pnu.data.crops import Crops
from pnu.data.mesh_scene import MeshScene
from pnu.data.scanner import KINDS, DepthCamera, Scanner, any_scan, random_turn
from pnu.geometry.doubt_features import doubt_features
from pnu.geometry.outlier_features import outlier_features
from pnu.geometry.pixel_features import pixel_features
from pnu.geometry.point_tree import PointTree
from pnu.geometry.sphere_directions import sphere_directions
from pnu.io import Mesh, atomic_path, meshes_of, read_mesh
from pnu.networks.outlier_detector import OutlierDetector
from pnu.runtime.progress import counted

STRAY = 0.015  # distance from the surface, in radii, beyond which a point is one,
NOISES = 3.0  # if it is that many times what two thirds of the points stay below
ALONE = 8.0  # most that a good point counts for: by the area it stands for, as a hole is worst where points are few
FEWEST = 64  # points of a cloud that is learned from
EVERYWHERE = 1.2  # half the edge of a box with strays anywhere, in radii,
SHARES = (0.003, 0.15)  # of so many of the points
STRAYS, OTHERS = 512, 1536  # points of a step
STEPS, LONG = 4000, 12_000  # of a training, and of that for doubtful points,
DRAWS = 2  # which sees the clouds of so many seeds
PICTURES = 8  # of a mesh
ASTRAY = 0.05  # by which the camera's place is off, as it is where it has to be found


class Examples(NamedTuple):
    """Points to learn from."""

    features: Tensor  # (n, 52), of doubtful points (n, 138), of pictures (n, 34)
    stray: Tensor  # (n,) 0 or 1
    weight: Tensor  # (n,)


def clouds(mesh: Mesh, scanner: Scanner, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Clouds (n, 3) of a mesh, with strays and without."""
    for kind, scan in KINDS.items():
        if kind not in ("depth", "clutter"):  # steps are smoothed, and clutter taken out, before strays are looked for
            yield scan(scanner, rng).points
    for _ in range(3):
        yield any_scan(scanner, rng).points
    plain = Crops({"": mesh}, 1, normals="estimated")
    for strewn in ("", "beside", "everywhere"):
        _, noisy = plain.cloud(mesh, rng)
        points = noisy[:, :3]
        if strewn == "everywhere":
            count = int(len(points) * np.exp(rng.uniform(*np.log(SHARES))))
            points = np.vstack([points, rng.uniform(-EVERYWHERE, EVERYWHERE, (count, 3))])
        if strewn == "beside":
            count = int(rng.integers(1, max(2, len(points) // 20)))
            places = points[rng.integers(len(points), size=count)]
            clump = places + rng.uniform(0.05, 0.5) * rng.standard_normal(3) + 0.02 * rng.standard_normal((count, 3))
            cloudy = places + rng.uniform(0.03, 0.3) * rng.standard_normal((count, 3))
            points = np.vstack([points, clump[: rng.integers(0, 12)], cloudy])
        yield points


def examples_of(meshes: Sequence[Mesh], seed: int) -> Examples:
    """Labelled points of the clouds of meshes in the unit sphere."""

    def of_mesh(index: int, rng: np.random.Generator) -> Iterator[Labelled]:
        for points in clouds(meshes[index], Scanner(meshes[index]), rng):
            if len(points) >= FEWEST:
                features = torch.from_numpy(outlier_features(points))
                yield points, features, _areas(features), _all(points)

    return _labelled(meshes, seed, of_mesh)


def examples_of_doubt(meshes: Sequence[Mesh], seed: int) -> Examples:
    """Labelled points of the same clouds that the first network, as it ships, leaves doubtful."""

    def of_mesh(index: int, rng: np.random.Generator) -> Iterator[Labelled]:
        for points in clouds(meshes[index], Scanner(meshes[index]), rng):
            if len(points) < FEWEST:
                continue
            first = outlier_features(points)
            odds = stray_odds(first)
            doubtful = odds > DOUBTFUL
            if doubtful.any() and (~doubtful).sum() >= FEWEST:
                features = doubt_features(points[doubtful], points[~doubtful], odds[doubtful])
                yield points, torch.from_numpy(features), _areas(torch.from_numpy(first[doubtful])), doubtful

    return _labelled(meshes, seed, of_mesh)


def _areas(features: Tensor) -> Tensor:
    """By how much of the surface points with features (n, 52) stand for, (n,)."""
    return (2 * features[:, 4]).exp().clamp(1, ALONE)  # by the sixth neighbor's distance


def examples_of_pictures(meshes: Sequence[Mesh], seed: int) -> Examples:
    """Labelled points of what a camera sees of meshes in the unit sphere.

    Half of the pictures have a torn point beside the one that was meant, half in its place; some have wrong depths.
    Torn points that happen to lie on the surface count for nothing.
    """

    def of_mesh(index: int, rng: np.random.Generator) -> Iterator[Labelled]:
        scanner = Scanner(meshes[index])
        for _ in range(PICTURES):
            distance = rng.uniform(2.2, 4)
            side = int(np.exp(rng.uniform(np.log(45), np.log(140))))
            camera = DepthCamera(
                distance, 1.08 / np.sqrt(distance**2 - 1) * rng.uniform(0.7, 1.1), side, side,
                noise=np.exp(rng.uniform(np.log(0.0007), np.log(0.006))), slant=rng.uniform(0.05, 0.4),
                step=rng.uniform(0.001, 0.006) if rng.random() < 0.5 else 0.0, torn=rng.uniform(0, 0.4),
                in_place=bool(rng.random() < 0.5), false=rng.uniform(0, 0.01) if rng.random() < 0.3 else 0.0,
            )  # fmt: skip
            scan = scanner.views(distance * sphere_directions(3, random_turn(rng))[:1], camera, rng)
            if len(scan.points) >= FEWEST:
                place = scan.sensor[0] + ASTRAY * rng.standard_normal(3)
                apart = torch.from_numpy(PointTree(scan.points).among_themselves(7)[0][:, 5])
                area = (apart / apart.median()).square().clamp(1, ALONE)
                area[torch.from_numpy(scan.stray)] = 0
                yield scan.points, torch.from_numpy(pixel_features(scan.points, place)), area, _all(scan.points)

    return _labelled(meshes, seed, of_mesh)


Labelled = tuple[np.ndarray, Tensor, Tensor, np.ndarray]
"""Points (n, 3) of a cloud, features of m of them, for how much each counts (m,) if it is good, and which, (n,)."""


def _all(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), bool)


def _labelled(
    meshes: Sequence[Mesh], seed: int, of_mesh: Callable[[int, np.random.Generator], Iterator[Labelled]]
) -> Examples:
    """All points of the clouds of all meshes, stray where they lie off the surface."""
    truth = MeshScene(meshes)
    found: list[tuple[Tensor, ...]] = []
    for index in counted(range(len(meshes)), len(meshes), "scans"):
        for points, features, area, which in of_mesh(index, np.random.default_rng((seed, index))):
            there = torch.from_numpy(points)[None]
            distance = (there - truth.closest(there, torch.tensor([index]))[0])[0].norm(dim=1)
            stray = (distance > max(STRAY, NOISES * distance.quantile(0.68).item()))[torch.from_numpy(which)]
            found.append((features, stray.float(), torch.where(stray, 1.0, area).float()))
    return Examples(*(torch.cat(parts) for parts in zip(*found, strict=True)))


def train_detector(examples: Examples, *, steps: int = STEPS, lr: float = 4e-3, seed: int = 0) -> OutlierDetector:
    """A detector trained on examples, as many strays in each step as there are good points to three."""
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = OutlierDetector(examples.features.shape[1])
    network.mean.copy_(examples.features.mean(0))
    network.deviation.copy_(examples.features.std(0).clamp_min(1e-6))
    optimizer = torch.optim.AdamW(network.parameters(), lr, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=steps)
    groups = [(examples.stray == value).nonzero()[:, 0] for value in (1, 0)]
    for _ in counted(range(steps), steps, "training"):
        rows = torch.cat([
            group[torch.randint(len(group), (size,), generator=generator)]
            for group, size in zip(groups, (STRAYS, OTHERS), strict=True)
        ])  # fmt: skip
        odds = network(examples.features[rows])
        loss = binary_cross_entropy_with_logits(odds, examples.stray[rows], examples.weight[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network.eval()


def main() -> None:
    """The command line."""
    from safetensors.torch import save

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("meshes", type=Path, help="folder of closed meshes, beside the procedural shapes")
    parser.add_argument("output", type=Path, help="file of weights to write")
    parser.add_argument("--leave", nargs="*", default=[], help="names of meshes that are not trained on")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--doubtful", action="store_true", help="the network for what the first one leaves doubtful")
    kind.add_argument("--pictures", action="store_true", help="the network for what a single camera saw")
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn")
    arguments = parser.parse_args()
    meshes = {name: shapes.unit_mesh(read_mesh(path)) for name, path in meshes_of(arguments.meshes).items()}
    meshes |= {name: shapes.make(name) for name in shapes.names()}
    chosen = [mesh for name, mesh in meshes.items() if name not in arguments.leave]
    examples_for = (
        examples_of_pictures if arguments.pictures else examples_of_doubt if arguments.doubtful else examples_of
    )
    draws = DRAWS if arguments.doubtful else 1
    sets = [examples_for(chosen, arguments.seed + draw) for draw in range(draws)]
    examples = Examples(*(torch.cat(parts) for parts in zip(*sets, strict=True)))
    network = train_detector(examples, steps=LONG if arguments.doubtful else STEPS, seed=arguments.seed)
    with atomic_path(arguments.output) as temporary:
        temporary.write_bytes(save({name: value.contiguous() for name, value in network.state_dict().items()}))


if __name__ == "__main__":
    main()
