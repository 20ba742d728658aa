"""Training data of the surface model: crops, true surfaces, order, and one training step."""

import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from pnu.commands.train import main as train
from pnu.data import shapes
from pnu.data.crop_module import ProjectionDataModule
from pnu.data.crops import WRONG, Crops, Pool, WholeClouds, flattened
from pnu.data.mesh_scene import MeshScene
from pnu.data.patch_module import PatchDataModule
from pnu.geometry.cloud_normals import settled_normals
from pnu.geometry.mesh_sampling import closest_points, face_normals, sample_area
from pnu.io import Mesh, read_json, write_mesh
from pnu.losses.projection import SurfaceLoss
from pnu.networks.pnu import PNU
from pnu.networks.surface import Surface
from pnu.training.lightning_module import TRAINER_OPTIONS, check_input, quieten
from tests.refusals import refused

NAMES = sorted(shapes.names())[:2] + sorted(shapes.names("cad"))[-1:]


@pytest.fixture(scope="module")
def meshes() -> dict[str, Mesh]:
    return {name: shapes.make(name) for name in NAMES}


@pytest.mark.slow
def test_truth_agrees_with_exact_closest_points(meshes: dict[str, Mesh]) -> None:
    truth, rng = MeshScene(list(meshes.values())), np.random.default_rng(0)
    order = [list(meshes)[i] for i in (2, 0, 1)]
    queries = np.stack([sample_area(meshes[name], 200, rng)[:, :3] for name in order])
    queries += 0.01 * rng.standard_normal(queries.shape)
    points, normals = truth.closest(torch.from_numpy(queries), torch.tensor([2, 0, 1]))
    for row, name in enumerate(order):
        exact, distance, face = closest_points(meshes[name], queries[row])
        off = np.linalg.norm(points[row].numpy() - queries[row], axis=1) - distance
        assert np.median(abs(off)) < 1e-6
        assert abs(off).max() < 5e-4  # single precision, long triangles
        same = np.linalg.norm(points[row].numpy() - exact, axis=1) < 5e-4
        agree = (normals[row].numpy() * face_normals(meshes[name])[face]).sum(1) > 0.99
        assert same.mean() > 0.98
        assert agree.mean() > 0.9  # the others lie on edges, where either face may be named


def test_truth_can_be_sent_to_another_process(meshes: dict[str, Mesh]) -> None:
    truth = MeshScene(list(meshes.values()))
    query, index = torch.full((1, 1, 3), 0.9, dtype=torch.float64), torch.tensor([1])
    expected = truth.closest(query, index)
    for ours, theirs in zip(expected, pickle.loads(pickle.dumps(truth)).closest(query, index), strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("normals", ["given", "estimated"])
def test_crops_repeat_and_lie_near_their_surface(meshes: dict[str, Mesh], normals: str) -> None:
    crops = Crops(meshes, 8, size=200, views=2, normals=normals, seed=3)
    again = Crops(meshes, 8, size=200, views=2, normals=normals, seed=3)
    truth = MeshScene(list(meshes.values()))
    for index in range(4):
        item, same, other = crops[0, index], again[0, index], crops[1, index]
        assert item["input"].shape == (2, 200, 6)
        assert torch.equal(item["input"], same["input"])
        assert not torch.equal(item["input"], other["input"])
        distance = item["input"][..., :3].norm(dim=-1)
        assert (distance.diff(dim=1) >= -1e-6).all()
        place = item["target"][..., :3].double() + item["center"][:, None]
        closest, direction = truth.closest(place, item["index"])
        torch.testing.assert_close(closest, place, atol=5e-4, rtol=0)  # single precision, long triangles
        facing = (item["target"][..., 3:] * direction).sum(-1) * item["side"][:, None]
        assert facing.median() > 0.999
        # rough normals keep the side of the true ones
        assert ((item["input"][..., 3:] * item["target"][..., 3:]).sum(-1) > 0).float().mean() > 0.97


def test_some_crops_are_noisy_and_some_are_turned_inside_out(meshes: dict[str, Mesh]) -> None:
    items = [Crops(meshes, 60, size=64, views=1, noisy=0.2)[0, index] for index in range(60)]
    moved = [float((i["input"] - i["target"])[..., :3].abs().max()) for i in items]
    assert 0 < sum(m > 1e-6 for m in moved) < 30
    assert 0 < sum(bool((i["side"] < 0).any()) for i in items) < 40


def test_noise_is_as_large_and_as_frequent_as_asked(meshes: dict[str, Mesh]) -> None:
    """With given normals as with estimated ones."""
    for normals in ("given", "mixed"):
        quiet = Crops(meshes, 6, size=64, views=1, normals=normals, noisy=0)
        loud = Crops(meshes, 6, size=64, views=1, normals=normals, noisy=1, noise=0.05)
        for index in range(6):
            still, moved = ((item["input"] - item["target"])[..., :3] for item in (quiet[0, index], loud[0, index]))
            assert abs(still).max() == 0
            assert 0 < moved.std() < 0.06


def test_mixed_normals_are_given_in_the_share_asked(meshes: dict[str, Mesh]) -> None:
    def wrong(given: float) -> list[float]:
        crops = Crops(meshes, 8, size=64, views=2, normals="mixed", given=given, noisy=1, noise=0.05)
        items = [crops[0, index] for index in range(8)]
        return [float(abs(i["input"] - i["target"])[..., 3:].mean(2).max()) for i in items]

    assert np.median(wrong(1.0)) < 1e-6  # a few are a little off
    assert np.median(wrong(0.0)) > 0.1


def test_clouds_of_a_pool_are_used_again_in_other_crops(meshes: dict[str, Mesh]) -> None:
    crops = Crops(meshes, 8, size=64, views=1, pool=2, seed=3)
    first, again, other = crops[0, 0], crops[0, 2], crops[0, 1]
    assert torch.equal(first["index"], again["index"])
    assert not torch.equal(first["center"], again["center"])
    assert set(crops.drawn) == {0, 1}
    cloud = crops.drawn[0].noisy[:, :3]
    for item in (first, again):
        assert (np.abs(cloud - item["center"].numpy()).sum(1) == 0).any()
    assert not (np.abs(cloud - other["center"].numpy()).sum(1) == 0).any()
    assert torch.equal(Crops(meshes, 8, size=64, views=1, pool=2, seed=3)[0, 2]["input"], again["input"])


@pytest.mark.slow
def test_processes_draw_a_pool_once_for_all(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same crops as in one process; the clouds lie in memory that is shared, not sent."""
    options = {"clouds": 4, "pool": 3, "normals": "estimated"}
    alone, silent, loaded = (data_module(folder, workers=w, quiet=q, **options) for w, q in ((0, 0), (2, 1), (2, 0)))
    for data, shown in ((alone, False), (silent, False), (loaded, True)):
        data.setup()
        assert ("draw the pool of clouds" in capsys.readouterr().err) == shown
    pool = loaded.datasets["train"].drawn  # type: ignore[attr-defined]
    assert isinstance(pool, Pool)
    assert pool.rows.is_shared()
    assert alone.datasets["train"].drawn == {}  # type: ignore[attr-defined]
    assert all(map(torch.equal, inputs(alone), inputs(loaded)))


def test_sides_that_are_found_are_those_at_work_and_mostly_true(meshes: dict[str, Mesh]) -> None:
    crops = Crops(meshes, 6, size=200, views=4, normals="estimated", sides="found", least=300, pool=3)
    hard = []
    for index in range(6):
        item = crops[0, index]
        agree = (item["input"][..., 3:] * item["target"][..., 3:]).sum(-1)
        assert (agree[:, :100].sum(1) > 0).all()  # each crop has the side of most of its inner points
        hard += agree[:, 0].tolist()
    cloud = crops.drawn[0]
    at_work = settled_normals(cloud.noisy[:, :3], None).normals
    np.testing.assert_array_equal(cloud.rough, at_work * np.sign((cloud.rough * at_work).sum()))
    assert np.mean(np.array(hard) < WRONG) > 0.2  # a third begins where they are wrong


def test_unknown_kind_of_normals_is_refused(meshes: dict[str, Mesh]) -> None:
    with pytest.raises(ValueError, match=r"data\.normals=guessed: expected given, estimated or mixed"):
        Crops(meshes, 1, normals="guessed")
    with pytest.raises(ValueError, match=r"data\.sides=found: expected truth, or found with data\.normals=estimated"):
        Crops(meshes, 1, sides="found")
    with pytest.raises(ValueError, match=r"data\.pool=0: expected a number of clouds"):
        Crops(meshes, 1, pool=0)


def test_validation_clouds_do_not_change(meshes: dict[str, Mesh]) -> None:
    first, second = (WholeClouds(meshes, 100, normals="estimated", seed=1) for _ in range(2))
    assert first[1]["target"].shape == (400, 6)
    assert torch.equal(first[1]["input"], second[1]["input"])


def test_loss_is_zero_on_the_surface_and_grows_off_it(meshes: dict[str, Mesh]) -> None:
    truth = MeshScene(list(meshes.values()))
    batch = flattened([Crops(meshes, 4, size=80, views=2)[0, i] for i in range(4)])
    extra = {**batch, "surface": truth}
    loss = SurfaceLoss()
    place, normals = loss.closest(batch["target"], extra)
    exact = torch.cat([place, normals], -1)[None]
    spacing = torch.full(exact.shape[:3], 0.05)
    extra |= {"query": exact, "log_error": torch.zeros(exact.shape[:3]), "spacing": spacing}
    good = loss(exact[-1], batch["target"], {**extra, "projected": exact})
    off = exact.clone()
    off[..., :3] += 0.01 * off[..., 3:]
    bad = loss(off[-1], batch["target"], {**extra, "projected": off})
    assert good["distance"] < 1e-3
    assert good["normal"] < 0.05
    assert 0.1 < bad["distance"] < 0.21  # 0.01 at spacing 0.05, less where another wall is nearer
    flipped = torch.cat([exact[..., :3], -exact[..., 3:]], -1)
    assert loss(flipped[-1], batch["target"], {**extra, "projected": flipped})["normal"] > 1.9


@pytest.fixture(scope="module")
def folder(meshes: dict[str, Mesh], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("meshes")
    for name, mesh in meshes.items():
        write_mesh(path / f"{name}.ply", mesh)
    return path


def data_module(folder: Path, **options: Any) -> ProjectionDataModule:
    small = {"clouds": 16, "size": 64, "views": 1, "batch_size": 2, "points": 64, "workers": 0, "seed": 0}
    return ProjectionDataModule(
        **({"root": str(folder), "procedural": False, "validation": NAMES[:2], "normals": "given"} | small | options)
    )


def inputs(data: ProjectionDataModule) -> list[torch.Tensor]:
    return [batch["input"] for batch in data.train_dataloader()]


def test_processes_draw_different_clouds(folder: Path) -> None:
    """Together those of one process with the whole batch; of the validation clouds each process gets its own."""
    parts, shapes_of = [], []
    for rank in (0, 1):
        data = data_module(folder)
        data.trainer = SimpleNamespace(global_rank=rank, world_size=2)  # type: ignore[assignment]
        data.setup()
        parts.append(inputs(data))
        shapes_of.append([name for batch in data.val_dataloader() for name in batch["shape"]])
    alone = data_module(folder, batch_size=4)
    alone.setup()
    whole = inputs(alone)
    assert len(parts[0]) == len(parts[1]) == len(whole) == 4
    for ours, theirs, both in zip(*parts, whole, strict=True):
        assert torch.equal(torch.stack([ours, theirs], 1).flatten(0, 1), both)
    assert not any(torch.equal(a, b) for a in torch.cat(parts[0]) for b in torch.cat(parts[1]))
    assert sorted(shapes_of) == sorted([[name] for name in NAMES[:2]])


@pytest.mark.slow
def test_same_clouds_with_a_worker(folder: Path) -> None:
    """Started anew, not forked, as for patches."""
    alone, loaded = (data_module(folder, workers=workers, clouds=4) for workers in (0, 1))
    for data in (alone, loaded):
        data.setup()
    assert all(map(torch.equal, inputs(alone), inputs(loaded)))


def test_open_meshes_are_counted(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data_module(folder).setup()
    assert capsys.readouterr().err == ""
    for path in folder.iterdir():
        shutil.copy(path, tmp_path)
    mesh = shapes.make("dice")
    write_mesh(tmp_path / "hole.ply", Mesh(mesh.vertices, mesh.faces[1:]))
    data_module(tmp_path).setup()
    assert "1 of 4: hole (3)" in capsys.readouterr().err


def test_a_process_without_validation_clouds_takes_them_all(folder: Path) -> None:
    data = data_module(folder, validation=NAMES[:1])
    data.trainer = SimpleNamespace(global_rank=1, world_size=2)  # type: ignore[assignment]
    data.setup()
    assert len(data.val_dataloader()) == 1


class Recorder(pl.LightningModule):
    """Keeps what it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen: list[torch.Tensor] = []

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> torch.Tensor:
        self.seen.append(batch["input"])
        return self.weight * 0

    def validation_step(self, *_: Any) -> None:
        pass

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.SGD(self.parameters(), lr=0.1)
        # knows the number of steps: Lightning asks for the data before it has restored its own position
        steps = int(self.trainer.estimated_stepping_batches)
        return [optimizer], [torch.optim.lr_scheduler.LinearLR(optimizer, total_iters=steps)]


class Stop(pl.Callback):
    """Keeps a checkpoint after a step."""

    def __init__(self, path: Path, step: int) -> None:
        self.path, self.step = path, step

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if trainer.global_step == self.step and not self.path.exists():
            trainer.save_checkpoint(self.path)


@pytest.mark.parametrize("stop", [1, 4, 5])
def test_a_training_with_accumulated_gradients_goes_on_with_the_rest(stop: int, folder: Path, tmp_path: Path) -> None:
    """Eight batches an epoch, two to a step: after `stop` steps come the batches from 2 stop on."""
    quieten()

    def seen(start: Path | None = None) -> list[torch.Tensor]:
        module = Recorder()
        trainer = pl.Trainer(
            max_steps=6, max_epochs=2, accumulate_grad_batches=2, logger=False, accelerator="cpu",
            callbacks=[Stop(tmp_path / "stop.ckpt", stop)], limit_val_batches=0, default_root_dir=tmp_path,
            **TRAINER_OPTIONS,
        )  # fmt: skip
        trainer.fit(module, data_module(folder), ckpt_path=start, weights_only=True)
        return module.seen

    whole = seen()
    assert len(whole) == 12
    assert not torch.equal(whole[0], whole[8])
    rest = seen(tmp_path / "stop.ckpt")
    assert len(rest) == 12 - 2 * stop
    assert all(map(torch.equal, rest, whole[2 * stop :]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 1000}, r"data\.size=1000: expected 16 to 600, the points of the smallest clouds that are drawn"),
        ({"size": 1}, r"data\.size=1: expected 16 to 600"),
        ({"views": 0}, "expected clouds >= 1 and views >= 1, found 16 and 0"),
        ({"clouds": 0}, r"data\.batch_size=2: expected at most the 0 training clouds of data\.clouds=0"),
        ({"batch_size": 17}, r"data\.batch_size=17: expected at most the 16 training clouds of data\.clouds=16"),
        ({"batch_size": 0}, "expected batch_size >= 1 and workers >= 0, found 0 and 0"),
        ({"workers": -1}, "expected batch_size >= 1 and workers >= 0, found 2 and -1"),
        ({"points": 15}, r"data\.points=15: expected at least 16"),
        ({"normals": "guessed"}, r"data\.normals=guessed"),
    ],
)
def test_bad_options_are_refused_before_the_training(options: dict[str, Any], message: str, folder: Path) -> None:
    with pytest.raises(ValueError, match=message):
        data_module(folder, **options).setup()


def test_more_queries_than_a_crop_has_room_for_are_refused_before_anything_is_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ProjectionDataModule, "setup", lambda *_: pytest.fail("data were made"))
    given = [
        "experiment=surface",
        "data.root=null",
        "data.validation=[mug]",
        "data.size=128",
        "trainer.accelerator=cpu",
    ]
    line = refused(capsys, train, [*given, "model.queries=385", "run=failed", "quiet=true"])
    expected = "model.queries=385: expected at most 3 times the points of a training input, data.size=128"
    assert expected in line
    assert read_json(tmp_path / "failed" / "run.json")["status"] == "failed"
    Surface(queries=384).check_input("data.size", 128)
    with pytest.raises(ValueError, match=r"model\.queries=0: expected at least 1"):
        Surface(queries=0)
    for data, key in ((PatchDataModule(input_points=64), "data.input_points"), (data_module(tmp_path), "data.size")):
        with pytest.raises(ValueError, match=rf"training input, {key}=64"):
            check_input(Surface(queries=193), data)
    check_input(PNU(), PatchDataModule(input_points=64))


@pytest.mark.parametrize(("size", "normals"), [(600, "given"), (600, "estimated"), (16, "estimated")])
def test_crops_of_the_greatest_and_the_least_size_stack(meshes: dict[str, Mesh], size: int, normals: str) -> None:
    crops = Crops(meshes, 4, size=size, views=1, normals=normals)
    assert flattened([crops[0, i] for i in range(4)])["input"].shape == (4, size, 6)


@pytest.mark.slow
def test_data_module_and_a_few_steps(tmp_path, meshes: dict[str, Mesh]) -> None:
    for name, mesh in meshes.items():
        write_mesh(tmp_path / f"{name}.ply", mesh)
    data = ProjectionDataModule(
        str(tmp_path), False, [NAMES[0]], "given", clouds=8, size=128, views=2, batch_size=4, points=128,
        workers=0, seed=0,
    )  # fmt: skip
    data.setup()
    assert set(data.datasets["train"].names) == set(NAMES[1:])
    torch.manual_seed(0)
    model, loss = Surface(queries=32), SurfaceLoss()
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    values = []
    for _ in range(15):
        batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
        outputs = model.outputs(batch["input"])
        terms = loss(outputs["prediction"], batch["target"], {**batch, **outputs})
        optimizer.zero_grad()
        terms["loss"].backward()
        optimizer.step()
        values.append(float(terms["loss"].detach()))
    assert values[-1] < 0.9 * values[0]  # the same batch each time
    assert next(iter(data.val_dataloader()))["target"].shape == (1, 512, 6)


def test_missing_validation_mesh_is_named(tmp_path, meshes: dict[str, Mesh]) -> None:
    write_mesh(tmp_path / "a.ply", meshes[NAMES[0]])
    data = ProjectionDataModule(
        str(tmp_path), False, ["b"], "given", clouds=8, size=128, views=2, batch_size=4, points=128, workers=0, seed=0
    )
    with pytest.raises(ValueError, match=r"data\.validation: found no mesh b"):
        data.setup()
