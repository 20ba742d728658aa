"""`kill -9` at random moments, and on with it: the result is that of a run that was never killed."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pnu.data import patch_file, shapes
from pnu.io import read_cloud, write_mesh
from pnu.networks.checkpoints import read_checkpoint
from tests.training.test_cli import small  # noqa: F401  a fixture

pytestmark = pytest.mark.slow
SEED = 20240607
Moment = Callable[[Path], bool]


def start(folder: Path, module: str, *arguments: str) -> subprocess.Popen[bytes]:
    """A command in a session of its own, so that what it leaves running can be found."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", f"pnu.commands.{module}", *arguments]
    with (folder / "log").open("ab") as log:
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True)


def finish(folder: Path, module: str, *arguments: str) -> None:
    assert start(folder, module, *arguments).wait(600) == 0, (folder / "log").read_text()[-2000:]


def killed(process: subprocess.Popen[bytes], moment: Callable[[], bool]) -> bool:
    """Kill a process at a moment; False if it ended before."""
    while not moment() and process.poll() is None:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    ended = process.wait() == 0
    deadline = time.monotonic() + 60  # a process that has just been started loads its modules first
    while (left := session(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.1)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left, "processes stay behind"
    return not ended


def session(leader: int) -> list[int]:
    """Processes of a session that are alive."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, number = stat.read_text().rpartition(")")[2].split()[:4]
        except (OSError, ValueError):
            continue
        if int(number) == leader and state != "Z":
            found.append(int(stat.parent.name))
    return found


def moments(folder: Path, rng: np.random.Generator, longest: float, writes: int = 8) -> Callable[[], bool]:
    """When to kill: after a random time, or after the first to eighth (`writes`) time that a file is being written (its
    temporary name is seen), at once or a little later."""
    began, seen, wait = time.monotonic(), set(), rng.random() * longest
    if rng.random() < 0.3:
        return lambda: time.monotonic() - began > wait
    number, later = int(rng.integers(1, writes + 1)), rng.choice([0.0, 0.0, 0.002, 0.05, 1.0])

    def moment() -> bool:
        for parent in (folder, folder / "checkpoints"):
            if parent.is_dir():
                seen.update(name for name in os.listdir(parent) if name.startswith("."))
        if len(seen) < number:
            return False
        time.sleep(later)
        return True

    return moment


def check_whole(run: Path) -> int:
    """Every file of a run folder that is there can be read; the step of its last checkpoint, or 0."""
    for path in run.glob("[!.]*.json"):
        json.loads(path.read_text())
    if (run / "config.yaml").exists():
        assert "model" in yaml.safe_load((run / "config.yaml").read_text())
    steps = [read_checkpoint(path)["global_step"] for path in sorted(run.glob("checkpoints/[!.]*.ckpt"))]
    return steps[-1] if (run / "checkpoints/last.ckpt").exists() else 0


def losses(run: Path) -> dict[int, float]:
    """The logged loss of each step; a step that is there twice has the same value."""
    values: dict[int, float] = {}
    events = EventAccumulator(str(run / "tensorboard"), {"scalars": 0})
    events.Reload()
    for event in events.Scalars("train/loss"):
        assert values.setdefault(event.step, event.value) == event.value
    return values


def equal(a: Any, b: Any) -> bool:
    """Whether two checkpoints hold the same bits; names of files and times aside."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b


KEPT = ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "epoch")


def test_training(tmp_path: Path, small: list[str]) -> None:  # noqa: F811
    rng = np.random.default_rng(SEED)
    options = [*small, "model.local_features=false", "callbacks.checkpoints.every_n_steps=1", "quiet=true"]
    options += ["trainer.max_steps=600", "trainer.max_epochs=-1", "trainer.val_check_interval=3"]
    options += ["trainer.check_val_every_n_epoch=null"]
    run, steps, kills = tmp_path / "killed", [0], 0
    while kills < 20:
        resumed = (run / "run.json").exists() and (run / "config.yaml").exists()
        process = start(tmp_path, "train", *(["resume=true"] if resumed else options), f"run={run}")
        assert killed(process, moments(run, rng, 5)), "it ended before it was killed 20 times"
        kills += 1
        steps.append(check_whole(run))
    assert steps == sorted(steps), "a step was lost"
    assert steps[-1] > 10
    finish(tmp_path, "train", "resume=true", f"run={run}")
    finish(tmp_path, "train", *options, f"run={tmp_path / 'whole'}")
    assert not [path for path in run.rglob(".*")], "a temporary file was left"
    for name in ("last", "best"):
        ours, theirs = (read_checkpoint(tmp_path / side / f"checkpoints/{name}.ckpt") for side in ("killed", "whole"))
        assert equal({key: ours.get(key) for key in KEPT}, {key: theirs.get(key) for key in KEPT}), name
    assert ours["global_step"] > 0
    assert (run / "metrics.json").read_text() == (tmp_path / "whole/metrics.json").read_text()
    assert losses(run) == losses(tmp_path / "whole")
    assert sorted(losses(run)) == list(range(600))


def test_prepare(tmp_path: Path) -> None:
    rng = np.random.default_rng(SEED)
    (tmp_path / "meshes").mkdir()
    for name in shapes.names()[:16]:  # more than eight: several processes
        write_mesh(tmp_path / "meshes" / f"{name}.ply", shapes.make(name))
    line = ["data=meshes", "data.root=meshes", "data.patches=16", "quiet=true"]
    kills = 0
    while kills < 5:
        kills += killed(start(tmp_path, "prepare", *line), moments(tmp_path / "data", rng, 6, writes=1))
        for path in (tmp_path / "data").glob("[!.]*"):
            patch_file.check_patch_file(path)
            path.unlink()
    finish(tmp_path, "prepare", *line)
    finish(tmp_path, "prepare", *line, "data.cache=whole")
    (ours,), (theirs,) = ([*(tmp_path / name).glob("[!.]*.h5")] for name in ("data", "whole"))
    with h5py.File(ours) as a, h5py.File(theirs) as b:
        assert a.keys() == b.keys()
        assert all(np.array_equal(a[name][()], b[name][()], equal_nan=a[name].dtype.kind == "f") for name in a)


def test_evaluate(tmp_path: Path) -> None:
    rng = np.random.default_rng(SEED)
    line = ["method=midpoint", "shapes=[mug]", "kinds=[uniform,random]", "points=500", "truth_points=2000"]
    line += ["save=true", "quiet=true", "output=out"]

    def values() -> list[dict]:
        return [
            {key: value for key, value in row.items() if key not in ("seconds", "peak_memory_mb")}
            for row in json.loads((tmp_path / "out/metrics.json").read_text())["rows"]
        ]

    finish(tmp_path, "evaluate", *line)
    whole = values()
    for _ in range(5):
        killed(start(tmp_path, "evaluate", *line), moments(tmp_path / "out", rng, 6, writes=2))
        assert values() == whole
        for cloud in (tmp_path / "out/clouds").glob("[!.]*"):
            assert len(read_cloud(cloud).points) == 2000
    finish(tmp_path, "evaluate", *line)
    assert values() == whole


def test_upsampling_a_large_cloud(tmp_path: Path) -> None:
    rng = np.random.default_rng(SEED)
    points = rng.normal(size=(30_000, 3))
    np.savetxt(tmp_path / "cloud.xyz", np.hstack([points / np.linalg.norm(points, axis=1, keepdims=True)] * 2))
    line = ["input=cloud.xyz", "run=surface", "ratio=2", "quiet=true"]
    finish(tmp_path, "upsample", *line, "output=whole.ply")
    began = time.monotonic()
    finish(tmp_path, "upsample", *line, "output=whole.ply")
    longest = time.monotonic() - began
    whole = (tmp_path / "whole.ply").read_bytes()
    (tmp_path / "dense.ply").write_bytes(b"from before")
    for _ in range(4):
        if killed(start(tmp_path, "upsample", *line, "output=dense.ply"), moments(tmp_path, rng, longest, writes=1)):
            assert (tmp_path / "dense.ply").read_bytes() in (b"from before", whole)
    finish(tmp_path, "upsample", *line, "output=dense.ply")
    assert (tmp_path / "dense.ply").read_bytes() == whole


def test_sweep(tmp_path: Path, small: list[str]) -> None:  # noqa: F811
    rng = np.random.default_rng(SEED)
    line = ["-m", *small, "model.local_features=false", "callbacks.checkpoints.every_n_steps=1", "quiet=true"]
    line += ["trainer.max_steps=40", "trainer.max_epochs=-1", "loss.w3=0,0.05"]
    for _ in range(6):
        process = start(tmp_path, "train", *line, "sweep=killed")
        current = tmp_path / "outputs/sweeps/killed"
        killed(process, moments(next(iter(current.glob("*w3=0.05*")), current / "x"), rng, 15))
        for run in current.glob("*/"):
            check_whole(run)
    finish(tmp_path, "train", *line, "sweep=killed")
    finish(tmp_path, "train", *line, "sweep=whole")
    sweeps = [
        sorted((tmp_path / "outputs/sweeps" / name).glob("*/checkpoints/last.ckpt")) for name in ("killed", "whole")
    ]
    assert len(sweeps[0]) == len(sweeps[1]) == 2
    for ours, theirs in zip(*sweeps, strict=True):
        assert equal(
            {key: read_checkpoint(ours)[key] for key in KEPT}, {key: read_checkpoint(theirs)[key] for key in KEPT}
        )
        assert json.loads((ours.parents[1] / "run.json").read_text())["status"] == "finished"
