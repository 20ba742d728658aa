"""The Lightning module, alone: what it logs, what stops it, what it optimizes."""

import functools
import math
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, Subset

from pnu.losses import CompoundLoss
from pnu.metrics import chamfer_sq
from pnu.training.lightning_module import TRAINER_OPTIONS, NonFinite, StepValues, UpsamplingModule, quieten


class Spread(nn.Module):
    """Four points around each input point, by a linear layer; small and fast."""

    ratio, predicts_normals = 4, True

    def __init__(self, columns: int = 6) -> None:
        super().__init__()
        self.predicts_normals = columns == 6
        self.columns = columns
        self.offsets = nn.Linear(6, 4 * columns)

    def forward(self, patch: Tensor) -> Tensor:
        offsets = 0.1 * self.offsets(patch).unflatten(-1, (4, self.columns))
        return (patch[:, :, None, : self.columns] + offsets).flatten(1, 2)

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        return {"prediction": self(patch)}


class Spheres(Dataset):
    """Points of the unit sphere with their normals; `broken`: index of a sample whose input holds a NaN."""

    def __init__(self, length: int, broken: int | None = None) -> None:
        self.length, self.broken = length, broken

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(index)
        cloud = torch.randn(128, 3, generator=generator)
        cloud = (cloud / cloud.norm(dim=1, keepdim=True)).repeat(1, 2)
        sample = {"input": cloud[:32].clone(), "target": cloud, "index": index, "shape": "sphere"}
        if index == self.broken:
            sample["input"][0, 0] = math.nan
        return sample


class Record(pl.loggers.logger.DummyLogger):
    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, dict[str, float]]] = []

    def log_metrics(self, metrics: dict[str, float], step: int) -> None:
        self.rows.append((step, metrics))

    def steps(self, name: str) -> list[int]:
        return [step for step, metrics in self.rows if name in metrics]

    def values(self, name: str) -> list[float]:
        return [metrics[name] for _, metrics in self.rows if name in metrics]


def trainer(tmp_path: Path, logger: Any = False, **options: Any) -> pl.Trainer:
    quieten()
    options = {"accelerator": "cpu", "max_steps": 3, **options}
    return pl.Trainer(default_root_dir=tmp_path, logger=logger, **TRAINER_OPTIONS, **options)


def module(columns: int = 6, **options: Any) -> UpsamplingModule:
    torch.manual_seed(0)
    adam = functools.partial(torch.optim.Adam, lr=1e-2)
    return UpsamplingModule(Spread(columns), CompoundLoss(k=3), **{"optimizer": adam, **options})


def loader(length: int = 6, **options: Any) -> DataLoader:
    return DataLoader(Spheres(length, **options), batch_size=2)


def test_every_term_every_step_and_every_metric(tmp_path: Path) -> None:
    record = Record()
    trainer(tmp_path, record).fit(module(), loader(), loader(4))
    for name in ("cd", "point_knn", "normal", "normal_orth", "normal_knn", "loss", "lr", "gradient_norm"):
        assert record.steps(f"train/{name}") == [0, 1, 2], name
    for name in ("chamfer_sq", "hausdorff_sq", "spacing_cv", "normal_deg", "normal_unsigned_deg", "flipped"):
        assert len(record.values(f"val/{name}")) == 1, name


def test_logged_loss_is_the_weighted_sum(tmp_path: Path) -> None:
    record = Record()
    trainer(tmp_path, record).fit(module(), loader(), loader(2))
    weights = {"cd": 1, "point_knn": 0.1, "normal": 0.05, "normal_orth": 1e-4, "normal_knn": 1e-4}
    for i, loss in enumerate(record.values("train/loss")):
        total = sum(weight * record.values(f"train/{name}")[i] for name, weight in weights.items())
        assert loss == pytest.approx(total, rel=1e-5)


def test_validation_is_the_mean_over_clouds_with_a_smaller_last_batch(tmp_path: Path) -> None:
    lit = module()
    (found,) = trainer(tmp_path).validate(lit, loader(5), verbose=False)
    samples = [Spheres(5)[i] for i in range(5)]
    with torch.no_grad():
        values = [chamfer_sq(lit(s["input"][None])[0], s["target"]).item() for s in samples]
    assert found["val/chamfer_sq"] == pytest.approx(sum(values) / 5, rel=1e-5)


def test_training_lowers_the_loss(tmp_path: Path) -> None:
    record = Record()
    trainer(tmp_path, record, max_steps=60).fit(module(), loader(), loader(2))
    values = record.values("train/loss")
    assert values[-1] < 0.85 * values[0]


def test_network_without_normals(tmp_path: Path) -> None:
    record = Record()
    trainer(tmp_path, record).fit(module(columns=3), loader(), loader(2))
    assert not record.values("train/normal")
    assert not record.values("val/normal_deg")
    assert record.values("val/chamfer_sq")


def test_nan_in_the_loss_stops_with_step_term_and_batch(tmp_path: Path) -> None:
    class Broken(CompoundLoss):
        calls = 0

        def forward(self, *arguments: Any) -> dict[str, Tensor]:
            terms = super().forward(*arguments)
            Broken.calls += 1
            if Broken.calls == 3:
                terms["normal"] = terms["normal"] * math.nan
                terms["loss"] = terms["loss"] + terms["normal"]
            return terms

    lit = module()
    lit.loss = Broken(k=3)
    with pytest.raises(NonFinite, match=r"step 2: normal is nan; the batch is in .*\.pt; a lower optimizer\.lr"):
        trainer(tmp_path).fit(lit, loader(), loader(2))
    (path,) = tmp_path.glob("nonfinite*.pt")
    saved = torch.load(path, weights_only=True)
    assert saved["step"] == 2
    assert math.isnan(saved["terms"]["normal"])
    assert math.isfinite(saved["terms"]["cd"])
    assert torch.equal(saved["batch"]["input"], torch.stack([Spheres(6)[i]["input"] for i in (4, 5)]))
    assert saved["batch"]["shape"] == ["sphere", "sphere"]


def test_infinite_gradient_stops_before_it_reaches_the_weights(tmp_path: Path) -> None:
    class Steep(CompoundLoss):
        def forward(self, prediction: Tensor, *arguments: Any) -> dict[str, Tensor]:
            terms = super().forward(prediction, *arguments)
            terms["loss"] = terms["loss"] + (prediction - prediction.detach()).abs().sum().sqrt()  # 0, slope 1 / 0
            return terms

    lit = module()
    lit.loss = Steep(k=3)
    before = {name: value.clone() for name, value in lit.state_dict().items()}
    with pytest.raises(NonFinite, match=r"step 0: gradient is (nan|inf)"):
        trainer(tmp_path).fit(lit, loader(), loader(2))
    assert all(torch.equal(before[name], value) for name, value in lit.state_dict().items())
    assert torch.load(next(tmp_path.glob("nonfinite*.pt")), weights_only=True)["batch"]["input"].shape == (2, 32, 6)


def test_finite_training_leaves_no_file(tmp_path: Path) -> None:
    trainer(tmp_path).fit(module(), loader(), loader(2))
    assert not list(tmp_path.glob("nonfinite*"))


@pytest.mark.parametrize(
    ("scheduler", "end"),
    [
        (functools.partial(torch.optim.lr_scheduler.CosineAnnealingLR, eta_min=0), 1.7e-4),
        (functools.partial(torch.optim.lr_scheduler.OneCycleLR, max_lr=1e-2, pct_start=0.5, final_div_factor=10), 4e-5),
        (functools.partial(torch.optim.lr_scheduler.StepLR, step_size=5, gamma=0.5), 2.5e-3),
    ],
)
def test_schedule_spans_the_training_and_steps_with_it(scheduler: Any, end: float, tmp_path: Path) -> None:
    record = Record()
    lit = module(scheduler=scheduler)
    trainer(tmp_path, record, max_steps=-1, max_epochs=4).fit(lit, loader(), loader(2))
    rates = record.values("train/lr")
    assert len(rates) == 12
    assert rates[-1] == pytest.approx(end, rel=0.01)
    assert max(rates) == pytest.approx(1e-2)


def test_schedule_of_an_endless_training_is_refused(tmp_path: Path) -> None:
    lit = module(scheduler=functools.partial(torch.optim.lr_scheduler.OneCycleLR, max_lr=1e-2))
    with pytest.raises(ValueError, match=r"give trainer\.max_epochs or trainer\.max_steps"):
        trainer(tmp_path, max_steps=-1, max_epochs=-1).fit(lit, loader(), loader(2))


def test_schedule_follows_the_time_of_a_training_that_only_time_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step a second: the rate of each second is that of its share of the ten."""
    record = Record()
    lit = module(scheduler=functools.partial(torch.optim.lr_scheduler.OneCycleLR, max_lr=1e-2, pct_start=0.5))
    timed = trainer(tmp_path, record, max_steps=-1, max_epochs=-1, max_time="00:00:00:10")
    monkeypatch.setattr(Timer, "time_elapsed", lambda self, *_: float(timed.global_step))
    monkeypatch.setattr(Timer, "time_remaining", lambda self, *_: float(10 - timed.global_step))
    timed.fit(lit, loader(), loader(2))
    rates = record.values("train/lr")
    assert len(rates) == 10
    rising = [(1 - math.cos(math.pi * share / 0.5)) / 2 for share in (0, 0.1, 0.2, 0.3, 0.4, 0.5)]
    assert rates[:6] == pytest.approx([4e-4 + (1e-2 - 4e-4) * part for part in rising], rel=1e-3)
    falling = [(1 + math.cos(math.pi * (share - 0.5) / 0.5)) / 2 for share in (0.6, 0.7, 0.8, 0.9)]
    assert rates[6:] == pytest.approx([1e-2 * part for part in falling], rel=1e-3)


class Shares(pl.LightningDataModule):
    """Clouds of which each process sees its own: with two of them, one of two to train, three and one to validate."""

    def share(self, length: int, most: int, batch_size: int) -> DataLoader:
        assert self.trainer is not None
        parts = [range(length)] if self.trainer.world_size == 1 else [range(most), range(most, length)]
        return DataLoader(Subset(Spheres(length), parts[self.trainer.global_rank]), batch_size=batch_size)

    def train_dataloader(self) -> DataLoader:
        return self.share(2, 1, 2)

    def val_dataloader(self) -> DataLoader:
        return self.share(4, 3, 1)


class Table(pl.Callback):
    """Writes the logged values of the first process to a file: it may be another process than the test's."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.is_global_zero:
            values = {name: float(value) for name, value in trainer.callback_metrics.items()}
            torch.save({**values, "elapsed": module.elapsed_s}, self.path)


@pytest.mark.slow
def test_two_processes_log_what_one_logs(tmp_path: Path) -> None:
    """Terms are means over processes; metrics are sums over them, also where they have not as many clouds."""
    # no fork: a child has no threads of its parent, but the locks that they held
    two = {"devices": 2, "strategy": DDPStrategy(start_method="spawn", timeout=timedelta(seconds=60))}
    found = []
    for name, more in (("one", {}), ("two", two)):
        path = tmp_path / f"{name}.pt"
        lit = module(optimizer=functools.partial(torch.optim.SGD, lr=1e-2))
        trainer(tmp_path, max_steps=1, callbacks=[Table(path)], **more).fit(lit, Shares())
        found.append(torch.load(path))
        assert found[-1].pop("elapsed") > 0
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    assert {"train/loss", "val/chamfer_sq"} <= set(found[0])
    values = [terms_of(i) for i in (0, 1)]
    assert found[1]["train/loss"] == pytest.approx((values[0]["loss"] + values[1]["loss"]) / 2, rel=1e-5)
    assert values[0]["loss"] != pytest.approx(values[1]["loss"], rel=1e-3)


def terms_of(index: int) -> dict[str, float]:
    """Terms of the untrained module on one cloud."""
    lit, sample = module(), Spheres(9)[index]
    assert lit.loss is not None
    with torch.no_grad():
        terms = lit.loss(lit(sample["input"][None]), sample["target"][None])
    return {name: float(value) for name, value in terms.items()}


@pytest.mark.parametrize(("batches", "micro"), [(6, [3, 3]), (5, [3, 2])])
def test_logged_terms_are_means_over_the_micro_batches_of_a_step(
    batches: int, micro: list[int], tmp_path: Path
) -> None:
    """Also where the last step of an epoch has fewer of them. The optimizer stands still: values are of one state."""
    record = Record()
    still = functools.partial(torch.optim.SGD, lr=0.0)
    data = DataLoader(Spheres(batches), batch_size=1)
    options = {"accumulate_grad_batches": 3, "max_steps": -1, "max_epochs": 1}
    trainer(tmp_path, record, **options).fit(module(optimizer=still), data, loader(2))
    each = [terms_of(i) for i in range(batches)]
    assert each[0]["cd"] != pytest.approx(each[2]["cd"], rel=1e-3)
    for name in ("cd", "point_knn", "normal", "normal_orth", "normal_knn", "loss"):
        values = [terms[name] for terms in each]
        expected = [sum(values[:3]) / 3, sum(values[3:]) / micro[1]]
        assert record.values(f"train/{name}") == pytest.approx(expected, rel=1e-5), name


def test_values_that_are_read_a_step_later_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU: each under its own step, the last one too, and all that led to a checkpoint before it is saved."""
    records = [Record(), Record()]
    trainer(tmp_path, records[0], max_steps=3).fit(module(), loader(6), loader(2))
    monkeypatch.setattr(UpsamplingModule, "steps_behind", 1)
    late = trainer(tmp_path, records[1], max_steps=3)
    late.fit(module(), loader(6), loader(2))
    names = [f"train/{name}" for name in ("cd", "loss", "gradient_norm", "lr")]
    for name in names:
        assert records[1].values(name) == pytest.approx(records[0].values(name)), name
    lit = module()
    lit.unread = [StepValues(7, ["prediction", "loss"], torch.tensor([[1.0, 2.0]]), torch.tensor([1.0, 2.0, 0.5, 3.0]),
                             None, 0.1, [{}])]  # fmt: skip
    lit.trainer = late
    lit.on_save_checkpoint({})
    assert (lit.unread, lit.last_loss, lit.elapsed_s) == ([], 2.0, 3.0)


def test_a_broken_step_that_is_read_late_is_named_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The step that broke, not the one that is at work when it is seen; no checkpoint is made of it."""
    monkeypatch.setattr(UpsamplingModule, "steps_behind", 1)
    lit = trainer(tmp_path, max_steps=5)
    with pytest.raises(NonFinite, match=r"step 1: prediction is nan"):
        lit.fit(module(), DataLoader(Spheres(4, broken=1), batch_size=1), loader(2))
    saved = torch.load(next(tmp_path.glob("nonfinite*.pt")), weights_only=True)
    assert (saved["step"], saved["batch"]["index"].tolist()) == (1, [1])
    assert math.isnan(saved["terms"]["prediction"])


@pytest.mark.parametrize("broken", [0, 1, 2])
def test_nan_in_any_micro_batch_stops_and_keeps_that_one(broken: int, tmp_path: Path) -> None:
    data = DataLoader(Spheres(3, broken=broken), batch_size=1)
    with pytest.raises(NonFinite, match=r"step 0: prediction is nan"):
        trainer(tmp_path, accumulate_grad_batches=3, max_steps=1).fit(module(), data, loader(2))
    saved = torch.load(next(tmp_path.glob("nonfinite*.pt")), weights_only=True)
    assert saved["batch"]["index"].tolist() == [broken]
    assert math.isnan(saved["terms"]["prediction"])


def test_what_a_batch_has_beside_tensors_does_not_spoil_the_file(tmp_path: Path) -> None:
    """A batch of the surface model holds the true surfaces, an object."""

    class Data(pl.LightningDataModule):
        def train_dataloader(self) -> DataLoader:
            return DataLoader(Spheres(2, broken=0), batch_size=2)

        val_dataloader = train_dataloader

        def on_after_batch_transfer(self, batch: dict[str, Any], dataloader_idx: int) -> dict[str, Any]:
            return {**batch, "surface": object()}

    with pytest.raises(NonFinite, match="prediction is nan"):
        trainer(tmp_path, limit_val_batches=0).fit(module(), Data())
    saved = torch.load(next(tmp_path.glob("nonfinite*.pt")), weights_only=True)
    assert set(saved["batch"]) == {"input", "target", "index", "shape"}


class Nearness(nn.Module):
    """A loss that asks for no value itself."""

    def forward(self, prediction: Tensor, target: Tensor, extra: Any) -> dict[str, Tensor]:
        terms = {name: (prediction.mean() - target.mean()).square() * i for i, name in enumerate("abcd")}
        return {**terms, "loss": torch.stack(list(terms.values())).sum()}


def test_one_transfer_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each float(tensor), item or tolist of a value waits for the device, and so does a number that is sent to it."""
    asked: list[str] = []
    lit = module()
    lit.loss = Nearness()
    monkeypatch.setattr(lit, "log_dict", lambda *_, **__: None)  # of the CPU
    for name in ("item", "tolist", "__float__", "__bool__", "__int__", "new_tensor"):
        plain = getattr(Tensor, name)

        def call(self: Tensor, *arguments: Any, name: str = name, plain: Any = plain) -> Any:
            if inside:
                asked.append(name)
            return plain(self, *arguments)

        monkeypatch.setattr(Tensor, name, call)
    inside: list[str] = []
    for name in ("training_step", "on_before_optimizer_step"):
        wrapped = getattr(lit, name)

        @functools.wraps(wrapped)
        def watched(*arguments: Any, name: str = name, wrapped: Any = wrapped) -> Any:
            inside.append(name)
            result = wrapped(*arguments)
            inside.pop()
            return result

        monkeypatch.setattr(lit, name, watched)
    trainer(tmp_path, accumulate_grad_batches=2, max_steps=3, max_epochs=-1).fit(lit, loader(8), loader(2))
    assert asked == ["tolist"] * 3


@pytest.mark.parametrize(
    ("device", "precision", "options", "fused"),
    [
        ("cuda", "32-true", {}, True),
        ("cuda", "32-true", {"fused": False}, False),
        ("cuda", "16-mixed", {}, None),
        ("cpu", "32-true", {}, None),
    ],
)
def test_on_a_gpu_the_optimizer_is_one_kernel(
    device: str, precision: str, options: dict[str, Any], fused: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless one says otherwise, and not under a gradient scaler, which it would not go with."""
    monkeypatch.setattr(UpsamplingModule, "device", torch.device(device))
    monkeypatch.setattr(UpsamplingModule, "trainer", SimpleNamespace(precision=precision))
    lit = module(optimizer=functools.partial(torch.optim.Adam, lr=1e-3, **options))
    assert lit.optimizer_of(lit.parameters()).defaults["fused"] is fused
    lit.optimizer = functools.partial(torch.optim.Rprop, lr=1e-3)  # which has no such form
    assert "fused" not in lit.optimizer_of(lit.parameters()).defaults


def test_mixed_precision_trains(tmp_path: Path) -> None:
    record = Record()
    trainer(tmp_path, record, precision="bf16-mixed").fit(module(), loader(), loader(2))
    assert all(map(math.isfinite, record.values("train/loss")))
