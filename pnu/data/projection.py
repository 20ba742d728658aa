"""Data module of the surface model: crops for training, whole clouds of other shapes for validation and test."""

from collections.abc import Iterator
from typing import Any

import lightning.pytorch as pl
from torch.utils.data import DataLoader, Sampler

from pnu.data import shapes
from pnu.data.crops import Crops, WholeClouds, flattened, stacked
from pnu.data.truth import Truth
from pnu.io import meshes_of, read_mesh


class ProjectionDataModule(pl.LightningDataModule):
    """Crops of clouds drawn from meshes.

    Args:
        root: folder of closed meshes, added to the procedural shapes; None: those alone.
        procedural: train on the procedural shapes.
        validation: names of the meshes kept for validation and test.
        normals: "given" or "estimated", see `Crops`.
        clouds: of an epoch, each drawn anew.
        size: points of a crop.
        views: crops of a cloud.
        batch_size: clouds of a batch.
        points: of a validation cloud.
        workers: processes that draw crops.
        seed: of all draws.
    """

    def __init__(
        self, root: str | None, procedural: bool, validation: list[str], normals: str, clouds: int, size: int,
        views: int, batch_size: int, points: int, workers: int, seed: int,
    ) -> None:  # fmt: skip
        super().__init__()
        self.root, self.procedural, self.held_out = root, procedural, list(validation)
        self.normals, self.clouds, self.size, self.views = normals, clouds, size, views
        self.batch_size, self.points, self.workers, self.seed = batch_size, points, workers, seed
        self.truth: Truth | None = None

    def setup(self, stage: str | None = None) -> None:
        if self.truth is not None:
            return
        files = meshes_of(self.root) if self.root else {}
        meshes = {name: shapes.unit(read_mesh(path)) for name, path in files.items()}
        if self.procedural:
            meshes |= {name: shapes.make(name) for name in shapes.names()}
        missing = [name for name in self.held_out if name not in meshes]
        if missing:
            raise ValueError(f"data.validation: found no mesh {missing[0]} in data.root={self.root}")
        held_out = {name: meshes.pop(name) for name in self.held_out}
        if not meshes:
            raise ValueError(f"data.root={self.root}: expected meshes to train on, found none but those of validation")
        self.truth = Truth(list(meshes.values()))
        self.train_set = Crops(
            meshes, self.clouds, size=self.size, views=self.views, normals=self.normals, seed=self.seed
        )
        self.val_set, self.test_set = (
            WholeClouds(held_out, self.points, normals=self.normals, seed=seed) for seed in (1, 2)
        )

    def train_dataloader(self) -> DataLoader[Any]:
        """Goes on where training stands: the position follows from the step."""
        assert self.truth is not None
        steps = max(1, self.clouds // self.batch_size)
        done = self.trainer.global_step if self.trainer else 0
        sampler = Order(steps * self.batch_size, *divmod(done, steps), self.batch_size)
        return DataLoader(
            self.train_set, self.batch_size, sampler=sampler, num_workers=self.workers, collate_fn=flattened
        )

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.val_set, collate_fn=stacked)

    def test_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.test_set, collate_fn=stacked)

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """Adds what the loss asks for the closest surface points; here, so that no worker process has to send it."""
        return {**batch, "surface": self.truth} if "center" in batch else batch


class Order(Sampler[tuple[int, int]]):
    """Keys (epoch, index) of the epochs from one on; the first begins after `step` batches."""

    def __init__(self, length: int, epoch: int, step: int, batch_size: int) -> None:
        self.length, self.epoch, self.start = length, epoch, step * batch_size

    def set_epoch(self, epoch: int) -> None:
        if epoch != self.epoch:
            self.epoch, self.start = epoch, 0

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[tuple[int, int]]:
        start, self.start = self.start, 0
        return iter([(self.epoch, index) for index in range(start, self.length)])
