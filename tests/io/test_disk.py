"""A full disk and a read-only folder: one clear line, nothing half-written, and what was there stays usable."""

import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from pnu.networks import build_network, checkpoints
from pnu.networks.checkpoints import read_checkpoint
from tests.training.test_cli import small  # noqa: F401  a fixture

PNU = {"_target_": "pnu.networks.pnu.PNU", "ratio": 2, "local_features": False}
WRITERS = """
import functools, sys, torch
from pathlib import Path
from pnu import io, weights
from pnu.data import patch_file, shapes
from pnu.networks import checkpoints
state = {"x": torch.zeros(100_000)}
writers = {
    "c.ckpt": lambda path: checkpoints.write_checkpoint(path, {"state_dict": state}),
    "w.safetensors": lambda path: weights.write(path, {}, state),
    "p.h5": lambda path: patch_file.cut_patch_file(path, {"mug": functools.partial(shapes.make, "mug")}, 2),
    "run": lambda path: checkpoints.save(path, torch.nn.Linear(300, 300), {}, {}),
    **{f"c{suffix}": lambda path: io.write_cloud(path, torch.rand(9000, 3).numpy()) for suffix in io.OUTPUT_SUFFIXES},
    **{f"m{suffix}": lambda path: io.write_mesh(path, shapes.make("mug")) for suffix in io.MESH_OUTPUTS},
}
torch.nn.Linear.ratio = 1
for name, write in writers.items():
    try:
        write(Path(name))
    except ValueError as error:
        assert "\\n" not in str(error), error
        assert name in str(error) and "cannot be written (" in str(error), error
    else:
        print(name, "was written")
"""


def quota(size: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def command(folder: Path, *line: str, size: int | None = None) -> subprocess.CompletedProcess[str]:
    limit = {"preexec_fn": quota(size)} if size else {}
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    arguments = [sys.executable, *line]
    return subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, **limit)  # type: ignore[call-overload]


def refused(done: subprocess.CompletedProcess[str], reason: str) -> None:
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert reason in line


@pytest.mark.slow
@pytest.mark.usefixtures("untraced")
def test_every_writer_sees_that_the_disk_is_full(tmp_path: Path) -> None:
    """A limit on the size of a file stands for the disk; 2 kB are less than any of these files."""
    done = command(tmp_path, "-c", WRITERS, size=2000)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 48 MB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=48m", "none", str(folder)]
    if os.geteuid() or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("needs the right to mount a tmpfs")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def place(disk: Path) -> Path:
    """With a cloud and a run folder."""
    points = np.random.default_rng(0).normal(size=(500, 3))
    np.savetxt(disk / "cloud.xyz", points / np.linalg.norm(points, axis=1, keepdims=True))
    checkpoints.save(disk / "run", build_network(PNU), PNU, {})
    return disk


def fill(disk: Path, left: int) -> Path:
    free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
    (disk / "filler").write_bytes(bytes(max(free - left, 0)))
    return disk / "filler"


def listing(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


MEASURED = ("shapes=[mug]", "kinds=[uniform]", "points=300", "truth_points=600")
COMMANDS = {
    "upsample": ("input=cloud.xyz", "output=dense.ply", "run=surface"),
    "export": ("run=run", "output=weights.safetensors"),
    "evaluate": ("method=midpoint", *MEASURED),
    "prepare": ("data.patches=91",),
    "picture": ("inputs=[cloud.xyz]", "output=figure.png", "size=64"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_commands(name: str, place: Path) -> None:
    line = ["-m", f"pnu.commands.{name}", *COMMANDS[name], "quiet=true"]
    filler = fill(place, 0)
    before = listing(place)
    refused(command(place, *line), "No space left on device")
    assert listing(place) == before
    subprocess.run(["mount", "-o", "remount,ro", str(place)], check=True)
    done = command(place, *line)
    refused(done, "cannot be written to" if "cannot" in done.stderr else "Read-only file system")
    subprocess.run(["mount", "-o", "remount,rw", str(place)], check=True)
    filler.unlink()
    assert not list(place.rglob(".*")), "a temporary file was left"


@pytest.mark.slow
def test_training(disk: Path, small: list[str]) -> None:  # noqa: F811
    options = [*small, "model.local_features=false", "callbacks.checkpoints.every_n_steps=1", "quiet=true"]
    options += ["trainer.max_epochs=-1", "trainer.max_steps=4", "trainer.val_check_interval=2"]
    options += ["trainer.check_val_every_n_epoch=null"]
    first = [*options[:-3], "trainer.max_steps=2", *options[-2:]]
    assert command(disk, "-m", "pnu.train", *first, "run=run").returncode == 0
    last = disk / "run/checkpoints/last.ckpt"
    filler = fill(disk, 500_000)  # enough for all but a checkpoint
    resumed = ["-m", "pnu.train", "resume=true", "run=run", "trainer.max_steps=4", "quiet=true"]
    refused(command(disk, *resumed), "last.ckpt: cannot be written (No space left on device); free space or choose")
    assert read_checkpoint(last)["global_step"] == 2
    assert '"status": "failed"' in (disk / "run/run.json").read_text()
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    refused(command(disk, *resumed), "cannot be written to")
    refused(command(disk, "-m", "pnu.train", *options), "Read-only file system")
    refused(command(disk, "-m", "pnu.train", "-m", *options, "loss.w3=0,1"), "Read-only file system")
    subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
    filler.unlink()
    assert command(disk, *resumed).returncode == 0
    assert command(disk.parent, "-m", "pnu.train", *first, "run=run").returncode == 0
    assert command(disk.parent, *resumed).returncode == 0
    ours, theirs = read_checkpoint(last), read_checkpoint(disk.parent / "run/checkpoints/last.ckpt")
    assert ours["global_step"] == 4
    assert all(torch.equal(ours["state_dict"][name], value) for name, value in theirs["state_dict"].items())
