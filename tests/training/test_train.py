"""Trainings through the real entry point, on a file of a few small patches."""

import importlib.metadata
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor

import pnu
from pnu.commands.train import main
from pnu.config.compose import config_folder
from pnu.networks.checkpoints import newest_run, read_checkpoint
from pnu.training import callbacks
from pnu.training.sweeps import locked
from tests.refusals import refused

Train = Callable[..., Path]


@pytest.fixture(scope="session")
def patch_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """30 patches of 6 ellipsoids: 256 points with their normals."""
    path = tmp_path_factory.mktemp("data") / "patches.h5"
    rng = np.random.default_rng(0)
    axes = rng.uniform(0.5, 1, (30, 1, 3))
    ball = rng.normal(size=(30, 256, 3))
    ball /= np.linalg.norm(ball, axis=-1, keepdims=True)
    normals = ball / axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    with h5py.File(path, "w") as file:
        file["poisson_4096"] = np.concatenate([ball * axes, normals], -1).astype(np.float32)
        file["name"] = np.array([f"ellipsoid_{i % 6}" for i in range(30)], dtype=h5py.string_dtype())
    return path


@pytest.fixture
def train(patch_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Train:
    """train(*overrides, run="name") -> run folder. Four steps of 5 patches make an epoch; one of the six shapes each is
    for validation and test."""
    monkeypatch.chdir(tmp_path)

    def run(*overrides: str, run: str = "run") -> Path:
        small = ["data=patches", f"data.path={patch_file}", "data.batch_size=5", "data.input_points=64"]
        small += ["data.target_points=256", "trainer.accelerator=cpu", "callbacks.pictures.clouds=0", "quiet=true"]
        main([*small, f"run={tmp_path / run}", *overrides])
        return tmp_path / run

    return run


def resume(run: Path, *overrides: str) -> None:
    main([f"run={run}", "resume=true", "quiet=true", *overrides])


def weights(run: Path, name: str = "last") -> dict[str, Tensor]:
    return read_checkpoint(run / "checkpoints" / f"{name}.ckpt")["state_dict"]


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def record(run: Path) -> dict[str, Any]:
    return json.loads((run / "run.json").read_text())


def events(run: Path) -> EventAccumulator:
    """All events of a run as TensorBoard shows them: what a restart took back is gone."""
    accumulator = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0, "tensors": 0, "images": 0})
    return accumulator.Reload()


def scalars(run: Path, name: str) -> list[tuple[int, float]]:
    """Steps and values of a curve, by step: files of one second come in the order of their names, .10 before .9."""
    return sorted((event.step, event.value) for event in events(run).Scalars(name))


# --- the run folder ---


@pytest.mark.slow
def test_hydras_folder_is_the_run_folder(train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = yaml.safe_load((train("trainer.max_steps=1") / "config.yaml").read_text())["data"]
    line = ["data=patches", *(f"data.{key}={small[key]}" for key in ("path", "input_points", "target_points"))]
    line += ["trainer.accelerator=cpu", "trainer.max_steps=1", "quiet=true", "callbacks.pictures.clouds=0"]
    main([*line, 'hydra.run.dir="a, b/${now:%Y}/${name}"'])
    (run,) = tmp_path.glob("a, b/2*/train")
    assert capsys.readouterr().out.splitlines()[-1] == str(run.relative_to(tmp_path))
    assert record(run)["status"] == "finished"
    assert (run / "checkpoints/last.ckpt").exists()
    assert not (tmp_path / "outputs").exists()
    assert re.search(r"\d threads?\b", record(run)["machine"])
    main([*line, "hydra.run.dir=same", f"run={tmp_path}/same"])
    assert record(tmp_path / "same")["status"] == "finished"
    error = refused(capsys, main, [*line, "hydra.run.dir=one", "run=two"])
    assert error == "error: run=two and hydra.run.dir=one: are two folders; give one of them"
    assert not (tmp_path / "one").exists()
    assert not (tmp_path / "two").exists()


def test_hydras_folder_is_none_of_other_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pnu.commands.upsample import main as upsample

    error = refused(capsys, upsample, ["input=a.ply", "output=b.ply", f"hydra.run.dir={tmp_path}/x"])
    assert "this command makes no run folder; its files are named by its keys" in error
    assert not (tmp_path / "x").exists()


@pytest.fixture(scope="module")
def finished(patch_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("finished") / "run"
    main(
        ["data=patches", f"data.path={patch_file}", "data.batch_size=5", "data.input_points=64"]
        + ["data.target_points=256", "trainer.accelerator=cpu", "trainer.max_epochs=2", "quiet=true"]
        + ["callbacks.pictures.size=48", "callbacks.pictures.points=100", "seed=5", f"run={run}"]
    )
    return run


def test_run_folder_is_complete(finished: Path) -> None:
    assert {path.name for path in finished.iterdir()} == {
        *("config.yaml", "run.json", "metrics.json", "checkpoints", "tensorboard", "pictures")
    }
    assert {path.name for path in (finished / "checkpoints").iterdir()} == {"last.ckpt", "best.ckpt"}
    found = record(finished)
    assert found["status"] == "finished"
    assert (found["seed"], found["ratio"], found["device"]) == (5, 4, "cpu")
    assert found["versions"]["torch"] == importlib.metadata.version("torch")
    assert len(found["config_hash"]) == 16


def test_config_is_resolved_and_plain(finished: Path) -> None:
    text = (finished / "config.yaml").read_text()
    assert "${" not in text
    config = yaml.safe_load(text)
    assert config["data"]["seed"] == 5
    assert config["model"] == {
        "_target_": "pnu.networks.pnu.PNU",
        **{"ratio": 4, "input_normals": True, "predict_normals": True, "local_features": True, "global_features": True},
        "residual": False,
    }


@pytest.mark.parametrize("name", ["last", "best"])
def test_checkpoints_hold_tensors_and_plain_types(finished: Path, name: str) -> None:
    content = torch.load(finished / "checkpoints" / f"{name}.ckpt", weights_only=True)
    assert content["global_step"] == 8 if name == "last" else content["global_step"] in (4, 8)
    assert all(key.startswith("model.") for key in content["state_dict"])
    assert ("optimizer_states" in content) == (name == "last")


def test_run_is_found_and_loads_as_a_network(finished: Path) -> None:
    assert newest_run(finished.parent) == finished
    network = pnu.load(finished)
    assert not network.training
    with torch.no_grad():
        assert network(torch.randn(1, 64, 6)).shape == (1, 256, 6)


def test_metrics_of_untrained_best_and_test(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    names = {"chamfer_sq", "hausdorff_sq", "spacing_cv", "normal_deg", "normal_unsigned_deg", "flipped"}
    assert set(metrics) == {"untrained", "validation", "test"}
    for section in metrics.values():
        assert names <= set(section)
        assert all(np.isfinite(section[name]) for name in names)
    assert metrics["validation"]["step"] in (4, 8)
    values = [value for _, value in scalars(finished, "val/chamfer_sq")]
    assert metrics["untrained"]["chamfer_sq"] == pytest.approx(values[0])
    assert metrics["validation"]["chamfer_sq"] == pytest.approx(min(values[1:]))


def test_tensorboard_has_curves_clouds_pictures_config_and_hparams(finished: Path) -> None:
    found = events(finished)
    names = found.Tags()["scalars"]
    for name in ("cd", "point_knn", "normal", "normal_orth", "normal_knn", "loss", "lr", "gradient_norm"):
        assert [step for step, _ in scalars(finished, f"train/{name}")] == list(range(8))
    assert [step for step, _ in scalars(finished, "val/chamfer_sq")] == [0, 3, 7]
    assert {"test/chamfer_sq", "test/normal_deg", "val/spacing_cv"} <= set(names)
    (shape,) = found.Tags()["images"]
    assert shape.startswith("ellipsoid_")
    tensors = set(found.Tags()["tensors"])
    assert "config/text_summary" in tensors
    assert {f"{shape}/{cloud}_VERTEX" for cloud in ("input", "prediction", "target")} <= tensors
    assert {f"{shape}/{cloud}_COLOR" for cloud in ("input", "prediction", "target")} <= tensors
    text = found.Tensors("config/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "w1: 1.0" in text


def test_clouds_of_tensorboard_are_capped_and_colored_by_normal(finished: Path) -> None:
    from tensorboard.util import tensor_util

    found = events(finished)
    shape = found.Tags()["images"][0]
    points = tensor_util.make_ndarray(found.Tensors(f"{shape}/target_VERTEX")[0].tensor_proto)
    colors = tensor_util.make_ndarray(found.Tensors(f"{shape}/target_COLOR")[0].tensor_proto)
    assert points.shape == (1, 86, 3)  # every third of 256: at most 100
    assert colors.shape == (1, 86, 3)
    outward = points[0] / np.linalg.norm(points[0], axis=1, keepdims=True)
    shown = colors[0].astype(float) / 127.5 - 1
    assert ((outward * shown).sum(1) > 0.8).mean() > 0.9  # normals of ellipsoids look away from the center


def test_hyperparameters_come_with_final_metrics(finished: Path) -> None:
    from tensorboard.plugins.hparams import plugin_data_pb2

    data = events(finished).summary_metadata
    start = plugin_data_pb2.HParamsPluginData.FromString(data["_hparams_/session_start_info"].plugin_data.content)
    values = start.session_start_info.hparams
    assert values["loss.w1"].number_value == 1
    assert values["seed"].number_value == 5
    assert not {"run", "quiet", "name", "data.workers"} & set(values), "they change no result"
    assert "_hparams_/experiment" not in data, "with it TensorBoard cannot tell what differs"


def test_points_of_the_3d_tab_are_as_large_as_their_spacing(finished: Path) -> None:
    from tensorboard.plugins.mesh import plugin_data_pb2
    from tensorboard.util import tensor_util

    data = events(finished).summary_metadata
    (tag,) = (tag for tag in list(data) if tag.endswith("target_VERTEX") and "ellipsoid" in tag)
    config = plugin_data_pb2.MeshPluginData.FromString(data[tag].plugin_data.content).json_config
    points = tensor_util.make_ndarray(events(finished).Tensors(tag)[0].tensor_proto)[0]
    spacing = np.linalg.norm(points[:, None] - points[None], axis=2)
    spacing[np.diag_indices(len(points))] = np.inf
    material = json.loads(config)["material"]
    assert material["cls"] == "PointsMaterial"
    assert 0.5 < material["size"] / np.median(spacing.min(1)) < 3


def test_a_few_clouds_at_most_go_to_the_3d_tab(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(callbacks, "CLOUDS_3D", 1)
    run = train(
        "callbacks.pictures.clouds=2", "callbacks.pictures.size=32", "trainer.max_steps=1", "data.val_share=0.4"
    )
    found = events(run)
    assert len(found.Tags()["images"]) == 2
    assert len({tag.partition("/")[0] for tag in found.Tags()["tensors"] if "VERTEX" in tag}) == 1


def test_pictures_show_the_first_and_the_last_validation(finished: Path) -> None:
    from PIL import Image

    paths = sorted((finished / "pictures").iterdir())
    assert [path.stem.rpartition("_")[2] for path in paths] == ["0000000", "0000008"]
    assert all(np.asarray(Image.open(path)).std() > 0 for path in paths)


def test_pictures_of_shapes_named_by_folders(tmp_path: Path) -> None:
    drawn = callbacks.Pictures(SimpleNamespace(pictures=tmp_path), size=32)  # type: ignore[arg-type]
    cloud = torch.randn(64, 6, generator=torch.Generator().manual_seed(0))
    drawn.samples = [{"shape": "procedural/apple", "input": cloud, "target": cloud}]
    trainer = SimpleNamespace(is_global_zero=True, global_step=7, loggers=[])
    network = torch.nn.Identity()
    network.device = torch.device("cpu")  # type: ignore[assignment]
    drawn.draw(trainer, network)  # type: ignore[arg-type]
    assert [path.name for path in tmp_path.iterdir()] == ["procedural_apple_0000007.png"]


def test_the_end_tells_what_came_out_and_how_to_go_on(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    run = train("trainer.max_steps=1", "trainer.val_check_interval=1", "quiet=false")
    out = capsys.readouterr().out
    assert "CD x 1e3" in out
    assert "untrained  best validation" in out
    assert (
        "\nuntrained and best validation: on the validation's shapes; test: on other shapes, with the network of" in out
    )
    assert f"run folder: {run}" in out
    assert f"next: pnu upsample input=cloud.ply output=dense.ply run={run}" in out


def test_quiet_prints_the_folder_alone(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    run = train("trainer.max_steps=1")
    assert capsys.readouterr().out == f"{run}\n"


def test_name_and_date_make_the_folder(train: Train, tmp_path: Path) -> None:
    train("trainer.max_steps=1", "run=null", "name=mine")
    (run,) = (tmp_path / "outputs").glob("*/*_mine")
    assert record(run)["status"] == "finished"


# --- the same again ---


@pytest.mark.slow
def test_same_seed_same_weights_whatever_the_workers(train: Train) -> None:
    options = ["model.local_features=false", "trainer.max_steps=6"]  # beyond an epoch
    alone = weights(train(*options, run="a"))
    assert same(alone, weights(train(*options, "data.workers=2", run="b")))
    assert not same(alone, weights(train(*options, "seed=1", run="c")))


# --- go on ---


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(["trainer.max_epochs=2", "scheduler=onecycle"], marks=pytest.mark.slow),
        pytest.param(
            ["trainer.max_steps=6", "trainer.check_val_every_n_epoch=null", "trainer.val_check_interval=3"],
            marks=pytest.mark.slow,
        ),
        pytest.param(["trainer.max_epochs=2", "trainer.accumulate_grad_batches=2"], marks=pytest.mark.slow),
    ],
)
def test_a_run_goes_on_from_every_checkpoint_as_if_never_stopped(
    train: Train, options: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    copies: list[Path] = []
    save = callbacks.Checkpoints.save_last

    def save_and_keep(self: callbacks.Checkpoints, trainer: Any) -> None:
        save(self, trainer)
        copies.append(self.run.path.with_name(f"copy{len(copies)}"))
        shutil.copytree(self.run.path, copies[-1])

    with monkeypatch.context() as patch:
        patch.setattr(callbacks.Checkpoints, "save_last", save_and_keep)
        whole = train("callbacks.checkpoints.every_n_steps=1", "model.local_features=false", *options)
    assert len(copies) >= 4
    for copy in copies[:-1]:
        resume(copy)
        assert same(weights(copy), weights(whole)), copy
        assert same(weights(copy, "best"), weights(whole, "best")), copy
        assert (
            read_checkpoint(copy / "checkpoints/last.ckpt")["global_step"]
            == read_checkpoint(whole / "checkpoints/last.ckpt")["global_step"]
        )
        assert (copy / "metrics.json").read_text() == (whole / "metrics.json").read_text()
        for name in ("train/loss", "train/lr", "val/chamfer_sq"):
            ours, theirs = (scalars(run, name) for run in (copy, whole))
            assert ours == theirs, (copy, name)


@pytest.mark.slow
def test_a_finished_run_can_be_made_longer(train: Train) -> None:
    run = train("trainer.max_epochs=1")
    before = record(run)
    resume(run, "trainer.max_epochs=2")
    assert read_checkpoint(run / "checkpoints/last.ckpt")["global_step"] == 8
    assert same(weights(run), weights(train("trainer.max_epochs=2", run="whole")))
    assert record(run)["started"] == before["started"]
    assert len(record(run)["resumed"]) == 1
    assert yaml.safe_load((run / "config.yaml").read_text())["trainer"]["max_epochs"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "more"),
    [
        (4, []),
        pytest.param(2, [], marks=pytest.mark.slow),
        pytest.param(1, ["trainer.accumulate_grad_batches=3"], marks=pytest.mark.slow),
    ],
)
def test_a_run_that_ended_within_an_epoch_can_be_made_longer(train: Train, steps: int, more: list[str]) -> None:
    """It goes on with the rest of the epoch, or with the next, as a run that never ended."""
    options = ["model.local_features=false", "trainer.max_epochs=9", *more]
    run = train(*options, f"trainer.max_steps={steps}")
    resume(run, "trainer.max_steps=6")
    assert same(weights(run), weights(train(*options, "trainer.max_steps=6", run="whole")))


@pytest.mark.slow
def test_a_run_without_checkpoint_starts_again(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    run = train("trainer.max_epochs=1")
    final = weights(run)
    shutil.rmtree(run / "checkpoints")
    (run / "checkpoints").mkdir()
    assert len(events(run).Scalars("train/loss")) == 4
    resume(run)
    assert same(weights(run), final)
    told = capsys.readouterr().err
    assert told == (
        f"{run}: no checkpoint to go on from, starts anew; removed what was left: tensorboard, metrics.json\n"
    )
    raw = [event.step for path in run.glob("tensorboard/events*") for event in raw_scalars(path, "train/loss")]
    assert raw == [0, 1, 2, 3], "each step once, also for those that read the files as they are"
    assert len(record(run)["resumed"]) == 1


def raw_scalars(path: Path, tag: str) -> list[Any]:
    """Events of one file with that scalar, those too that a later start takes back."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    return [event for event in EventFileLoader(str(path)).Load() if any(v.tag == tag for v in event.summary.value)]


@pytest.mark.slow
def test_a_finished_run_without_its_last_checkpoint_is_kept(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    run = train("trainer.max_steps=2", "trainer.val_check_interval=2")
    (run / "checkpoints/last.ckpt").unlink()
    error = refused(capsys, main, [f"run={run}", "resume=true"])
    assert f"has no last.ckpt to go on from; pnu train weights={run} starts from it" in error
    assert (run / "checkpoints/best.ckpt").exists()
    assert record(run)["status"] == "finished"


@pytest.mark.slow
def test_a_run_of_an_older_version_goes_on(train: Train) -> None:
    run = train("trainer.max_epochs=1")
    config = yaml.safe_load((run / "config.yaml").read_text())
    del config["objective"], config["threads"]  # keys that came later
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    resume(run, "trainer.max_epochs=2")
    assert read_checkpoint(run / "checkpoints/last.ckpt")["global_step"] == 8
    assert yaml.safe_load((run / "config.yaml").read_text())["objective"] is None


@pytest.mark.slow
def test_what_a_run_has_learnt_cannot_change(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = refused(capsys, main, [f"run={finished}", "resume=true", "loss.w1=2"])
    assert "loss.w1=2: a run that goes on keeps its config; what may change: run, resume, quiet" in error


def test_resume_needs_a_run_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "resume=true needs run=FOLDER" in refused(capsys, main, ["resume=true"])
    assert "expected a run folder with config.yaml" in refused(capsys, main, ["resume=true", f"run={tmp_path}"])


def test_a_run_is_not_resumed_while_it_runs(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    held = locked(finished)
    try:
        assert "another process runs this job; wait for it" in refused(capsys, main, [f"run={finished}", "resume=true"])
    finally:
        os.close(held)


def test_a_run_is_not_overwritten(train: Train, finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "holds a run (finished)" in refused(capsys, main, [f"run={finished}"])
    assert record(finished)["status"] == "finished"


@pytest.mark.parametrize(
    ("group", "target"),
    [
        ("optimizer", "os.system"),
        ("data", "pnu.io.os.system"),
        ("loss", "subprocess.Popen"),
        ("model", "builtins.eval"),
    ],
)
def test_a_strangers_run_folder_runs_no_code(
    finished: Path, tmp_path: Path, group: str, target: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    config = yaml.safe_load((run / "config.yaml").read_text())
    config[group]["_target_"] = target
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    assert "expected a class" in refused(capsys, main, [f"run={run}", "resume=true"])


def test_a_strangers_key_is_refused(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["model"]["command"] = "rm"
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    assert "unknown key 'model.command'" in refused(capsys, main, [f"run={run}", "resume=true"])


def test_a_strangers_config_reads_no_variable_of_the_environment(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    (run / "config.yaml").write_text(
        (run / "config.yaml").read_text().replace("name: ", 'name: "\\x24{oc.env:HOME}" # ')
    )
    assert "expected plain values" in refused(capsys, main, [f"run={run}", "resume=true"])


# --- failures ---


def test_a_training_that_breaks_says_so(train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        train("trainer.max_epochs=2", "optimizer.lr=1e30")
    assert stopped.value.code == 2
    assert "error: step" in capsys.readouterr().err
    assert record(tmp_path / "run")["status"] == "failed"
    assert "NonFinite: step" in record(tmp_path / "run")["error"]
    assert len(list((tmp_path / "run").glob("nonfinite*.pt"))) == 1


@pytest.mark.slow
def test_a_checkpoint_that_cannot_be_written_is_no_success(
    train: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All checkpoints go through `checkpoint.write`: Lightning's own writing takes a full disk for a success."""
    content: list[bytes] = []

    def write(path: Path, checkpoint: dict[str, Any]) -> None:
        content.append((tmp_path / "run/checkpoints/last.ckpt").read_bytes())
        raise ValueError(f"{path}: cannot be written (No space left on device)")

    run = train("trainer.max_steps=2")
    before = (run / "checkpoints/last.ckpt").read_bytes()
    monkeypatch.setattr("pnu.training.callbacks.write_checkpoint", write)
    with pytest.raises(SystemExit) as stopped:
        resume(run, "trainer.max_steps=3")
    assert stopped.value.code == 2
    assert "last.ckpt: cannot be written (No space left on device)" in capsys.readouterr().err
    assert record(run)["status"] == "failed"
    assert content == [before] == [(run / "checkpoints/last.ckpt").read_bytes()]


def test_an_unknown_value_to_monitor_is_named(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train("trainer.max_steps=4", "callbacks.checkpoints.monitor=val/cd")
    assert "callbacks.checkpoints.monitor=val/cd: expected one of val/chamfer_sq, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("model.ratio=3", r"model.ratio"),
        ("data.batch_size=0", "batch_size"),
        ("data.path=nowhere.h5", "nowhere.h5"),
        ("callbacks.checkpoints.every_n_steps=-1", "every_n_steps"),
        ("callbacks.pictures.every=0", "every"),
        ("trainer.accelerator=abacus", "abacus"),
    ],
)
def test_bad_values_are_one_line(train: Train, override: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        train(override)
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


# --- every choice trains ---

CHOICES = [
    f"{group}={path.stem}"
    for group in ("optimizer", "scheduler", "debug")
    for path in sorted((config_folder() / group).glob("*.yaml"))
]  # of callbacks and loggers: test_lightning_hydra.py


@pytest.mark.parametrize(
    "choice",
    [
        *(pytest.param(choice, marks=pytest.mark.slow) for choice in CHOICES),
        *("model=pnu_paper", "trainer.precision=bf16-mixed"),
        pytest.param("model.predict_normals=false", marks=pytest.mark.slow),
    ],
)
def test_every_choice_trains_a_step(train: Train, choice: str) -> None:
    run = train(choice, "trainer.max_steps=1", "trainer.max_epochs=1", "data.batch_size=2")
    assert record(run)["status"] == "finished"
    assert read_checkpoint(run / "checkpoints/last.ckpt")["global_step"] == 1


@pytest.mark.slow
def test_onecycle_without_warm_up(train: Train) -> None:
    """Two steps of which half are warm-up: torch alone divides by the length of the warm-up, 1 - 1."""
    run = train("scheduler=onecycle", "scheduler.pct_start=0.5", "trainer.max_steps=2", "trainer.max_epochs=1")
    first, last = (value for _, value in scalars(run, "train/lr"))
    assert 1e-3 > first > last


@pytest.mark.slow
def test_early_stopping_stops(train: Train) -> None:
    stopping = "callbacks.early_stopping"
    options = ["callbacks=[default,early_stopping]", f"{stopping}.patience=1", f"{stopping}.min_delta=9"]
    run = train(*options, "trainer.max_epochs=9")
    assert read_checkpoint(run / "checkpoints/last.ckpt")["global_step"] < 36


@pytest.mark.slow
def test_deterministic_mode_gives_the_same_bits(train: Train) -> None:
    try:
        one, two = (weights(train("trainer.deterministic=true", "trainer.max_steps=2", run=name)) for name in "ab")
    finally:
        torch.use_deterministic_algorithms(False)
    assert same(one, two)


def test_without_validation_and_test(train: Train) -> None:
    run = train("trainer.max_steps=1", "trainer.limit_val_batches=0", "trainer.limit_test_batches=0", "quiet=false")
    assert record(run)["status"] == "finished"
    assert json.loads((run / "metrics.json").read_text()) == {"untrained": {}, "test": {}}
    assert not (run / "checkpoints/best.ckpt").exists()


@pytest.mark.slow
def test_training_goes_on_from_given_weights(train: Train, finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Started from a run's weights, the network before its first step is that run's."""
    first = train("trainer.max_steps=1", "trainer.val_check_interval=1", f"weights={finished}", "seed=9", "quiet=false")
    out = capsys.readouterr().out
    assert re.search(r"sphere +start +best validation +test\n", out)
    assert "start and best validation: on the validation's shapes" in out
    metrics = json.loads((first / "metrics.json").read_text())
    before = json.loads((finished / "metrics.json").read_text())
    assert "untrained" not in metrics
    assert metrics["start"]["chamfer_sq"] == pytest.approx(before["validation"]["chamfer_sq"], rel=1e-4)
    assert metrics["start"]["chamfer_sq"] != pytest.approx(before["untrained"]["chamfer_sq"], rel=1e-2)


def test_weights_of_another_network_are_refused(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train("trainer.max_steps=1", "weights=surface")
    assert "error: surface: expected the state of PNU" in capsys.readouterr().err
