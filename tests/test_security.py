"""Files from strangers: nothing that they hold is run."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import yaml

import pnu
from pnu import checkpoint
from pnu.data import patchset
from pnu.models import build

PNU = {"_target_": "pnu.models.pnu.PNU", "ratio": 2, "local_features": False}
Attack = Callable[[Path, Path], None]


class Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.mark),)


def target(name: str) -> Attack:
    def attack(run: Path, mark: Path) -> None:
        command = f"import os; os.mkdir({str(mark)!r})" if name.endswith("exec") else f"mkdir {mark}"
        config = {"model": {"_target_": name, "command": command, "path": str(mark), "_args_": [command]}}
        (run / "config.yaml").write_text(yaml.safe_dump(config))

    return attack


def tag(run: Path, mark: Path) -> None:
    (run / "config.yaml").write_text(f"model: !!python/object/apply:os.mkdir ['{mark}']")


def pickled(run: Path, mark: Path) -> None:
    torch.save({"state_dict": {"model.weight": Evil(mark)}}, run / "checkpoints/best.ckpt")


ATTACKS = {
    "os.system": target("os.system"),
    "os.mkdir": target("os.mkdir"),
    "builtins.exec": target("builtins.exec"),
    "subprocess.Popen": target("subprocess.Popen"),
    "another package of that prefix": target("pnu.models_evil.Network"),
    "what a module of ours imports": target("pnu.models.layers.torch.os.system"),
    "a class that a module of ours imports": target("pnu.models.layers.nn.Module"),
    "YAML tag": tag,
    "pickle": pickled,
}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    checkpoint.save(tmp_path / "run", build(PNU), PNU, {})
    return tmp_path / "run"


def upsample(run: Path) -> subprocess.CompletedProcess[str]:
    points = np.random.default_rng(0).normal(size=(100, 3))
    np.savetxt(run.parent / "cloud.xyz", points / np.linalg.norm(points, axis=1, keepdims=True))
    command = [sys.executable, "-m", "pnu.upsample", "input=cloud.xyz", "output=dense.xyz", f"run={run}", "ratio=2"]
    return subprocess.run(command, cwd=run.parent, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ATTACKS)
def test_load_runs_nothing(run: Path, name: str) -> None:
    mark = run.parent / "mark"
    ATTACKS[name](run, mark)
    with pytest.raises(ValueError, match=r"config.yaml|best.ckpt|model._target_") as error:
        pnu.load(run)
    assert "\n" not in str(error.value)
    assert not mark.exists()


def test_the_pickle_would_have_run(run: Path) -> None:
    """The attack is a real one: read without care, it makes the folder."""
    mark = run.parent / "mark"
    pickled(run, mark)
    torch.load(run / "checkpoints/best.ckpt", weights_only=False)
    assert mark.is_dir()


@pytest.mark.parametrize("name", ["os.mkdir", "pickle"])
def test_upsample_runs_nothing(run: Path, name: str) -> None:
    ATTACKS[name](run, run.parent / "mark")
    done = upsample(run)
    assert done.returncode == 2, done.stderr
    assert [line for line in done.stderr.splitlines() if line.startswith("error: ")] == done.stderr.splitlines()
    assert {path.name for path in run.parent.iterdir()} == {"run", "cloud.xyz"}


def test_npy_is_read_without_pickle(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    np.save(tmp_path / "cloud.npy", np.array([Evil(mark)] * 20, dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"cloud\.npy"):
        pnu.io.read_cloud(tmp_path / "cloud.npy")
    assert not mark.exists()


@pytest.mark.parametrize("kind", ["link", "storage", "virtual"])
def test_a_patch_file_reads_no_other_file(tmp_path: Path, kind: str) -> None:
    cloud = np.zeros((2, 64, 6), np.float32)
    cloud[..., 3] = 1
    with h5py.File(tmp_path / "private.h5", "w") as file:
        file["poisson_4096"] = cloud
    cloud.tofile(tmp_path / "private.bin")
    with h5py.File(tmp_path / "patches.h5", "w") as file:
        file["padding"] = np.zeros(100_000, np.uint8)
        if kind == "link":
            file["poisson_4096"] = h5py.ExternalLink("private.h5", "poisson_4096")
        elif kind == "storage":
            stored = [(str(tmp_path / "private.bin"), 0, cloud.nbytes)]
            file.create_dataset("poisson_4096", cloud.shape, cloud.dtype, external=stored)
        else:
            layout = h5py.VirtualLayout(cloud.shape, cloud.dtype)
            layout[...] = h5py.VirtualSource(tmp_path / "private.h5", "poisson_4096", cloud.shape)
            file.create_virtual_dataset("poisson_4096", layout)
    with pytest.raises(ValueError, match=r"patches\.h5: poisson_4096 lies in another file"):
        patchset.check(tmp_path / "patches.h5")
