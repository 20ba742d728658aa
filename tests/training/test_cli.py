"""`python -m pnu.train` as people type it, in processes of its own."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pnu.commands.train import main
from pnu.commands.upsample import main as upsample
from pnu.networks.checkpoints import read_checkpoint
from pnu.training import resuming
from tests.refusals import refused

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Overrides that make a training small: 20 patches of four spheres, 256 points each."""
    path = tmp_path_factory.mktemp("data") / "spheres.h5"
    ball = np.random.default_rng(0).normal(size=(20, 256, 3)).astype(np.float32)
    ball /= np.linalg.norm(ball, axis=-1, keepdims=True)
    with h5py.File(path, "w") as file:
        file["poisson_4096"] = np.concatenate([ball, ball], -1)
        file["name"] = np.array([f"sphere_{i % 4}" for i in range(20)], dtype=h5py.string_dtype())
    options = ["data=patches", f"data.path={path}", "data.input_points=64", "data.target_points=256"]
    return [*options, "data.batch_size=2", "trainer.accelerator=cpu", "callbacks.pictures.clouds=0"]


def start(folder: Path, *arguments: str, **options: str) -> subprocess.Popen[str]:
    environment = os.environ | {"OMP_NUM_THREADS": "1"} | options
    command = [sys.executable, "-m", "pnu.train", *arguments]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True)


def train(folder: Path, *arguments: str, **options: str) -> subprocess.CompletedProcess[str]:
    process = start(folder, *arguments, **options)
    out, err = process.communicate(timeout=300)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def jobs(folder: Path) -> list[Path]:
    """The run folders of the sweeps below a folder."""
    return sorted(path.parent for path in folder.glob("outputs/sweeps/**/run.json"))


def loaded_by(*arguments: str) -> set[str]:
    """Top-level modules that a command has imported when it ends."""
    code = (
        "import sys, atexit; atexit.register(lambda: print('MODULES', *{m.split('.')[0] for m in sys.modules}));"
        f"from pnu.commands.train import main; main({list(arguments)!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return set(done.stdout.rpartition("MODULES")[2].split())


HEAVY = {"torch", "lightning", "open3d", "tensorboard", "torchmetrics", "scipy", "h5py"}


@pytest.mark.parametrize("arguments", [["--help"], ["loss.w9=1"], ["-m", "loss.w9=0,1"], ["model=foo"]])
def test_help_and_mistakes_are_answered_before_anything_heavy(arguments: list[str]) -> None:
    loaded = loaded_by(*arguments)
    assert "omegaconf" in loaded
    assert not loaded & HEAVY


def test_help_tells_every_key_with_its_value(tmp_path: Path) -> None:
    done = train(tmp_path, "--help", "loss.w3=0.25")
    assert done.returncode == 0
    assert "loss.w3=0.25" in done.stdout
    assert "trainer.max_epochs=500" in done.stdout
    assert "model=" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["run=run"],
        ["experiment=surface", "data.root=null", "run=run", "model.width=8", "callbacks=[default,ema]"],
        ["scale=small", "hydra.run.dir=run", "quiet=true", "data=patches", "data.path=a.h5"],
    ],
)
def test_cfg_prints_the_config_that_the_run_folder_has(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    main([*arguments, "--cfg", "job", "--resolve"])
    printed = capsys.readouterr().out
    main(["--cfg", "job", *arguments])
    written = capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []

    real = resuming.open_run

    def opened(*given: Any) -> Any:
        real(*given)
        raise ValueError("that is enough")

    monkeypatch.setattr("pnu.training.resuming.open_run", opened)
    refused(capsys, main, arguments)
    assert printed == (tmp_path / "run" / "config.yaml").read_text()
    # without --resolve, references stay as conf/ writes them, beside the values that constructors fill in
    assert "seed: ${seed}" in written
    found, filled = yaml.safe_load(written), yaml.safe_load(printed)
    references = [key for group in ("data", "scheduler") for key, v in found[group].items() if "${" in str(v)]
    assert references
    assert found["model"] == filled["model"]
    assert found["data"] | {key: filled["data"][key] for key in references if key in filled["data"]} == filled["data"]


def test_cfg_prints_a_part_of_the_config(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--cfg", "job", "--package", "loss", "loss.k=7"])
    out = capsys.readouterr().out
    assert out.startswith("# @package loss\n")
    assert "k: 7\n" in out
    assert "reduction: mean\n" in out  # of the constructor
    main(["--cfg", "job", "--package", "loss.k"])
    assert capsys.readouterr().out == "15\n"
    assert "package nothing: " in refused(capsys, main, ["--cfg", "job", "--package", "nothing"])
    main(["--cfg", "hydra", "--package", "hydra.job"])
    assert "name: train" in capsys.readouterr().out
    assert "loss.k=many: expected int" in refused(capsys, main, ["--cfg", "job", "loss.k=many"])
    upsample(["--cfg", "job"])  # what is still to be given stays so
    assert "input: ???\n" in capsys.readouterr().out


def test_help_tells_the_keys_of_a_command_before_those_of_groups() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pnu", "evaluate", "--help"], capture_output=True, text=True, check=True
    )
    assert done.stdout.index("truth_points=") < done.stdout.index("data.val_share=")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["loss.w9=1"], "error: unknown key 'loss.w9': did you mean 'loss.w"),
        (["-m", "loss.w9=0,1"], "error: unknown key 'loss.w9': did you mean 'loss.w"),
        (["-m", "loss.w1=0,x"], "error: loss.w1=x: expected float ("),
        (["-m", "model=pnu,foo"], "error: model=foo: expected one of "),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(tmp_path: Path, arguments: list[str], message: str) -> None:
    done = train(tmp_path, *arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith(message)
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_one_line_trains(tmp_path: Path, small: list[str]) -> None:
    done = train(tmp_path, *small, "loss.w3=0.05", "trainer.max_steps=20")
    assert (done.returncode, done.stderr) == (0, "")
    (run,) = tmp_path.glob("outputs/*/*_train")
    assert f"next: pnu upsample input=cloud.ply output=dense.ply run={run.relative_to(tmp_path)}" in done.stdout
    assert "CD x 1e3" in done.stdout
    assert read_checkpoint(run / "checkpoints/last.ckpt")["global_step"] == 20


@pytest.mark.slow
def test_a_multirun_leaves_a_complete_folder_for_each_value(tmp_path: Path, small: list[str]) -> None:
    done = train(tmp_path, *small, "-m", "loss.w3=0,0.05", "trainer.max_steps=5", "quiet=true")
    assert (done.returncode, done.stderr) == (0, "")
    runs = jobs(tmp_path)
    weights = [float(re.search(r"w3: (.*)", (run / "config.yaml").read_text())[1]) for run in runs]  # type: ignore[index]
    assert sorted(weights) == [0, 0.05]
    for run in runs:
        assert json.loads((run / "run.json").read_text())["status"] == "finished"
        assert set(json.loads((run / "metrics.json").read_text())) == {"untrained", "validation", "test"}
        assert (run / "checkpoints/best.ckpt").exists()
        assert list((run / "tensorboard").glob("events*"))
    first, second = (read_checkpoint(run / "checkpoints/last.ckpt")["state_dict"] for run in runs)
    assert any(not torch.equal(first[name], second[name]) for name in first)


@pytest.mark.usefixtures("untraced")
@pytest.mark.slow
def test_a_failed_job_leaves_the_others_and_a_record(tmp_path: Path, small: list[str]) -> None:
    done = train(tmp_path, *small, "-m", "model.ratio=3,4", "trainer.max_steps=1", "quiet=true")
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    records = [json.loads((run / "run.json").read_text()) for run in jobs(tmp_path)]
    assert sorted(record["status"] for record in records) == ["failed", "finished"]
    assert "model.ratio" in next(record["error"] for record in records if record["status"] == "failed")


@pytest.mark.slow
def test_killed_and_resumed_as_if_never_stopped(tmp_path: Path, small: list[str]) -> None:
    options = [*small, "callbacks.checkpoints.every_n_steps=1", "trainer.max_epochs=6", "quiet=true"]
    options += ["model.local_features=false"]
    process = start(tmp_path, *options, f"run={tmp_path / 'killed'}")
    last = tmp_path / "killed/checkpoints/last.ckpt"
    while not last.exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(0.2)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "it ended before it could be killed"
    assert json.loads((tmp_path / "killed/run.json").read_text())["status"] == "running"
    stopped_at = read_checkpoint(last)["global_step"]
    assert train(tmp_path, f"run={tmp_path / 'killed'}", "resume=true", "quiet=true").returncode == 0
    assert train(tmp_path, *options, f"run={tmp_path / 'whole'}").returncode == 0
    killed, whole = (read_checkpoint(tmp_path / name / "checkpoints/last.ckpt") for name in ("killed", "whole"))
    assert 0 < stopped_at < killed["global_step"] == whole["global_step"] == 30
    assert all(torch.equal(killed["state_dict"][name], value) for name, value in whole["state_dict"].items())
    assert json.loads((tmp_path / "killed/run.json").read_text())["status"] == "finished"
    assert not list((tmp_path / "killed").rglob(".*")), "a temporary file was left"


@pytest.mark.usefixtures("untraced")
@pytest.mark.slow
def test_interrupted_by_hand(tmp_path: Path, small: list[str]) -> None:
    """Ctrl-C: the record says so, and the last line how to go on."""
    process = start(tmp_path, *small, "callbacks.checkpoints.every_n_steps=1", f"run={tmp_path / 'run'}")
    while not (tmp_path / "run/checkpoints/last.ckpt").exists() and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert err.strip().splitlines()[-1] == f"stopped; go on with: pnu train resume=true run={tmp_path / 'run'}"
    assert json.loads((tmp_path / "run/run.json").read_text())["error"] == "interrupted"


def curve(run: Path) -> list[float]:
    """The loss at every step, from TensorBoard."""
    return [event.value for event in EventAccumulator(str(run / "tensorboard")).Reload().Scalars("train/loss")]


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path: Path, small: list[str]) -> None:
    """Half the batch in each of two processes: the same steps, to rounding."""
    line = [*small, "trainer.max_epochs=3", "trainer.precision=64-true", "quiet=true"]
    for name, options in {
        "one": ["data.batch_size=4"],
        "two": ["trainer.devices=2", "trainer.strategy=ddp", "trainer.sync_batchnorm=true"],
    }.items():
        done = train(tmp_path, *line, *options, f"run={tmp_path / name}")
        assert done.returncode == 0, done.stderr
        assert json.loads((tmp_path / name / "run.json").read_text())["status"] == "finished"
    one, two = curve(tmp_path / "one"), curve(tmp_path / "two")
    assert len(one) == 6  # 10 patches, two batches of 4 in an epoch
    assert one[-1] < 0.9 * one[0]
    np.testing.assert_allclose(two, one, rtol=1e-4)
    np.testing.assert_allclose(two[0], one[0], rtol=1e-6)


@pytest.mark.slow
def test_nodes_of_slurm_train_as_one(tmp_path: Path, small: list[str]) -> None:
    """Two nodes, as far as SLURM's variables tell: the losses of two processes of one machine."""
    line = [*small, "trainer.max_epochs=2", "trainer.precision=64-true", "quiet=true", "trainer.sync_batchnorm=true"]
    job = {"SLURM_JOB_ID": str(os.getpid()), "SLURM_JOB_NAME": "pnu", "SLURM_NTASKS": "2", "SLURM_NNODES": "2"}
    job |= {"SLURM_NTASKS_PER_NODE": "1", "SLURM_NODELIST": "127.0.0.1", "SLURM_LOCALID": "0"}
    nodes = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=1", "trainer.num_nodes=2"]
    tasks = [
        start(tmp_path, *line, *nodes, f"run={tmp_path / 'slurm'}", **job, SLURM_PROCID=rank, SLURM_NODEID=rank)
        for rank in "01"
    ]
    try:
        for task in tasks:
            error = task.communicate(timeout=600)[1]
            assert task.returncode == 0, error
    finally:
        for task in tasks:  # one that has failed leaves the other waiting
            task.kill()
            task.communicate()
    together = ["trainer.devices=2", "trainer.strategy=ddp", f"run={tmp_path / 'two'}"]
    assert train(tmp_path, *line, *together).returncode == 0
    np.testing.assert_allclose(curve(tmp_path / "slurm"), curve(tmp_path / "two"), rtol=1e-6)
