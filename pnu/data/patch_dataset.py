"""Training samples cut from a patch file, and the order in which they come."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from pnu.data.augment import Augmentation
from pnu.data.patch_file import check_patch_file
from pnu.extras import needed
from pnu.geometry.neighbor_features import gather
from pnu.geometry.sampling import nonuniform_points, poisson_disk_points, random_points
from pnu.geometry.unit_sphere import unit_sphere_frame

with needed("files of patches"):
    import h5py

DATASETS = ("poisson_4096", "montecarlo_1024", "edges")
Downsampling = Literal["nonuniform", "random", "poisson", "given"]


class Options(NamedTuple):
    """How a sample is cut: `input_points` out of `target_points`.

    downsampling: "nonuniform" (the paper's: dense around `centers` random points, exp(strength) times denser there than
    farthest from them), "random" (without replacement), "poisson" (evenly spread), or "given" (the file's
    montecarlo_1024). target_points: fewer than the file's 4096 take the nearest to a random point of the patch.
    """

    input_points: int = 1024
    target_points: int = 4096
    downsampling: Downsampling = "nonuniform"
    strength: float = 2.0
    centers: int = 3


class PatchDataset(Dataset[dict[str, Any]]):
    """Samples from rows of a patch file, read one at a time: item (epoch, i) or i (epoch 0) is a dict with

    "input" (n, 6) and "target" (m, 6) float32, in the unit sphere of the input before augmentation; "index", the row in
    the file; "shape", its name; and "edges" (e, 3) where the file has them. All that is random comes from (seed, epoch,
    row) alone. Each process opens the file itself. `whole`: patches as they are, and their "epoch", for `samples`.
    """

    def __init__(
        self,
        path: str | Path,
        rows: Sequence[int],
        options: Options,
        *,
        seed: int,
        augmentation: Augmentation | None = None,
        names: Sequence[str] | None = None,
        whole: bool = False,
    ) -> None:
        self.whole = whole
        self.path, self.rows, self.options, self.seed = Path(path), list(rows), options, seed
        self.augmentation, self.names = augmentation, names
        self.opened: tuple[int, dict[str, h5py.Dataset]] | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"opened": None}

    def file(self) -> dict[str, h5py.Dataset]:
        """The file's datasets by name."""
        if self.opened is None or self.opened[0] != os.getpid():  # a handle shared across a fork reads wrong data
            file = h5py.File(self.path, "r")
            self.opened = os.getpid(), {name: file[name] for name in DATASETS if name in file}
        return self.opened[1]

    def read(self, name: str, row: int) -> Tensor:
        """A row of a dataset, (1, n, 3 or 6) float32; `ValueError` where the file is damaged there."""
        try:
            return torch.from_numpy(self.file()[name][row])[None].float()
        except (OSError, RuntimeError, KeyError):
            raise ValueError(f"{self.path}: patch {row} of {name} cannot be read; the file is damaged") from None

    def __getitem__(self, key: int | tuple[int, int]) -> dict[str, Any]:
        epoch, i = key if isinstance(key, tuple) else (0, key)
        row = self.rows[i]
        patch = {"target": self.read("poisson_4096", row)}
        if self.options.downsampling == "given":
            patch["input"] = self.read("montecarlo_1024", row)
        if "edges" in self.file():
            patch["edges"] = self.read("edges", row)
        if not self.whole:
            patch = samples(patch, self.options, self.augmentation, sample_generator(self.seed, epoch, row))
        sample: dict[str, Any] = {name: cloud[0] for name, cloud in patch.items()}
        sample |= {"index": row, "shape": self.names[row] if self.names else f"patch_{row}"}
        return sample | ({"epoch": epoch} if self.whole else {})


def samples(
    patches: Mapping[str, Tensor], options: Options, augmentation: Augmentation | None, generator: torch.Generator
) -> dict[str, Tensor]:
    """Training samples of whole patches: downsampled, in the unit sphere of the input, then augmented.

    Args:
        patches: "target" (B, n, 6); "input" (B, n', 3 or 6) where it is given; "edges" (B, e, 3) or none.
        options: how they are cut.
        augmentation: of training samples, or None.
        generator: of the patches' device.
    """
    target = patches["target"]
    if options.target_points < target.shape[1]:
        target = neighborhood(target, options.target_points, generator)
    clouds = {**patches, "input": downsampled(patches.get("input"), target, options, generator), "target": target}
    frame = unit_sphere_frame(clouds["input"])
    clouds = {name: frame.to_unit(cloud) for name, cloud in clouds.items()}
    return clouds if augmentation is None else augmentation(clouds, generator)


def downsampled(given: Tensor | None, target: Tensor, options: Options, generator: torch.Generator) -> Tensor:
    """Inputs (B, input_points, 3 or 6) of targets (B, n, 6), drawn from them or from what is given."""
    m, kind = options.input_points, options.downsampling
    if given is not None:
        return gather(given, random_points(given, m, generator=generator))
    points = target[..., :3]
    if kind == "nonuniform":
        idx = nonuniform_points(points, m, strength=options.strength, centers=options.centers, generator=generator)
    else:
        idx = (random_points if kind == "random" else poisson_disk_points)(points, m, generator=generator)
    return gather(target, idx)


def neighborhood(target: Tensor, m: int, generator: torch.Generator) -> Tensor:
    """The m points of each patch (B, n, 6) nearest to a random one of them: a smaller patch of the same density."""
    clouds, n, _ = target.shape
    chosen = torch.randint(n, (clouds, 1), generator=generator, device=generator.device)
    distance = (target[..., :3] - gather(target, chosen)[..., :3]).square().sum(-1)
    return gather(target, distance.topk(m, dim=1, largest=False).indices)


def sample_generator(*numbers: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator that depends on the numbers alone, such as seed, epoch and row."""
    state = np.random.SeedSequence(numbers).generate_state(2, np.uint32)
    return torch.Generator(device).manual_seed(int(state[0]) << 31 ^ int(state[1]))


class EpochSampler(Sampler[tuple[int, int]]):
    """Keys (epoch, i) of a dataset, in an order from (seed, epoch) alone; each process of several gets its share.

    Samples beyond the last whole global batch are left out of an epoch. `set_epoch` is called by Lightning;
    `start_at` makes the next pass begin at a batch of an epoch: that is how a training goes on where it stopped.
    """

    def __init__(self, length: int, batch_size: int, *, seed: int, rank: int = 0, world: int = 1) -> None:
        self.length, self.batch_size, self.seed, self.rank, self.world = length, batch_size, seed, rank, world
        self.epoch, self.start = 0, 0

    @property
    def batches(self) -> int:
        """Batches of one process in one epoch."""
        return self.length // (self.batch_size * self.world)

    def __len__(self) -> int:
        return self.batches * self.batch_size

    def set_epoch(self, epoch: int) -> None:
        """Go on with another epoch, from its begin."""
        if epoch != self.epoch:
            self.epoch, self.start = epoch, 0

    def start_at(self, epoch: int, batch: int) -> None:
        """Begin the next pass at a batch of an epoch."""
        self.epoch, self.start = epoch, batch * self.batch_size

    def __iter__(self) -> Iterator[tuple[int, int]]:
        generator = sample_generator(self.seed, self.epoch, 2**32)
        order = torch.randperm(self.length, generator=generator)[: len(self) * self.world]
        mine = order[self.rank :: self.world].tolist()
        start, self.start = self.start, 0
        return iter([(self.epoch, i) for i in mine[start:]])


def split_shapes(
    names: Sequence[str] | None, patches: int, *, val: float, test: float, seed: int
) -> dict[str, list[int]]:
    """Rows of a file for "train", "val" and "test": whole shapes in an order from the seed, never patches of one shape
    in two of them. Without names, blocks of consecutive rows at the end (neighbors in a file mostly share a shape).

    Raises:
        ValueError: no shapes are left to train on.
    """
    labels = list(names) if names else [str(row * 20 // patches) for row in range(patches)]
    unique = sorted(set(labels), key=str if names else int)
    order = unique
    if names:
        shuffled = np.random.default_rng(seed).permutation(len(unique))
        order = [unique[i] for i in shuffled]
    few = {
        part: max(1, round(share * len(order))) if share > 0 else 0 for part, share in (("val", val), ("test", test))
    }
    if sum(few.values()) >= len(order):
        raise ValueError(
            f"data: {len(order)} shapes cannot be split into training, {few['val']} for validation and {few['test']}"
            " for test; add shapes or lower data.val_share and data.test_share"
        )
    cut = len(order) - few["test"]
    part_of = dict.fromkeys(order[: cut - few["val"]], "train")
    part_of |= dict.fromkeys(order[cut - few["val"] : cut], "val") | dict.fromkeys(order[cut:], "test")
    rows: dict[str, list[int]] = {"train": [], "val": [], "test": []}
    for row, label in enumerate(labels):
        rows[part_of[label]].append(row)
    return rows


def check_options(path: str | Path, options: Options) -> None:
    """ValueError where a file cannot give such samples."""
    contents = check_patch_file(path)
    if options.downsampling not in get_args(Downsampling):
        raise ValueError(
            f"data.downsampling: expected {', '.join(get_args(Downsampling))}, found {options.downsampling!r}"
        )
    if not 64 <= options.input_points <= options.target_points <= contents.points:
        raise ValueError(
            f"data: expected 64 <= input_points <= target_points <= {contents.points}, found {options.input_points}"
            f" and {options.target_points}"
        )
    if options.downsampling == "given" and (not contents.has_input or options.target_points != contents.points):
        raise ValueError(
            f"data.downsampling=given: needs montecarlo_1024 in {path} and target_points={contents.points}"
        )
