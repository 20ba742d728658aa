"""Samples, their order, their split; the same with any number of workers and after a stop."""

import functools
import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from pnu.data import shapes
from pnu.data.patch_dataset import EpochSampler, Options, PatchDataset, split_shapes
from pnu.data.patch_file import cut_patch_file
from pnu.data.patch_module import MeshDataModule, PatchDataModule, SyntheticDataModule
from pnu.io import write_mesh

SMALL = {"input_points": 64, "target_points": 256, "batch_size": 2}
FOUR = ("washer", "dice", "nut", "cup")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "four.h5"
    cut_patch_file(path, {name: functools.partial(shapes.make, name) for name in FOUR}, 16)
    return path


def module(file: Path, **options: Any) -> PatchDataModule:
    data = PatchDataModule(str(file), **(SMALL | {"augmentation": {}, "val_share": 0.25, "test_share": 0.25} | options))
    data.setup()
    return data


def equal(one: list[dict[str, Any]], two: list[dict[str, Any]]) -> bool:
    return len(one) == len(two) and all(
        a["shape"] == b["shape"] and all(torch.equal(a[k], b[k]) for k in ("input", "target", "index"))
        for a, b in zip(one, two, strict=True)
    )


def test_batch(file: Path) -> None:
    batch = next(iter(module(file).train_dataloader()))
    assert batch["input"].shape == (2, 64, 6)
    assert batch["target"].shape == (2, 256, 6)
    assert batch["edges"].shape == (2, 256, 3)
    assert batch["input"].dtype == batch["target"].dtype == torch.float32
    torch.testing.assert_close(batch["target"][..., 3:].norm(dim=-1), torch.ones(2, 256))
    assert set(batch["shape"]) <= set(FOUR)


def test_input_lies_in_its_own_unit_sphere_and_is_part_of_the_target(file: Path) -> None:
    sample = PatchDataset(file, range(16), Options(256, 4096), seed=0)[3]
    points = sample["input"][:, :3]
    assert float(points.mean(0).abs().max()) < 1e-6
    assert float(points.norm(dim=-1).max()) == pytest.approx(1)
    distance = torch.cdist(points, sample["target"][:, :3], compute_mode="donot_use_mm_for_euclid_dist")
    assert float(distance.min(1).values.max()) == 0
    assert len(points.unique(dim=0)) == 256  # without replacement


def test_whole_batches_are_cut_where_they_are_trained_on(file: Path) -> None:
    """As samples are: input out of the target, in its unit sphere; by seed, epoch and rows alone, and each its own."""
    data = module(file, on_device=True, augmentation=None)

    def batch(epoch: int) -> dict[str, Any]:
        loader = data.train_dataloader()
        loader.sampler.set_epoch(epoch)
        found = next(iter(loader))
        assert found["target"].shape == (2, 4096, 6)
        return data.on_after_batch_transfer(found, 0)

    first = batch(0)
    assert (first["input"].shape, first["target"].shape) == ((2, 64, 6), (2, 256, 6))
    assert float(first["input"][..., :3].mean(1).abs().max()) < 1e-6
    torch.testing.assert_close(first["input"][..., :3].norm(dim=-1).amax(1), torch.ones(2))
    distance = torch.cdist(first["input"], first["target"], compute_mode="donot_use_mm_for_euclid_dist")
    assert float(distance.amin(2).max()) == 0
    again = batch(0)
    assert all(torch.equal(again[name], first[name]) for name in ("input", "target", "index"))
    assert not torch.equal(batch(1)["input"], first["input"])
    held_out = next(iter(data.val_dataloader()))
    assert torch.equal(data.on_after_batch_transfer(held_out, 0)["input"], held_out["input"])


def test_smaller_target_keeps_the_density(file: Path) -> None:
    with h5py.File(file) as opened:
        whole = torch.from_numpy(opened["poisson_4096"][3, :, :3])
    sample = PatchDataset(file, range(16), Options(64, 512), seed=0)[3]

    def spacing(points: torch.Tensor) -> torch.Tensor:
        distance = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        return distance.fill_diagonal_(torch.inf).min(1).values.median()

    # same points, another unit: compare through a pair of them
    points = sample["target"][:, :3]
    extent = float((points - points.mean(0)).norm(dim=-1).max())
    whole_extent = float((whole - whole.mean(0)).norm(dim=-1).max())
    relative = float(spacing(points)) / extent / (float(spacing(whole)) / whole_extent)
    assert 2 < relative < 4  # an eighth of the area: sqrt(8) times smaller


@pytest.mark.parametrize(("kind", "even"), [("nonuniform", False), ("random", True), ("poisson", True)])
def test_downsampling(file: Path, kind: str, even: bool) -> None:
    """Where the input is dense it is so around few places: the nearest tenth of the patch holds more than a tenth."""
    data = PatchDataset(file, range(16), Options(512, 4096, kind, strength=4, centers=1), seed=0)
    densest = []
    for i in range(8):
        sample = data[i]
        target, points = sample["target"][:, :3], sample["input"][:, :3]
        kwargs = {"compute_mode": "donot_use_mm_for_euclid_dist"}
        radius = torch.cdist(target[::64], target, **kwargs).kthvalue(410, dim=1).values
        densest.append(float((torch.cdist(target[::64], points, **kwargs) < radius[:, None]).sum(1).max()))
    assert (np.mean(densest) < 80) == even  # 51 were the same everywhere


def test_strength_is_logarithm_of_density(file: Path) -> None:
    flat = PatchDataset(file, range(16), Options(512, 4096, "nonuniform", strength=0), seed=0)[0]
    assert len(flat["input"]) == 512


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_same_batches_with_any_number_of_workers(file: Path, workers: int) -> None:
    alone = list(module(file).train_dataloader())
    assert len(alone) == 4
    assert equal(alone, list(module(file, workers=workers).train_dataloader()))


def test_epochs_and_seeds_differ(file: Path) -> None:
    data = module(file)
    loader = data.train_dataloader()
    first = list(loader)
    loader.sampler.set_epoch(1)
    second = list(loader)
    assert sorted(i for b in first for i in b["index"]) == sorted(i for b in second for i in b["index"])
    assert not equal(first, second)
    assert not equal(first, list(module(file, seed=1).train_dataloader()))
    assert equal(first, list(module(file).train_dataloader()))


@pytest.mark.slow
def test_validation_does_not_depend_on_seed_or_augmentation(file: Path) -> None:
    assert equal(
        list(module(file, seed=5).val_dataloader()), list(module(file, augmentation=None, workers=1).val_dataloader())
    )


@pytest.mark.parametrize("done", [1, 3, 4, 6])
def test_going_on_yields_exactly_the_rest(file: Path, done: int) -> None:
    loader = module(file).train_dataloader()
    whole = list(loader)
    loader.sampler.set_epoch(1)
    whole += list(loader)
    data = module(file)
    data.load_state_dict({"batches": done, "per_epoch": 4})
    rest = data.train_dataloader()
    epoch = done // 4
    rest.sampler.set_epoch(epoch)  # as Lightning does
    assert equal(list(rest), whole[done : 4 * (epoch + 1)])


def test_processes_share_an_epoch() -> None:
    keys = [list(EpochSampler(23, 2, seed=0, rank=rank, world=3)) for rank in range(3)]
    assert [len(k) for k in keys] == [6, 6, 6]
    assert len({key for part in keys for key in part}) == 18
    alone = list(EpochSampler(23, 6, seed=0))
    for batch in range(3):  # the global batch is the same set
        assert {k for part in keys for k in part[2 * batch : 2 * batch + 2]} == set(alone[6 * batch : 6 * batch + 6])


def test_split_by_shape() -> None:
    names = [f"s{i // 7}" for i in range(70)]
    rows = split_shapes(names, 70, val=0.2, test=0.1, seed=0)
    kinds = {part: {names[row] for row in rows[part]} for part in rows}
    assert [len(kinds[part]) for part in ("train", "val", "test")] == [7, 2, 1]
    assert not kinds["train"] & kinds["val"]
    assert not kinds["test"] & (kinds["train"] | kinds["val"])
    assert sum(map(len, rows.values())) == 70
    assert rows == split_shapes(names, 70, val=0.2, test=0.1, seed=0)


def test_split_without_names_takes_blocks() -> None:
    rows = split_shapes(None, 100, val=0.1, test=0.1, seed=0)
    assert rows["train"] == list(range(80))
    assert rows["test"] == list(range(90, 100))


def test_too_few_shapes() -> None:
    with pytest.raises(ValueError, match="2 shapes cannot be split into training, 1 for validation and 1 for test"):
        split_shapes(["a", "b"], 2, val=0.1, test=0.1, seed=0)


def test_no_handle_crosses_processes(file: Path) -> None:
    data = PatchDataset(file, range(16), Options(64, 256), seed=0)
    before = data[0]
    copy = pickle.loads(pickle.dumps(data))
    assert copy.opened is None
    assert torch.equal(copy[0]["input"], before["input"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"input_points": 512}, "expected 64 <= input_points <= target_points <= 4096, found 512 and 256"),
        ({"target_points": 9999}, "found 64 and 9999"),
        ({"downsampling": "best"}, "data.downsampling: expected nonuniform, random, poisson, given, found 'best'"),
        ({"downsampling": "given"}, "data.downsampling=given: needs montecarlo_1024"),
        ({"batch_size": 100}, "data.batch_size=100: expected at most the 8 training patches"),
        ({"batch_size": 0}, "expected batch_size >= 1"),
    ],
)
def test_bad_options(file: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        module(file, **options)


def test_given_input(file: Path, tmp_path: Path) -> None:
    with h5py.File(file) as old, h5py.File(tmp_path / "given.h5", "w") as new:
        new["poisson_4096"], new["name"] = old["poisson_4096"][()], old["name"][()]
        new["montecarlo_1024"] = old["poisson_4096"][:, 1024:2048]
    data = PatchDataset(tmp_path / "given.h5", range(16), Options(1024, 4096, "given"), seed=0)
    sample = data[0]
    expected = {tuple(p) for p in sample["target"][1024:2048].tolist()}
    assert {tuple(p) for p in sample["input"].tolist()} == expected


def test_generated_file_is_reused_and_never_mistaken(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    for name in FOUR[:3]:
        write_mesh(tmp_path / "meshes" / f"{name}.off", shapes.make(name))
    options = {"root": str(tmp_path / "meshes"), "patches": 3, "cache": str(tmp_path / "cache"), "quiet": True}
    first = MeshDataModule(**options, **SMALL).patch_file()
    stamp = first.stat().st_mtime_ns
    assert MeshDataModule(**options, **SMALL).patch_file() == first
    assert first.stat().st_mtime_ns == stamp
    write_mesh(tmp_path / "meshes" / "dice.off", shapes.make("nut"))
    assert MeshDataModule(**options, **SMALL).patch_file() != first
    mixed = MeshDataModule(**options, **SMALL, procedural=["cad"])
    assert set(mixed.makers()) == {*FOUR[:3], *(f"procedural/{name}" for name in shapes.names("cad"))}
    assert mixed.parameters() != MeshDataModule(**options, **SMALL).parameters()
    assert SyntheticDataModule(patches=9).parameters() != SyntheticDataModule(kinds=["cad"], patches=9).parameters()


def test_folder_without_meshes(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="data.root=FOLDER is required"):
        MeshDataModule().patch_file()
    with pytest.raises(ValueError, match="no such folder"):
        MeshDataModule(str(tmp_path / "none")).patch_file()
    with pytest.raises(ValueError, match="expected meshes .*, found none"):
        MeshDataModule(str(tmp_path)).patch_file()


def test_two_meshes_of_one_name(tmp_path: Path) -> None:
    for suffix in (".off", ".obj"):
        write_mesh(tmp_path / f"dice{suffix}", shapes.make("dice"))
    with pytest.raises(ValueError, match=r"dice.obj and .*dice.off are both named dice"):
        MeshDataModule(str(tmp_path)).patch_file()


def test_mesh_that_cannot_be_sampled_is_named(tmp_path: Path) -> None:
    (tmp_path / "flat.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n")
    with pytest.raises(ValueError, match="flat"):
        MeshDataModule(str(tmp_path), patches=1, cache=str(tmp_path), quiet=True).patch_file()


def test_state_counts_batches(file: Path) -> None:
    data = module(file)
    total = SimpleNamespace(processed=9)
    data.trainer = SimpleNamespace(  # type: ignore[assignment]
        fit_loop=SimpleNamespace(epoch_loop=SimpleNamespace(batch_progress=SimpleNamespace(total=total))),
        num_training_batches=4,
    )
    assert data.state_dict() == {"batches": 9, "per_epoch": 4}
