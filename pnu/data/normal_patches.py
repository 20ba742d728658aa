"""Training data of normals as a task: neighborhoods of points of clouds of PCPNet's kinds, with their true normals."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from pnu.data import shapes
from pnu.data.patch_module import EpochDataModule
from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.mesh_sampling import sample_area
from pnu.io import Mesh, meshes_of, read_mesh

NORMAL_KINDS = ("clean", "noise_0.12", "noise_0.6", "noise_1.2", "striped", "gradient")
"""Of PCPNet: random by area; with Gaussian noise of so many percent of the box's diagonal in each coordinate, normals
those of the clean places; in stripes of which every other one is nearly empty; thinner and thinner along an axis."""

CANDIDATES, THIN, STRIPES = 6, 0.05, 12  # points drawn for each one kept; density of the thinnest; stripes in all


def draw_cloud(mesh: Mesh, kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """n points of a surface with its normals, (n, 6), of one of `NORMAL_KINDS`."""
    if kind in ("striped", "gradient"):
        cloud = sample_area(mesh, CANDIDATES * n, rng)
        along = cloud[:, np.ptp(cloud[:, :3], axis=0).argmax()]
        place = (along - along.min()) / max(np.ptp(along), 1e-300)
        share = np.where(np.floor(STRIPES * place) % 2 == 0, 1.0, THIN) if kind == "striped" else THIN ** (place)
        drawn: np.ndarray = cloud[rng.choice(len(cloud), n, replace=False, p=share / share.sum())]
        return drawn
    cloud = sample_area(mesh, n, rng)
    if kind.startswith("noise_"):
        diagonal = np.linalg.norm(np.ptp(cloud[:, :3], axis=0))
        cloud[:, :3] += rng.normal(scale=float(kind.removeprefix("noise_")) / 100 * diagonal, size=(n, 3))
    return cloud


class NormalPatches(Dataset[dict[str, Any]]):
    """`length` clouds, each drawn anew, with the neighborhoods of `queries` of their points.

    A cloud is turned at random. An item is {"input": (queries, neighbors, 3) float32, nearest first, the point itself
    the very first; "target": (queries, 6), the points and their true normals; "index" and "shape"}, all from
    (seed, epoch, index).
    """

    def __init__(
        self, meshes: Mapping[str, Mesh], length: int, *, kinds: Sequence[str], points: int, queries: int,
        neighbors: int, seed: int,
    ) -> None:  # fmt: skip
        self.names, self.meshes, self.length, self.kinds = list(meshes), list(meshes.values()), length, tuple(kinds)
        self.points, self.queries, self.neighbors, self.seed = points, queries, neighbors, seed

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, key: int | tuple[int, int]) -> dict[str, Any]:
        epoch, index = key if isinstance(key, tuple) else (0, key)
        rng = np.random.default_rng((self.seed, epoch, index))
        shape = int(rng.integers(len(self.meshes)))
        cloud = draw_cloud(self.meshes[shape], self.kinds[int(rng.integers(len(self.kinds)))], self.points, rng)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        cloud = np.hstack([cloud[:, :3] @ turn, cloud[:, 3:] @ turn])
        chosen = rng.choice(self.points, self.queries, replace=False)
        near = kd_tree(cloud[:, :3]).query(cloud[chosen, :3], k=self.neighbors)[1]
        return {
            "input": torch.from_numpy(cloud[near, :3]).float(),
            "target": torch.from_numpy(cloud[chosen]).float(),
            "index": shape,
            "shape": self.names[shape],
        }


class NormalDataModule(EpochDataModule):
    """Neighborhoods of points of clouds that are drawn from meshes.

    Args:
        root: folder of meshes, beside the procedural shapes; null: those alone
        validation: names of the shapes kept for validation and test
        kinds: of clouds: clean, noise_0.12, noise_0.6, noise_1.2, striped, gradient
        clouds: of an epoch, each drawn anew
        points: of a cloud
        queries: points of a cloud whose normals are learned
        neighbors: points of a neighborhood, at least the largest of model.neighbors
        batch_size: clouds of a batch, on each device
        workers: processes that draw; 0: the training's own
        seed: of all draws
    """

    kind = "clouds"

    def __init__(
        self, root: str | None = None, validation: Iterable[str] = ("mug", "head", "queen"),
        kinds: Sequence[str] = NORMAL_KINDS, clouds: int = 2000, points: int = 5000, queries: int = 32,
        neighbors: int = 128, batch_size: int = 8, workers: int = 0, seed: int = 0,
    ) -> None:  # fmt: skip
        super().__init__(batch_size, workers, seed)
        if unknown := [kind for kind in kinds if kind not in NORMAL_KINDS] or not kinds:
            raise ValueError(f"data.kinds={unknown}: expected some of {', '.join(NORMAL_KINDS)}")
        if not 2 <= queries <= points or not 2 <= neighbors <= points:
            raise ValueError(f"data: expected 2 to points={points} queries and neighbors, found {queries}, {neighbors}")
        self.evaluation_batch_size = 1
        self.root, self.held_out, self.kinds, self.clouds = root, list(validation), tuple(kinds), clouds
        self.points, self.queries, self.neighbors = points, queries, neighbors

    @property
    def input_size(self) -> tuple[str, int]:
        """Those of a neighborhood."""
        return "data.neighbors", self.neighbors

    def setup(self, stage: str | None = None) -> None:
        if self.datasets:
            return
        files = meshes_of(self.root) if self.root else {}
        meshes = {name: shapes.unit_mesh(read_mesh(path)) for name, path in files.items()}
        meshes |= {name: shapes.make(name) for name in shapes.names()}
        missing = [name for name in self.held_out if name not in meshes]
        if missing or not self.held_out:
            raise ValueError(f"data.validation={self.held_out}: expected names of shapes, found no {missing[:1]}")
        held_out = {name: meshes.pop(name) for name in self.held_out}
        self.check_batch_size(self.clouds, f"data.clouds={self.clouds}")
        options: dict[str, Any] = {"kinds": self.kinds, "points": self.points, "neighbors": self.neighbors}
        self.datasets = {
            "train": NormalPatches(meshes, self.clouds, queries=self.queries, seed=self.seed, **options),
            **{
                part: NormalPatches(held_out, 2 * len(self.kinds), queries=min(256, self.points), seed=seed, **options)
                for part, seed in (("val", 1), ("test", 2))
            },
        }
