"""Training data of the surface model: crops of clouds drawn from meshes, clean or noisy, normals true or estimated."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from pnu.data.scanner import Scanner, any_scan
from pnu.geometry.anisotropy import averaged, thinned_lines
from pnu.geometry.cloud_normals import settled_normals
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.mesh_sampling import sample_area, sample_poisson_disk
from pnu.geometry.normal_estimation import estimate_normals, refit_normals
from pnu.io import Mesh
from pnu.runtime.progress import counted

LEAST, MOST = 600, 8000  # points of a cloud, evenly spread in the logarithm, for half of the clouds
USUAL = (1500, 6500)  # and for the other half
SMALLEST = 16  # points of a crop, or of a cloud for validation, from which surfaces can be told
TAKEN = 0.015  # distance from the surface up to which a point of a scan is taken for a measurement of it,
OVERLOOKED = 0.03  # and the share of the others that stay, as where they are removed by their looks
UNEVEN = 0.2  # share of the clouds
OFF = 0.15  # share of those with given normals in which these are a little off
HARD, WRONG = 1 / 3, 0.9  # share of the crops around points whose cosine with the true normal is below the second


class Drawn(NamedTuple):
    """A cloud of a mesh, with its true normals, and what an input has instead."""

    shape: int  # number of the mesh
    clean: np.ndarray  # (n, 6)
    noisy: np.ndarray  # (n, 6)
    rough: np.ndarray  # (n, 3) normals of the input


class Pool:
    """Clouds that are used again and again, in memory that processes share."""

    def __init__(self, clouds: Sequence[Drawn]) -> None:
        self.shapes = [cloud.shape for cloud in clouds]
        self.ends = np.cumsum([0, *(len(cloud.clean) for cloud in clouds)])
        rows = np.vstack([np.hstack([cloud.clean, cloud.noisy, cloud.rough]) for cloud in clouds])
        self.rows = torch.from_numpy(rows).share_memory_()

    def __getitem__(self, number: int) -> Drawn:
        rows = self.rows[self.ends[number] : self.ends[number + 1]].numpy()
        return Drawn(self.shapes[number], rows[:, :6], rows[:, 6:12], rows[:, 12:])


class Crops(Dataset[dict[str, Any]]):
    """`length` random clouds, each in `views` crops: the `size` points around one of its points, nearest first.

    A cloud has `least` to 8000 points, drawn at random, unevenly (20 %), or as blue noise (a share `blue`). With
    normals="given" they are true, in 15 % of the clouds a little off; with "estimated" they come from the cloud, with
    the true side; "mixed": given in a share `given` of the crops. A share `noisy` of the clouds has noise up to `noise`
    (Gaussian, standard deviation in units of the shape's radius). Inside and outside are swapped in 30 %. A share
    `scans` of the clouds are simulated scans (`pnu.data.scanner`), most strays removed and lines thinned out, as
    `pnu.upsample` does before the network sees them.

    The sides of estimated normals are the true ones, or with sides="found" those that `settled_normals` chooses, where
    a third of the crops is around points whose normals come out wrong. With a `pool` so many clouds are drawn and used
    again and again, which spares the time of their normals.

    An item is {"input": (views, size, 6) float32 around the "center" (views, 3), "target": the same points without
    noise, "side": (views,) 1 or -1 where swapped, "index": (views,) of the mesh, "shape": its name}, all from
    (seed, epoch, index).
    """

    def __init__(
        self, meshes: dict[str, Mesh], length: int, *, size: int = 384, views: int = 2, normals: str = "given",
        sides: str = "truth", scans: float = 0.0, blue: float = 0.15, least: int = LEAST, noise: float = 0.02,
        noisy: float = 0.5, given: float = 0.3, pool: int | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        if normals not in ("given", "estimated", "mixed"):
            raise ValueError(f"data.normals={normals}: expected given, estimated or mixed")
        if sides not in ("truth", "found") or (sides == "found" and normals != "estimated"):
            raise ValueError(f"data.sides={sides}: expected truth, or found with data.normals=estimated")
        if pool is not None and pool < 1:
            raise ValueError(f"data.pool={pool}: expected a number of clouds, or null")
        if not 0 <= scans <= 1:
            raise ValueError(f"data.scans={scans}: expected a share from 0 to 1")
        if not 0 <= blue <= 1 - UNEVEN:
            raise ValueError(f"data.blue={blue}: expected a share from 0 to {1 - UNEVEN}; {UNEVEN} are uneven")
        if not 0 <= noise <= 0.1:
            raise ValueError(f"data.noise={noise}: expected a standard deviation from 0 to 0.1 radii")
        if not 0 <= noisy <= 1:
            raise ValueError(f"data.noisy={noisy}: expected a share from 0 to 1")
        if not 0 <= given <= 1:
            raise ValueError(f"data.given={given}: expected a share from 0 to 1")
        if not SMALLEST <= least <= USUAL[0]:
            raise ValueError(f"data.least={least}: expected {SMALLEST} to {USUAL[0]} points")
        if not SMALLEST <= size <= least:
            raise ValueError(
                f"data.size={size}: expected {SMALLEST} to {least}, the points of the smallest clouds that are drawn"
            )
        if length < 1 or views < 1:
            raise ValueError(f"data: expected clouds >= 1 and views >= 1, found {length} and {views}")
        self.names, self.meshes = list(meshes), list(meshes.values())
        self.length, self.size, self.views, self.blue, self.least = length, size, views, blue, least
        self.noise, self.noisy, self.found_sides, self.pool = noise, noisy, sides == "found", pool
        self.drawn: dict[int, Drawn] | Pool = {}
        self.estimated, self.given = normals != "given", given if normals == "mixed" else 0.0
        self.scans, self.seed = scans, seed
        self.scanners = [Scanner(mesh) for mesh in self.meshes]

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, key: tuple[int, int]) -> dict[str, Any]:
        epoch, index = key
        rng = np.random.default_rng((self.seed, epoch, index))
        if self.pool is None:
            found = self.draw(rng)
        else:
            number = index % self.pool
            if isinstance(self.drawn, dict) and number not in self.drawn:
                self.drawn[number] = self.pooled(number)
            found = self.drawn[number]
        shape = found.shape
        views = [self.crop(found.clean, found.noisy, found.rough, rng) for _ in range(self.views)]
        return {
            **stacked_items(views),
            "index": torch.full((self.views,), shape),
            "shape": [self.names[shape]] * self.views,
        }

    def pooled(self, number: int) -> Drawn:
        """A cloud of the pool, drawn."""
        return self.draw(np.random.default_rng((self.seed, number)))

    def draw_pool(self, workers: int, *, quiet: bool = False) -> None:
        """Draw the clouds of the pool by so many processes, for all that draw crops from them: else each of these
        draws all that it uses. quiet: without a bar."""
        assert self.pool is not None
        # spawned workers: a fork of a process with threads may hang
        drawn = DataLoader(
            PooledClouds(self), batch_size=None, num_workers=workers, multiprocessing_context="spawn", collate_fn=as_is
        )
        self.drawn = Pool(list(drawn if quiet else counted(drawn, self.pool, "draw the pool of clouds")))

    def draw(self, rng: np.random.Generator) -> Drawn:
        """A cloud of one of the meshes."""
        shape = int(rng.integers(len(self.meshes)))
        if self.scans and rng.random() < self.scans:
            clean, noisy = self.scanned(self.scanners[shape], rng)
        else:
            clean, noisy = self.cloud(self.meshes[shape], rng)
        if not self.estimated:
            return Drawn(shape, clean, noisy, noisy[:, 3:])
        normals_of = found_normals if self.found_sides else rough_normals
        return Drawn(shape, clean, noisy, normals_of(noisy[:, :3], clean[:, 3:]))

    def crop(self, clean: np.ndarray, noisy: np.ndarray, rough: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
        """Input and target (size, 6) around a random point, with the normals of a random side.

        Those of the input are `rough` (n, 3), or true in some crops where they are mixed. Where their sides were found,
        the side of the crop is that of most of its inner points.
        """
        places = noisy[:, :3]
        if self.found_sides and rng.random() < HARD:
            wrong = (rough * clean[:, 3:]).sum(1) < WRONG
            places = places[wrong] if wrong.any() else places
        center = places[rng.integers(len(places))]
        distance = np.linalg.norm(noisy[:, :3] - center, axis=1)
        near = np.argpartition(distance, self.size - 1)[: self.size]
        near = near[np.argsort(distance[near])]
        true = self.given > 0 and rng.random() < self.given
        normals = noisy[near, 3:] if true else rough[near]
        side = -1.0 if rng.random() < 0.3 else 1.0
        if self.found_sides:
            inner = near[: self.size // 2]
            normals = normals * (1.0 if (rough[inner] * clean[inner, 3:]).sum() >= 0 else -1.0)
        crop = np.hstack([noisy[near, :3] - center, side * normals])
        target = np.hstack([clean[near, :3] - center, side * clean[near, 3:]])
        return {
            "input": torch.from_numpy(crop).float(), "target": torch.from_numpy(target).float(),
            "center": torch.from_numpy(center), "side": side,
        }  # fmt: skip

    def scanned(self, scanner: Scanner, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A simulated scan of enough points, (n, 6) with true normals: the surface points meant, and those measured."""
        while True:
            scan = any_scan(scanner, rng)
            seen = np.linalg.norm(scan.points - scan.clean[:, :3], axis=1) < TAKEN
            seen |= np.isfinite(scan.clean[:, 0]) & (rng.random(len(seen)) < OVERLOOKED)
            points, clean = scan.points[seen], scan.clean[seen]
            rows = thinned_lines(points)
            if rows is not None:
                points, clean = averaged(points, rows), clean[rows]
            if len(points) >= self.least:
                return clean, np.hstack([points, clean[:, 3:]])

    def cloud(self, mesh: Mesh, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A cloud (n, 6) with true normals, and the same with the noise of an input."""
        n = (
            round(np.exp(rng.uniform(np.log(self.least), np.log(MOST))))
            if rng.random() < 0.5
            else int(rng.integers(*USUAL))
        )
        kind = rng.random()
        if kind < 1 - UNEVEN - self.blue:
            clean = sample_area(mesh, n, rng)
        elif kind < 1 - UNEVEN:
            dense = sample_area(mesh, 4 * n, rng)
            clean = dense[farthest_points_large(dense[:, :3], n)]
        else:
            clean = uneven(sample_area(mesh, 4 * n, rng), n, rng)
        noisy = clean.copy()
        if rng.random() < self.noisy:
            sigma = rng.uniform(0, rng.choice([0.3, 1]) * self.noise)
            noisy[:, :3] += sigma * rng.standard_normal((n, 3))
        if (self.given or not self.estimated) and rng.random() < OFF:
            noisy[:, 3:] += rng.uniform(0, 0.15) * rng.standard_normal((n, 3))
            noisy[:, 3:] /= np.linalg.norm(noisy[:, 3:], axis=1, keepdims=True)
        return clean, noisy


class PooledClouds(Dataset[Drawn]):
    """Those of a pool, drawn one after the other."""

    def __init__(self, crops: Crops) -> None:
        self.crops = crops

    def __len__(self) -> int:
        return self.crops.pool or 0

    def __getitem__(self, number: int) -> Drawn:
        return self.crops.pooled(number)


def as_is(cloud: Any) -> Any:
    """Arrays instead of tensors."""
    return cloud


def rough_normals(points: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Normals as `estimate_normals` finds them from points (n, 3), had it known the sides: those of `true` (n, 3)."""
    planes = estimate_normals(points, orient=False)
    planes = np.where((planes * true).sum(1, keepdims=True) < 0, -planes, planes)
    return refit_normals(points, planes)


def found_normals(points: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Normals as `settled_normals` finds them at work, outside and inside swapped where most are those of `true`."""
    found = settled_normals(points, None).normals
    return found if (found * true).sum() >= 0 else -found


def uneven(cloud: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """n points of a cloud, dense around one to four of them."""
    centers = cloud[rng.integers(len(cloud), size=rng.integers(1, 5)), :3]
    distance = np.linalg.norm(cloud[:, None, :3] - centers, axis=2).min(1)
    weight = np.exp(-rng.uniform(0.5, 2.5) * distance) + 0.05
    return cloud[rng.choice(len(cloud), n, replace=False, p=weight / weight.sum())]


class WholeClouds(Dataset[dict[str, Any]]):
    """Validation: for each mesh an input cloud of n points and a target of 4 n blue noise points, always the same."""

    def __init__(self, meshes: dict[str, Mesh], n: int, *, normals: str, sides: str = "truth", seed: int) -> None:
        self.items = []
        for index, (name, mesh) in enumerate(meshes.items()):
            rng = np.random.default_rng((seed, index))
            cloud = sample_area(mesh, n, rng)
            if normals != "given":
                normals_of = found_normals if sides == "found" else rough_normals
                cloud[:, 3:] = normals_of(cloud[:, :3], cloud[:, 3:])
            target = sample_poisson_disk(mesh, 4 * n, rng)
            arrays = {"input": cloud, "target": target}
            item = {key: torch.from_numpy(value).float() for key, value in arrays.items()}
            self.items.append({**item, "index": index, "shape": name})

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.items[index]


def stacked_items(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A batch of items of one size: tensors and numbers stacked, text as a list."""
    batch: dict[str, Any] = {name: [item[name] for item in items] for name in items[0]}
    for name, values in batch.items():
        if isinstance(values[0], Tensor):
            batch[name] = torch.stack(values)
        elif isinstance(values[0], int | float):
            batch[name] = torch.tensor(values)
    return batch


def flattened(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A batch of the views of all items."""
    return {
        name: value.flatten(0, 1) if isinstance(value, Tensor) else [text for texts in value for text in texts]
        for name, value in stacked_items(items).items()
    }
