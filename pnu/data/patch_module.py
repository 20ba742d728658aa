"""The data of a training: patches from procedural shapes, from a folder of meshes, or from a file."""

import functools
import hashlib
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Subset

from pnu.data import shapes
from pnu.data.augment import Augmentation, from_options
from pnu.data.patch_dataset import (
    Downsampling,
    EpochSampler,
    Options,
    PatchDataset,
    check_options,
    sample_generator,
    samples,
    split_shapes,
)
from pnu.data.patch_file import check_patch_file, cut_patch_file, told_open
from pnu.extras import needed
from pnu.io import Mesh, meshes_of, read_mesh
from pnu.runtime.progress import counted
from pnu.runtime.threads import processor_count

with needed("training"):
    import lightning.pytorch as pl


class EpochDataModule(pl.LightningDataModule):
    """What all data modules share: the order of samples, each process's share of them, and where a training goes on.

    `setup` makes `datasets`, by the names "train" (whose items are asked for by (epoch, index)), "val" and "test".

    Args:
        batch_size: samples of a training step, in each process.
        workers: processes that load; 0 loads in the training's own.
        seed: of the order.
    """

    kind = "samples"  # what a sample is called in messages
    evaluated_here = False  # validation and test are loaded in the training's own process, whatever `workers` is
    collate: Callable[[Any], Any] | None = None
    collate_evaluation: Callable[[Any], Any] | None = None

    def __init__(self, batch_size: int, workers: int, seed: int) -> None:
        super().__init__()
        if batch_size < 1 or workers < 0:
            raise ValueError(f"data: expected batch_size >= 1 and workers >= 0, found {batch_size} and {workers}")
        self.batch_size, self.workers, self.seed = batch_size, workers, seed
        self.evaluation_batch_size = batch_size
        self.resumed = 0, 1  # batches done, batches of an epoch
        self.datasets: dict[str, Dataset[Any]] = {}
        self.copies: torch.cuda.Stream | None = None

    @property
    def process(self) -> tuple[int, int]:
        """Number of this process and how many there are."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    @property
    def input_size(self) -> tuple[str, int] | None:
        """The key that sets the points of a training input, and how many they are; None where no key does."""
        return None

    def check_batch_size(self, samples: int, source: str) -> None:
        """ValueError where the training samples do not fill one batch of every process."""
        _, world = self.process
        if samples < self.batch_size * world:
            raise ValueError(
                f"data.batch_size={self.batch_size}: expected at most the {samples} training {self.kind} of {source}"
                + (f" divided by {world} processes" if world > 1 else "")
            )

    def train_dataloader(self) -> DataLoader[Any]:
        rank, world = self.process
        data = self.datasets["train"]
        sampler = EpochSampler(len(data), self.batch_size, seed=self.seed, rank=rank, world=world)  # type: ignore[arg-type]
        done, per_epoch = self.resumed
        sampler.start_at(done // per_epoch, done % per_epoch)
        return self.loader(data, self.batch_size, self.workers, sampler=sampler, collate_fn=self.collate)

    def val_dataloader(self) -> DataLoader[Any]:
        return self.evaluation_loader("val")

    def test_dataloader(self) -> DataLoader[Any]:
        return self.evaluation_loader("test")

    def evaluation_loader(self, part: str) -> DataLoader[Any]:
        """This process's share of the validation or the test, in order."""
        rank, world = self.process
        data = self.datasets[part]
        number: int = len(data)  # type: ignore[arg-type]
        if number >= world:  # of fewer every process takes all: the mean over all of them is the same
            data = Subset(data, range(rank, number, world))
        workers = 0 if self.evaluated_here else self.workers
        return self.loader(data, self.evaluation_batch_size, workers, collate_fn=self.collate_evaluation)

    def loader(self, data: Dataset[Any], batch_size: int, workers: int, **options: Any) -> DataLoader[Any]:
        """Batches of a dataset, by so many processes."""
        # spawned workers: a fork of a process with threads may hang
        return DataLoader(
            data, batch_size, num_workers=workers, multiprocessing_context="spawn" if workers else None,
            persistent_workers=workers > 0, **options,
        )  # fmt: skip

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """On a GPU beside what it still has to do: a copy waits for its own stream, and so would this process."""
        if device.type != "cuda":
            return super().transfer_batch_to_device(batch, device, dataloader_idx)
        if self.copies is None:
            self.copies = torch.cuda.Stream(device)
        now = torch.cuda.current_stream(device)
        with torch.cuda.stream(self.copies):
            moved = super().transfer_batch_to_device(batch, device, dataloader_idx)
        now.wait_stream(self.copies)
        for value in moved.values():
            if isinstance(value, Tensor):
                value.record_stream(now)  # its memory may be used again only after that
        return moved

    def state_dict(self) -> dict[str, Any]:
        """Batches, not steps: several may make one step."""
        assert self.trainer is not None
        progress: Any = self.trainer.fit_loop.epoch_loop.batch_progress.total
        return {"batches": progress.processed, "per_epoch": int(self.trainer.num_training_batches)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.resumed = int(state_dict["batches"]), max(1, int(state_dict["per_epoch"]))


class PatchDataModule(EpochDataModule):
    """Patches of a file: python -m pnu.train data=patches data.path=FILE.

    A batch holds "input" (B, input_points, 6) and "target" (B, target_points, 6), float32, in the unit sphere of each
    input; "index" (B,), "shape" (list of B names) and, where the file has them, "edges" (B, e, 3) with rows of NaN.
    Batches depend on the seed alone, not on the number of workers. Training goes on mid-epoch where a checkpoint was.

    Args:
        path: HDF5 file of patches, see data/README.md
        batch_size: patches of a training step, on each device
        workers: processes that load training patches; 0: the training's own; the data are the same with any number
        seed: of order, downsampling and augmentation
        input_points: points of an input patch
        target_points: points of a target patch; fewer than the file has take a smaller patch
        downsampling: nonuniform (paper), random (released, but without replacement), poisson (evenly) or given (file)
        evaluation: downsampling of validation and test; null: the training's
        strength: nonuniform: centers are exp(strength) times denser than the farthest points; 0: uniform
        centers: nonuniform: dense places of a patch
        augmentation: random changes of training samples; a part with range or sigma 0 is off; null: none at all
        on_device: downsample and augment whole batches where they are trained on; other random numbers than one by one
        val_share: share of the shapes kept for validation
        test_share: share of the shapes kept for the test
    """

    kind = "patches"
    evaluated_here = True  # a patch takes two milliseconds, starting processes takes seconds

    def __init__(
        self,
        path: str | None = None,
        *,
        batch_size: int = 20,
        workers: int = 0,
        seed: int = 0,
        input_points: int = 1024,
        target_points: int = 4096,
        downsampling: Downsampling = "nonuniform",
        evaluation: Downsampling | None = None,
        strength: float = 2.0,
        centers: int = 3,
        augmentation: Augmentation | Mapping[str, Any] | None = None,
        on_device: bool = False,
        val_share: float = 0.1,
        test_share: float = 0.1,
    ) -> None:
        super().__init__(batch_size, workers, seed)
        self.path = path
        self.options = Options(input_points, target_points, downsampling, strength, centers)
        self.evaluation = self.options._replace(downsampling=evaluation or downsampling)
        self.augmentation = from_options(augmentation)
        self.on_device = on_device
        self.shares = {"val": val_share, "test": test_share}
        self.rows: dict[str, list[int]] | None = None

    @property
    def input_size(self) -> tuple[str, int]:
        """Those of the input patches, which are drawn from the file's."""
        return "data.input_points", self.options.input_points

    def patch_file(self) -> Path:
        """The file of patches, made where it is not there yet."""
        if self.path is None:
            raise ValueError("data.path=FILE is required: an HDF5 file of patches, see data/README.md")
        return Path(self.path)

    def prepare_data(self) -> None:
        self.patch_file()

    def setup(self, stage: str | None = None) -> None:
        if self.rows is not None:
            return
        self.file = self.patch_file()
        check_options(self.file, self.options)
        check_options(self.file, self.evaluation)
        contents = check_patch_file(self.file)
        if contents.names is None:
            say(f"{self.file} has no shape names: validation and test are its last blocks of consecutive patches")
        self.names = contents.names
        self.rows = split_shapes(contents.names, contents.patches, **self.shares, seed=0)
        self.check_batch_size(len(self.rows["train"]), str(self.file))
        self.datasets = {part: self.dataset(part) for part in self.rows}

    def dataset(self, part: str) -> PatchDataset:
        """The samples of "train", "val" or "test"."""
        assert self.rows is not None
        augmentation = self.augmentation if part == "train" else None
        options = self.options if part == "train" else self.evaluation
        return PatchDataset(
            self.file, self.rows[part], options, seed=self.seed if part == "train" else 0,
            augmentation=augmentation, names=self.names, whole=self.on_device and part == "train",
        )  # fmt: skip

    def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
        """The samples of whole patches (`on_device`), by a generator from the seed, the epoch and their rows."""
        if "epoch" not in batch:
            return batch
        numbers = [self.seed, *batch.pop("epoch")[:1].tolist(), *batch["index"].tolist()]
        patches: dict[str, Tensor] = {name: batch[name] for name in ("target", "input", "edges") if name in batch}
        generator = sample_generator(*numbers, device=patches["target"].device)
        return batch | samples(patches, self.options, self.augmentation, generator)


class GeneratedDataModule(PatchDataModule):
    """Patches that are cut from meshes once and kept in a file, whose name holds a hash of all that it depends on.

    Args:
        patches: cut from all shapes together, for training, validation and test
        cache: folder of the files of patches that are cut
        shape_seed: of where patches are cut and of their points
        quiet: no progress bar while patches are cut
        options: as for `PatchDataModule`.
    """

    def __init__(
        self, *, patches: int = 4000, cache: str = "data", shape_seed: int = 0, quiet: bool = False, **options: Any
    ) -> None:
        super().__init__(**options)
        self.patches, self.cache, self.shape_seed, self.quiet = patches, Path(cache), shape_seed, quiet

    def makers(self) -> dict[str, Callable[[], Mesh]]:
        """Functions that make the meshes, by name."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Any]:
        """All that the patches depend on."""
        raise NotImplementedError

    def patch_file(self) -> Path:
        """The file of patches; its name says what they depend on, so that others are cut anew."""
        parameters = self.parameters() | {"patches": self.patches, "seed": self.shape_seed, "schema": 1}
        digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode()).hexdigest()[:12]
        path = self.cache / f"{parameters['source']}_{self.patches}_{digest}.h5"
        if not path.exists():
            makers = self.makers()
            processes = min(processor_count(), 8, 1 + len(makers) // 8)  # to start one takes as long as several shapes
            cut_patch_file(
                path, makers, self.patches, seed=self.shape_seed, parameters=parameters, processes=processes,
                progress=None if self.quiet else functools.partial(counted, description=f"cut patches into {path}"),
            )  # fmt: skip
            say_open(check_patch_file(path).open_edges or {})
        return path


def say(text: str) -> None:
    """A line on stderr."""
    print(text, file=sys.stderr)


def say_open(open_edges: Mapping[str, int]) -> None:
    """A line on meshes with open edges, by the numbers of these; none where all are closed."""
    if any(open_edges.values()):
        say(
            f"meshes with open edges (holes, or faces that turn the other way than their neighbors): "
            f"{told_open(open_edges)}; where faces are turned, so are the normals that are learnt"
        )


class SyntheticDataModule(GeneratedDataModule):
    """Patches of the procedural shapes that come with pnu: python -m pnu.train data=synthetic.

    Args:
        kinds: of procedural shapes: organic, cad
        options: as for `GeneratedDataModule` and `PatchDataModule`.
    """

    def __init__(self, *, kinds: Iterable[str] = ("organic", "cad"), **options: Any) -> None:
        super().__init__(**options)
        self.kinds = list(kinds)

    def makers(self) -> dict[str, Callable[[], Mesh]]:
        """Functions that make the procedural shapes, by name."""
        return {name: functools.partial(shapes.make, name) for name in shapes.names(*self.kinds)}

    def parameters(self) -> dict[str, Any]:
        """The shapes' names, and their version."""
        return {"source": "synthetic", "shapes": shapes.names(*self.kinds), "version": shapes.VERSION}


class MeshDataModule(GeneratedDataModule):
    """Patches of a folder of meshes (ply, off, obj, stl, glb, gltf, vtk, vtp): data=meshes data.root=FOLDER.

    Args:
        root: folder of meshes: ply, off, obj, stl, glb, gltf, vtk, vtp; its subfolders count too
        procedural: kinds of procedural shapes beside them: organic, cad
        options: as for `GeneratedDataModule` and `PatchDataModule`.
    """

    def __init__(self, root: str | None = None, procedural: Iterable[str] = (), **options: Any) -> None:
        super().__init__(**options)
        self.root, self.procedural = root, shapes.names(*procedural) if procedural else []

    @functools.cached_property
    def files(self) -> dict[str, Path]:
        """The files of the folder, by the names of their shapes."""
        if self.root is None:
            raise ValueError(
                "data.root=FOLDER is required: a folder of meshes (ply, off, obj, stl, glb, gltf, vtk, vtp)"
            )
        return meshes_of(self.root)

    def makers(self) -> dict[str, Callable[[], Mesh]]:
        """Functions that read the meshes, by name."""
        read = {name: functools.partial(read_mesh, path) for name, path in self.files.items()}
        return read | {
            f"{shapes.BESIDE_MESHES}{name}": functools.partial(shapes.make, name) for name in self.procedural
        }

    def parameters(self) -> dict[str, Any]:
        """The digests of the files."""
        hashes = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in self.files.items()}
        made = {"procedural": self.procedural, "version": shapes.VERSION} if self.procedural else {}
        return {"source": "meshes", "shapes": hashes} | made
