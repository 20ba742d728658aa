"""Sweeps: ablations as configs, jobs that are found again, failures, launchers, searches."""

import json
import os
import platform
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from pnu.commands.train import Train, main
from pnu.config.compose import compose_config, composer, config_folder
from pnu.config.schema import checked_config
from pnu.io import read_json, write_json
from pnu.training.run_folder import RunFolder
from pnu.training.sweeps import check_job, label_of, sweep_arguments, sweep_name
from tests.training.test_train import patch_file  # noqa: F401  a fixture

ABLATIONS = sorted(path.stem for path in (config_folder() / "ablation").glob("*.yaml"))
SETTINGS = sorted(
    path.relative_to(config_folder() / "setting").as_posix().removesuffix(".yaml")
    for path in (config_folder() / "setting").rglob("*.yaml")
)
PAPER = {"w1": 1.0, "w2": 0.1, "w3": 0.05, "w4": 1e-4, "w5": 1e-4}


def overlay(ablation: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((config_folder() / "ablation" / f"{ablation}.yaml").read_text())
    return found


def params(ablation: str) -> dict[str, list[str]]:
    found = overlay(ablation)["hydra"]["sweeper"]["params"]
    return {key: [part.strip() for part in str(value).split(",")] for key, value in found.items()}


def small(patch_file: Path) -> list[str]:  # noqa: F811
    return [
        *("-m", "data=patches", f"data.path={patch_file}", "data.batch_size=5", "data.input_points=64"),
        *("data.target_points=256", "trainer.accelerator=cpu", "trainer.max_epochs=1", "trainer.max_steps=2"),
        *("trainer.check_val_every_n_epoch=null", "trainer.val_check_interval=1", "callbacks.pictures.clouds=0"),
        "quiet=true",
    ]


def records(folder: Path) -> dict[str, dict]:
    return {path.parent.name: json.loads(path.read_text()) for path in sorted(folder.glob("*/run.json"))}


def metrics(folder: Path) -> dict[str, dict]:
    return {path.parent.name: json.loads(path.read_text()) for path in sorted(folder.glob("*/metrics.json"))}


# --- the configs ---


@pytest.mark.parametrize(
    "ablation", [pytest.param(name, marks=[] if name == "normals" else pytest.mark.slow) for name in ABLATIONS]
)
def test_every_setting_changes_the_config_of_its_ablation(ablation: str) -> None:
    with composer("train") as compose:
        default = checked_config(compose([f"ablation={ablation}", "setting=default"]), Train)
        for setting in params(ablation)["setting"][1:]:
            cfg = checked_config(compose([f"ablation={ablation}", f"setting={setting}"]), Train)
            changed = yaml.safe_load((config_folder() / "setting" / f"{setting}.yaml").read_text())
            assert cfg != default
            for group in changed.keys() - {"defaults"}:
                for key, value in changed[group].items():
                    assert cfg[group][key] == value
                    another = cfg[group].get("_target_") != default[group].get("_target_")
                    assert another or value != default[group][key]


def test_every_setting_belongs_to_an_ablation() -> None:
    assert {name for ablation in ABLATIONS for name in params(ablation)["setting"]} == set(SETTINGS)


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_an_ablation_starts_from_the_default_and_has_seeds(ablation: str) -> None:
    found = params(ablation)
    assert found["setting"][0] == "default"
    assert len(set(found["setting"])) == len(found["setting"]) > 1
    trained = overlay(ablation).get("trainer", {}).get("max_steps") != 0
    assert len(found["seed"]) >= (3 if trained else 1)  # what is not trained is the same with all seeds


def weights_of(setting: str) -> dict[str, float]:
    changed = yaml.safe_load((config_folder() / "setting" / f"{setting}.yaml").read_text()) or {}
    return PAPER | changed.get("loss", {})


def test_loss_terms_leaves_out_each_term_and_keeps_each_alone_with_cd() -> None:
    left_out = [frozenset(k for k, v in weights_of(s).items() if v == 0) for s in params("loss_terms")["setting"]]
    others = {"w2", "w3", "w4", "w5"}
    wanted = {frozenset(), *(frozenset({key}) for key in PAPER), frozenset(others)}
    wanted |= {frozenset(others - {key}) for key in others}
    assert set(left_out) == wanted
    assert len(left_out) == len(wanted)


def test_loss_weights_are_the_papers_times_0_01_1_10() -> None:
    found = set()
    for setting in params("loss_weights")["setting"]:
        ratios = {key: value / PAPER[key] for key, value in weights_of(setting).items()}
        changed = [(key, round(ratio, 9)) for key, ratio in ratios.items() if abs(ratio - 1) > 1e-9]
        assert len(changed) == (setting != "default")
        found |= set(changed)
    assert found == {(key, factor) for key in PAPER for factor in (0, 0.1, 10)}


def test_full_scale_is_the_papers() -> None:
    assert compose_config(Train, ["scale=full"]) == compose_config(Train)


def test_sampling_compares_on_the_same_clouds(patch_file: Path) -> None:  # noqa: F811
    import torch

    from pnu.data.patch_module import PatchDataModule

    def batch(part: str, **options: str) -> torch.Tensor:
        data = PatchDataModule(str(patch_file), batch_size=2, input_points=64, target_points=256, **options)
        data.setup()
        return next(iter(data.loader(data.dataset(part), 2, 0)))["input"]

    uniform = {"downsampling": "poisson", "evaluation": "nonuniform"}
    assert torch.equal(batch("val", **uniform), batch("val"))
    assert not torch.equal(batch("val", downsampling="poisson"), batch("val"))


# --- names ---


def test_the_same_command_is_the_same_sweep() -> None:
    line = ["ablation=loss_terms", "scale=small"]
    name = sweep_name(line, "train")
    assert name.startswith("loss_terms_small_")
    assert name == sweep_name([*reversed(line), "quiet=true", "hydra/launcher=joblib"], "train")
    assert name != sweep_name([*line, "trainer.max_steps=3"], "train")
    assert sweep_name(["loss.w3=0,1"], "train").startswith("train_")
    assert not any(argument.startswith("sweep=") for argument in sweep_arguments([*line, "sweep=mine"], "train"))


def test_labels_are_short() -> None:
    assert label_of("seed=0,setting=loss_terms/no_cd") == "no_cd_seed-0"
    assert label_of("loss.w2=0.15676677195506075") == "loss.w2-0.1568"
    assert label_of("seed=0,setting=loss_terms/no_cd", "loss_terms/no_cd") == "no_cd_seed-0"
    assert label_of("seed=0", "loss_terms/no_cd") == "no_cd_seed-0"  # of a command with this setting alone
    assert label_of("data.path=/a/b c.h5,optimizer.lr=1e30") == "data.path-b-c.h5_optimizer.lr-1e+30"


# --- what a job cannot be ---


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("trainer=ddp", "a job of a sweep has one device; a distributed training starts the command line again"),
        ("trainer.devices=2", "a job of a sweep has one device"),
        ("trainer.devices=[0,1]", "a job of a sweep has one device"),
        ("trainer.num_nodes=2", "a job of a sweep has one device"),
        ("run=here", "run=here: not in a sweep"),
        ("sweep=a/b", "sweep=a/b: expected the name of a folder below outputs/sweeps"),
        ("setting=loss_terms/none", "setting/loss_terms=none: expected one of"),
    ],
)
def test_refused_before_the_first_job(
    override: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["-m", "seed=0,1", override])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_one_device_is_fine() -> None:
    for devices in (1, [1], "1"):
        check_job({"trainer": {"devices": devices, "num_nodes": 1, "strategy": "auto"}})


# --- start, again, go on ---


@pytest.mark.slow
def test_a_sweep_started_again_skips_what_has_finished(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    line = [*small(patch_file), "setting=default,normals/no_predicted_normals", "seed=0"]
    main(line)
    (folder,) = (tmp_path / "outputs" / "sweeps").iterdir()
    assert f"sweep folder: outputs/sweeps/{folder.name} (2 finished)" in capsys.readouterr().out
    before = records(folder)
    assert [name.partition("_")[0] for name in before] == ["default", "no"]
    assert [record["setting"] for record in before.values()] == ["default", "normals/no_predicted_normals"]
    main([*line, "data.workers=0", "sweep=" + folder.name])  # nothing that changes what is computed
    assert capsys.readouterr().out.count("has finished before, skipped") == 2
    assert records(folder) == before
    # one lost, one new seed: only those are trained
    (folder / next(iter(before)) / "run.json").unlink()
    main([*line[:-1], "seed=0,1", "sweep=" + folder.name])
    assert capsys.readouterr().out.count("has finished before, skipped") == 1
    after = records(folder)
    assert len(after) == 4
    assert all(record["status"] == "finished" for record in after.values())


@pytest.mark.slow
def test_a_curriculum_goes_on_from_the_job_before(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    line = [*("-m", "experiment=paper_cpu", "sweep=paper", "data=patches", f"data.path={patch_file}", "quiet=true")]
    line += ["data.batch_size=4", "trainer.max_steps=2", "trainer.val_check_interval=1", "callbacks.pictures.clouds=0"]
    main([*line, "scale=curriculum_64,curriculum_256", "data.target_points=256"])
    folder = tmp_path / "outputs" / "sweeps" / "paper"
    first, second = sorted(records(folder).items(), key=lambda item: item[1]["job"])
    assert first[1]["status"] == second[1]["status"] == "finished"
    assert "weights" not in first[1]
    assert Path(second[1]["weights"]).name == first[0]
    assert yaml.safe_load((folder / second[0] / "config.yaml").read_text())["data"]["input_points"] == 256
    found = metrics(folder)
    assert "untrained" in found[first[0]]
    assert "start" in found[second[0]]
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main([*line, "scale=curriculum_256", "sweep=alone"])
    assert "weights=previous: means the job before in a sweep (-m), and there is none" in capsys.readouterr().err
    main(["resume=true", f"run={folder / second[0]}"])  # alone, beside its sweep
    assert records(folder)[second[0]]["status"] == "finished"


@pytest.mark.slow
def test_killed_in_the_middle_and_started_again(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    line = [*small(patch_file), "ablation=loss_terms", "scale=small", "setting=default,loss_terms/cd", "seed=0"]
    # longer than `small`, with a checkpoint at each step, so that it can be killed within the second job
    line += ["data.batch_size=2", "data.augmentation=null", "trainer.max_steps=8", "trainer.max_epochs=-1"]
    line += ["callbacks.checkpoints.every_n_steps=1", "trainer.val_check_interval=4", "sweep=s"]
    folder = tmp_path / "outputs" / "sweeps" / "s"
    process = subprocess.Popen([sys.executable, "-m", "pnu.train", *line], stdout=subprocess.DEVNULL, cwd=tmp_path)
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline:
        checkpoints = list(folder.glob("cd_*/checkpoints/last.ckpt"))
        if checkpoints or process.poll() is not None:
            break
        time.sleep(0.02)
    process.kill()
    assert process.wait() == -9, "it ended before it could be killed"
    states = {name.partition("_")[0]: record["status"] for name, record in records(folder).items()}
    assert states == {"default": "finished", "cd": "running"}
    finished = next(record for record in records(folder).values() if record["status"] == "finished")

    main(line)
    assert capsys.readouterr().out.count("skipped") == 1
    after = records(folder)
    assert {record["status"] for record in after.values()} == {"finished"}
    assert finished in after.values()
    resumed = next(record for name, record in after.items() if name.startswith("cd"))
    assert len(resumed["resumed"]) == 1

    from pnu.commands.report import main as report

    report([f"sweep={folder}", "quiet=true"])
    text = (folder / "report" / "report.md").read_text()
    assert "2 settings, 1 seeds each, 2 finished runs" in text
    assert "have not finished" not in text


@pytest.mark.slow
def test_a_job_that_runs_is_left_alone(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from pnu.training.sweeps import locked

    monkeypatch.chdir(tmp_path)
    line = [*small(patch_file), "setting=default", "seed=0,1", "sweep=s"]
    main(line)
    folder = tmp_path / "outputs" / "sweeps" / "s"
    run = next(folder.glob("seed-0*"))
    before = (run / "metrics.json").stat().st_mtime_ns
    write_json(run / "run.json", read_json(run / "run.json") | {"status": "running"})
    capsys.readouterr()
    descriptor = locked(run)
    main(line)
    os.close(descriptor)
    captured = capsys.readouterr()
    assert captured.err == ""
    assert f"{run.relative_to(tmp_path)}: another process runs it, left alone" in captured.out
    assert captured.out.count("skipped") == 1
    assert "(1 running, 1 finished)" in captured.out
    assert (run / "metrics.json").stat().st_mtime_ns == before


# --- failures ---


@pytest.mark.slow
@pytest.mark.usefixtures("untraced")
def test_a_failing_job_is_told_at_once_and_the_others_go_on(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main([*small(patch_file), "optimizer.lr=1e30,1e-3", "sweep=s"])
    assert stopped.value.code == 1
    captured = capsys.readouterr()
    assert re.search(r"^job 0 \(optimizer.lr=1e\+?30\) failed: .*(finite|NaN|inf)", captured.err, re.M)
    assert captured.err.count("\n") == 1  # Hydra does not tell it again
    assert "(1 failed, 1 finished)" in captured.out
    states = [record["status"] for record in records(tmp_path / "outputs/sweeps/s").values()]
    assert sorted(states) == ["failed", "finished"]

    from pnu.commands.report import main as report

    report(["sweep=outputs/sweeps/s"])
    assert "1 unfinished" in capsys.readouterr().out
    assert re.search(
        r"optimizer.lr-1e\+30_\w+: failed: \w+: ", (tmp_path / "outputs/sweeps/s/report/report.md").read_text()
    )


# --- Ctrl-C ---


def started(
    patch_file: Path,  # noqa: F811
    folder: Path,
    more: list[str],
    jobs: int,
) -> tuple[list[str], subprocess.Popen[str]]:
    """The line and the process of a sweep without end, as many jobs of which have written a checkpoint."""
    line = [*small(patch_file), "seed=0,1,2", "sweep=a sweep", "trainer.max_steps=-1", "trainer.max_epochs=100000"]
    line += ["trainer.val_check_interval=1000", "callbacks.checkpoints.every_n_steps=1", *more]
    process = subprocess.Popen(
        [sys.executable, "-m", "pnu.train", *line],
        **{"cwd": folder, "env": {**os.environ, "OMP_NUM_THREADS": "1"}, "text": True, "start_new_session": True},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    while len(list(folder.glob("outputs/sweeps/*/*/checkpoints/last.ckpt"))) < jobs and process.poll() is None:
        time.sleep(0.05)
    return line, process


@pytest.mark.slow
@pytest.mark.usefixtures("untraced")
@pytest.mark.parametrize("launcher", ["basic", "joblib"])
@pytest.mark.parametrize("whom", ["all", "first"])
def test_interrupted_with_a_launcher(launcher: str, whom: str, patch_file: Path, tmp_path: Path) -> None:  # noqa: F811
    """Ctrl-C reaches all processes of a terminal, `kill -INT` the first alone: no traceback, a summary, the line to go
    on with, exit code 130, and no job that runs for ever."""
    more, jobs = [], 1
    if launcher == "joblib":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
        more, jobs = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"], 2
    line, process = started(patch_file, tmp_path, more, jobs)
    folder = tmp_path / "outputs" / "sweeps" / "a sweep"
    (os.killpg if whom == "all" else os.kill)(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert out == (
        f"\nsweep folder: outputs/sweeps/a sweep ({jobs} interrupted)\nnext: python -m pnu.train {shlex.join(line)}\n"
    )
    assert err == f"stopped; go on with: python -m pnu.train {shlex.join(line)}\n"
    found = records(folder).values()
    assert [(record["status"], record["error"]) for record in found] == [("failed", "interrupted")] * jobs


@pytest.mark.slow
@pytest.mark.usefixtures("untraced")
@pytest.mark.parametrize("whom", ["all", "first"])
def test_interrupted_with_submitit(whom: str, patch_file: Path, tmp_path: Path) -> None:  # noqa: F811
    """Ctrl-C ends its jobs too, though its own processes print tracebacks; after `kill -INT` of the first process they
    run on, as on a cluster, and the summary says so."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    more = ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10"]
    line, process = started(patch_file, tmp_path, more, jobs=3)
    (os.killpg if whom == "all" else os.kill)(process.pid, signal.SIGINT)
    try:
        assert process.wait(timeout=300) == 130
    finally:
        if whom == "first":
            os.killpg(process.pid, signal.SIGKILL)
    out, err = process.communicate(timeout=300)
    state = "interrupted" if whom == "all" else "running"
    assert out == f"\nsweep folder: outputs/sweeps/a sweep (3 {state})\nnext: python -m pnu.train {shlex.join(line)}\n"
    assert f"stopped; go on with: python -m pnu.train {shlex.join(line)}\n" in err
    found = records(tmp_path / "outputs" / "sweeps" / "a sweep").values()
    expected = ("failed", "interrupted") if whom == "all" else ("running", None)
    assert [(record["status"], record.get("error")) for record in found] == [expected] * 3


def test_a_job_whose_process_is_gone_does_not_run(tmp_path: Path) -> None:
    from pnu.training.sweeps import closing_line, locked, record_interruptions, state

    run = RunFolder(tmp_path / "default_1")
    run.path.mkdir()
    write_json(run.record_path, {"status": "running", "host": platform.node()})
    lock = locked(run.path)
    assert state(run) == "running"
    record_interruptions(tmp_path, patience=0)
    assert run.read_record()["status"] == "running"
    os.close(lock)
    assert state(run) == "interrupted"
    assert "(1 interrupted)" in closing_line(tmp_path)
    record_interruptions(tmp_path)
    assert (run.read_record()["status"], run.read_record()["error"]) == ("failed", "interrupted")
    write_json(run.record_path, {"status": "running", "host": "elsewhere"})
    assert state(run) == "running"


# --- launchers and searches ---


@pytest.mark.slow
def test_launchers_give_the_same_bits(patch_file: Path, tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    launchers = {
        "basic": [],
        "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        "submitit": ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10"],
    }
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    line = [*small(patch_file), "setting=default,loss_terms/cd", "seed=0,1"]
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "pnu.train", *line, *more, f"sweep={name}"], cwd=tmp_path, env=environment
        )
        for name, more in launchers.items()
    ]
    assert [process.wait(timeout=500) for process in processes] == [0, 0, 0]
    found = {name: metrics(tmp_path / "outputs" / "sweeps" / name) for name in launchers}
    assert len(found["basic"]) == 4
    assert len({str(run["test"]) for run in found["basic"].values()}) == 4
    assert found["basic"] == found["joblib"] == found["submitit"]


@pytest.mark.slow
def test_a_search_goes_on_from_its_storage(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    import optuna
    from optuna.trial import TrialState

    monkeypatch.chdir(tmp_path)
    line = [*small(patch_file), "hparams_search=loss_weights", "sweep=s"]
    main([*line, "hydra.sweeper.n_trials=1"])
    folder = tmp_path / "outputs" / "sweeps" / "s"
    (first,) = records(folder)
    study = optuna.load_study(study_name="loss_weights", storage=f"sqlite:///{folder}/optuna.db")
    (trial,) = study.trials
    validation = next(iter(metrics(folder).values()))["validation"]
    assert trial.values == [validation["chamfer_sq"], validation["normal_deg"]]
    # a trial that a power cut ended: asked for, never told
    lost = study.ask()
    spaces = study.trials[0].distributions
    values = {name: lost._suggest(name, space) for name, space in spaces.items()}
    main([*line, "hydra.sweeper.n_trials=2"])
    done = [t for t in study.trials if t.state == TrialState.COMPLETE]
    assert len(done) == 2
    assert done[1].params == values
    assert len(records(folder)) == 2
    assert first in records(folder)
    before = records(folder)
    main([*line, "hydra.sweeper.n_trials=2"])
    assert records(folder) == before
    front = yaml.safe_load((folder / "optimization_results.yaml").read_text())["solutions"]
    assert 1 <= len(front) <= 2


def test_what_is_left_of_a_search(tmp_path: Path) -> None:
    """Ended trials count, one that was interrupted comes again with its values, the seed moves on."""
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    import optuna
    from omegaconf import OmegaConf

    from pnu.training.optuna_search import search_arguments

    storage = f"sqlite:///{tmp_path}/optuna.db"
    sweeper = {
        "_target_": "OptunaSweeper",
        "storage": storage,
        "study_name": "s",
        "n_trials": 5,
        "sampler": {"seed": 7},
    }
    hydra = OmegaConf.create({"sweeper": sweeper})
    assert search_arguments(hydra) == [], "nothing has begun"
    study = optuna.create_study(storage=storage, study_name="s")
    for value in (1.0, 2.0):
        trial = study.ask()
        trial.suggest_float("lr", 0, 1)
        study.tell(trial, value)
    lost = study.ask()
    lost.suggest_float("lr", 0, 1)
    assert search_arguments(hydra) == ["hydra.sweeper.n_trials=3", "hydra.sweeper.sampler.seed=9"]
    study = optuna.load_study(storage=storage, study_name="s")
    assert study.trials[2].state == optuna.trial.TrialState.FAIL
    assert study.ask().suggest_float("lr", 0, 1) == lost.params["lr"]
    assert search_arguments(OmegaConf.create({"sweeper": {"_target_": "BasicSweeper"}})) == []


@pytest.mark.slow
def test_a_search_needs_its_metric(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main([*small(patch_file), "objective=[cd]", "seed=0,1"])
    assert "objective=['cd']: expected some of chamfer_sq, " in capsys.readouterr().err
