"""What users of Lightning and Hydra type, and what it does here: docs/lightning_hydra.md is made from this file.

    PNU_WRITE=1 python -m pytest tests/config/test_lightning_hydra.py

writes the page anew.
"""

import csv
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml

import pnu
from pnu.commands.train import Train, main
from pnu.config.compose import compose_config
from pnu.config.instantiate import GIVEN
from pnu.config.schema import class_arguments
from pnu.networks.checkpoints import read_checkpoint
from tests.refusals import refused

PAGE = Path(__file__).resolve().parents[2] / "docs" / "lightning_hydra.md"
INTRO = """# Lightning and Hydra, as their users know them

What one types, and what it does. `tests/config/test_lightning_hydra.py` makes the table and runs each line: where a
line is refused, its error message stands there. Every argument of Lightning's Trainer is a key of `trainer`, of its
loggers and callbacks one of `logger.NAME` and `callbacks.NAME`, with or without a `+`; `--help` lists them.

| `python -m pnu.train ...` | does |
|---|---|
"""


@pytest.fixture(scope="module")
def patch_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 patches of 6 balls: 256 points with their normals."""
    path = tmp_path_factory.mktemp("data") / "patches.h5"
    ball = np.random.default_rng(0).normal(size=(12, 256, 3))
    ball /= np.linalg.norm(ball, axis=-1, keepdims=True)
    with h5py.File(path, "w") as file:
        file["poisson_4096"] = np.concatenate([ball, ball], -1).astype(np.float32)
        file["name"] = np.array([f"ball_{i % 6}" for i in range(12)], dtype=h5py.string_dtype())
    return path


@pytest.fixture
def train(patch_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """train(*overrides) -> run folder of two steps, an epoch, on small patches without local features."""
    monkeypatch.chdir(tmp_path)

    def run(*overrides: str, run: str = "run") -> Path:
        small = ["data=patches", f"data.path={patch_file}", "data.batch_size=4", "data.input_points=64"]
        small += ["data.target_points=256", "trainer.accelerator=cpu", "trainer.max_epochs=1", "quiet=true"]
        small += ["model.local_features=false", f"run={tmp_path / run}"]
        small += ["callbacks.pictures.clouds=0"] if {WITHOUT, PLAIN}.isdisjoint(overrides) else []
        main(
            [
                *(one for one in small if one.partition("=")[0] not in {o.partition("=")[0] for o in overrides}),
                *overrides,
            ]
        )
        return tmp_path / run

    return run


def record(run: Path) -> dict[str, Any]:
    return json.loads((run / "run.json").read_text())


def steps(run: Path) -> int:
    return read_checkpoint(run / "checkpoints" / "last.ckpt")["global_step"]


# --- the lines of the table that run ---

TABLE: dict[str, str] = {}  # typed -> does; filled by the decorator below


def row(typed: str, does: str) -> str:
    TABLE[typed] = does
    return typed


FAST = row(
    "trainer.fast_dev_run=true",
    "one batch of training, validation and test; no curves, no checkpoints, no pictures, as in Lightning; the run"
    " folder has config and metrics",
)
EXTRA = row(
    "+trainer.min_steps=3 trainer.max_epochs=2 trainer.gradient_clip_algorithm=norm trainer.gradient_clip_val=1",
    "any argument of Lightning's Trainer, with or without `+`",
)
CSV = row("logger=csv", "values in csv/metrics.csv of the run folder; a run that goes on adds csv_2")
SEVERAL = row("logger=[tensorboard,csv]", "several loggers at once, each with its keys: `logger.csv.name=...`")
WANDB = row(
    "logger=wandb logger.wandb.offline=true",
    "Weights & Biases, `pip install 'pnu[wandb]'`; what `wandb.init` takes may be given too: `logger.wandb.tags=[a]`",
)
MLFLOW = row("logger=mlflow", "MLflow in mlflow/ of the run folder, `pip install 'pnu[mlflow]'`")
NONE = row("logger=none", "no curves")
EMA = row(
    "callbacks=[default,ema]",
    "an exponential moving average of the weights: validation, best.ckpt and the test are of the average;"
    " `callbacks.ema.decay=0.999`",
)
STOPPING = row("callbacks=[default,early_stopping]", "Lightning's EarlyStopping; `callbacks.early_stopping.patience=5`")
OWN = row(
    "'+callbacks.rate={_target_: lightning.pytorch.callbacks.LearningRateMonitor, logging_interval: step}'",
    "any callback of Lightning",
)
WITHOUT = row("~callbacks.pictures", "without that callback")
PLAIN = row("callbacks=none", "no callbacks: no checkpoint is kept, which the last line says")
SANITY = row("trainer.num_sanity_val_steps=1", "validation batches before the training, which count for nothing")
SUMMARY = row("trainer.enable_model_summary=true trainer.enable_progress_bar=true", "Lightning's own instead of ours")
FOLDER = row("hydra.run.dir=FOLDER", "the run folder, as `run=FOLDER`")
CHDIR = row(
    "hydra.job.chdir=true hydra.run.dir=FOLDER",
    "the training runs in that folder; relative paths of the config are meant from there, as in Hydra",
)


def test_fast_dev_run_goes_through_once_and_keeps_nothing(train: Any, capsys: pytest.CaptureFixture[str]) -> None:
    run = train(FAST, "quiet=false")
    assert record(run)["status"] == "finished"
    assert set(json.loads((run / "metrics.json").read_text())) == {"untrained", "test"}
    assert not list((run / "checkpoints").iterdir())
    assert not list(run.glob("tensorboard/*"))
    assert "no checkpoint was kept: trainer.fast_dev_run" in capsys.readouterr().out


@pytest.mark.slow
def test_arguments_of_the_trainer_that_conf_does_not_show(train: Any) -> None:
    run = train(*EXTRA.split())
    assert steps(run) == 4
    assert yaml.safe_load((run / "config.yaml").read_text())["trainer"]["gradient_clip_algorithm"] == "norm"


@pytest.mark.slow
def test_csv_and_several_loggers(train: Any) -> None:
    run = train(SEVERAL)
    with (run / "csv" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows if row["train/loss"]] == ["0", "1"]
    assert list(run.glob("tensorboard/events*"))
    before = (run / "csv" / "metrics.csv").read_bytes()
    main([f"run={run}", "resume=true", "trainer.max_epochs=2", "quiet=true"])
    assert (run / "csv" / "metrics.csv").read_bytes() == before
    with (run / "csv_2" / "metrics.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file) if row["train/loss"]] == ["2", "3"]


@pytest.mark.slow
def test_one_logger_or_none(train: Any) -> None:
    run = train(CSV)
    assert (run / "csv" / "metrics.csv").is_file()
    assert not list(run.glob("tensorboard/*"))
    assert not list(train(NONE, run="none").glob("*/events*"))


@pytest.mark.slow
def test_the_average_of_the_weights_is_validated_and_kept_as_the_best(train: Any) -> None:
    options = ["optimizer=sgd", "scheduler=none", "callbacks.checkpoints.every_n_steps=1"]
    run = train(EMA, "callbacks.ema.decay=0.9", *options)
    plain = train(*options, run="plain")
    last, best = (read_checkpoint(run / "checkpoints" / f"{name}.ckpt")["state_dict"] for name in ("last", "best"))
    same = read_checkpoint(plain / "checkpoints/last.ckpt")["state_dict"]
    assert all(torch.equal(last[name], same[name]) for name in same)  # the training itself is as without
    average = read_checkpoint(run / "checkpoints/last.ckpt")["callbacks"]["EMA"]
    assert average["step"] == 2
    assert all(torch.equal(best[f"model.{name}"], value) for name, value in average["average"].items())
    assert any(not torch.equal(best[name], last[name]) for name in last)
    # by hand: from w0, decay (1 + step) / (10 + step) at steps 1 and 2
    whole = train("trainer.max_steps=1", *options, run="first")
    name = next(name for name in same if name.endswith("weight"))
    first = read_checkpoint(whole / "checkpoints/last.ckpt")["state_dict"][name]
    torch.manual_seed(0)
    start = initial(plain)[name.removeprefix("model.")]
    one = start.lerp(start, 0)  # the average begins with the weights before the first step
    one = one.lerp(first, 1 - 2 / 11)
    two = one.lerp(same[name], 1 - 3 / 12)
    torch.testing.assert_close(best[name], two)


def initial(run: Path) -> dict[str, torch.Tensor]:
    """The network of a run before its first step."""
    import lightning.pytorch as pl

    from pnu.networks import build_network

    config = yaml.safe_load((run / "config.yaml").read_text())
    pl.seed_everything(config["seed"], verbose=False)
    return build_network(config["model"]).state_dict()


@pytest.mark.slow
def test_a_run_with_an_average_goes_on_as_if_never_stopped(train: Any) -> None:
    whole = train(EMA, "trainer.max_epochs=2", run="whole")
    run = train(EMA)
    main([f"run={run}", "resume=true", "trainer.max_epochs=2", "quiet=true"])
    for name in ("last", "best"):
        ours, theirs = (read_checkpoint(one / "checkpoints" / f"{name}.ckpt")["state_dict"] for one in (run, whole))
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


@pytest.mark.slow
def test_callbacks_are_put_together(train: Any, capsys: pytest.CaptureFixture[str]) -> None:
    run = train(STOPPING, OWN.strip("'"), WITHOUT)
    callbacks = yaml.safe_load((run / "config.yaml").read_text())["callbacks"]
    assert set(callbacks) == {"checkpoints", "early_stopping", "rate"}
    run = train(PLAIN, "quiet=false", run="none")
    assert not list((run / "checkpoints").iterdir())
    assert "no checkpoint was kept" in capsys.readouterr().out


@pytest.mark.slow
def test_sanity_steps_count_for_nothing(train: Any) -> None:
    run = train(SANITY, *SUMMARY.split())
    plain = train(run="plain")
    assert (run / "metrics.json").read_text() == (plain / "metrics.json").read_text()


@pytest.mark.slow
def test_hydras_folder_is_the_run_folder(train: Any, tmp_path: Path) -> None:
    for options in (FOLDER, CHDIR):
        name = f"there_{len(options)}"
        train("run=null", *options.replace("FOLDER", str(tmp_path / name)).split())
        assert record(tmp_path / name)["status"] == "finished"
        os.chdir(tmp_path)


# --- what is refused, with one line ---

REFUSED = [
    *(f"trainer.{name}=1" for name in GIVEN["trainer"]),
    "+trainer.nonsense=1",
    "trainer.fast_devrun=true",
    "hydra.job.chdir=true",
    "logger=nothing",
    "callbacks.ema.decay=0.9",
]


@pytest.fixture
def message(train: Any, capsys: pytest.CaptureFixture[str], patch_file: Path) -> Callable[[str], str]:
    def of(typed: str) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            train("run=null", *typed.split())
        assert stopped.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("error: ")

    return of


@pytest.mark.slow
def test_what_has_no_use_here_says_why(message: Callable[[str], str]) -> None:
    found = {typed: message(typed) for typed in REFUSED}
    page = INTRO + "".join(f"| `{typed}` | {does} |\n" for typed, does in TABLE.items())
    page += "".join(f"| `{typed}` | refused: {line} |\n" for typed, line in found.items())
    if os.environ.get("PNU_WRITE"):
        PAGE.write_text(page, encoding="utf-8")
    assert PAGE.read_text(encoding="utf-8") == page, "PNU_WRITE=1 python -m pytest tests/config/test_lightning_hydra.py"


@pytest.mark.slow
def test_every_argument_of_the_trainer_is_known() -> None:
    import inspect

    from lightning.pytorch import Trainer

    known = class_arguments("trainer", "lightning.pytorch.Trainer")
    assert set(inspect.signature(Trainer).parameters) == set(known)
    for name, argument in known.items():
        if name not in GIVEN["trainer"] and argument.default is not None:
            cfg = compose_config(Train, [f"trainer.{name}={json.dumps(argument.default)}"])
            assert cfg.trainer[name] == argument.default


# --- loggers of packages that are not here ---

STAND_IN = """
class Run:
    name = id = path = "stand-in"
    def __init__(self, **options):
        self.options, self.logged = options, []
        self.config = self
    def log(self, values): self.logged.append(values)
    def define_metric(self, *_, **__): pass
    def update(self, *_, **__): pass
"""


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_missing_logger_says_how_to_get_it(
    name: str, train: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda one, *rest: None if one == name else found(one, *rest))
    line = refused(capsys, main, [f"logger={name}"])
    assert line == f"error: logger.{name}: needs {name}, which is not here; pip install 'pnu[{name}]'"


def test_wandb_offline(train: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    run = train(*WANDB.split(), "logger.wandb.tags=[one]")
    assert list(run.glob("wandb/offline-run-*"))


def test_mlflow_in_a_folder(train: Any) -> None:
    pytest.importorskip("mlflow")
    run = train(MLFLOW)
    assert list(run.glob("mlflow/*/*/metrics/train/loss"))


@pytest.mark.slow
def test_the_arguments_of_a_logger_reach_it(train: Any, patch_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for the class of Lightning, as the package behind it may not be installed."""
    import lightning.pytorch.loggers as loggers
    from lightning.pytorch.loggers import CSVLogger

    taken: dict[str, Any] = {}

    class WandbLogger(CSVLogger):
        def __init__(self, save_dir: str, **options: Any) -> None:
            taken.update(options, save_dir=save_dir)
            super().__init__(save_dir, "", "stand_in")

    WandbLogger.__module__ = "lightning.pytorch.loggers.wandb"
    monkeypatch.setattr(loggers, "WandbLogger", WandbLogger)
    monkeypatch.setitem(sys.modules, "wandb", type(sys)("wandb"))
    monkeypatch.setattr("importlib.util.find_spec", lambda *_: True)
    run = train("logger=[csv,wandb]", "logger.wandb.project=mine", "logger.wandb.offline=true", "logger.wandb.tags=[a]")
    assert taken == {
        "name": "train", "project": "mine", "offline": True, "log_model": False, "group": None, "tags": ["a"],
        "save_dir": str(run),
    }  # fmt: skip
    assert (run / "stand_in" / "metrics.csv").is_file()
    assert pnu.load(run) is not None
