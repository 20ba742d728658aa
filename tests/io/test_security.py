"""Files from strangers: nothing that they hold is run."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import yaml

import pnu.io
from pnu.commands import evaluate
from pnu.data import patch_file, shapes
from pnu.networks import build_network, checkpoints
from tests.refusals import refused

PNU = {"_target_": "pnu.networks.pnu.PNU", "ratio": 2, "local_features": False}
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


def argument(key: str, value: Callable[[Path], object]) -> Attack:
    """A network of ours with an argument that Hydra would run or resolve."""

    def attack(run: Path, mark: Path) -> None:
        (run / "config.yaml").write_text(yaml.safe_dump({"model": PNU | {key: value(mark)}}))

    return attack


def mkdir(mark: Path) -> dict[str, object]:
    return {"_target_": "os.mkdir", "_args_": [str(mark)], "_partial_": False}


def tag(run: Path, mark: Path) -> None:
    (run / "config.yaml").write_text(f"model: !!python/object/apply:os.mkdir ['{mark}']")


def pickled(run: Path, mark: Path) -> None:
    torch.save({"state_dict": {"model.weight": Evil(mark)}}, run / "checkpoints/best.ckpt")


ATTACKS = {
    "os.system": target("os.system"),
    "os.mkdir": target("os.mkdir"),
    "builtins.exec": target("builtins.exec"),
    "subprocess.Popen": target("subprocess.Popen"),
    "another package of that prefix": target("pnu.networks_evil.Network"),
    "what a module of ours imports": target("pnu.networks.layers.torch.os.system"),
    "a class that a module of ours imports": target("pnu.networks.layers.nn.Module"),
    "a class among the arguments": argument("ratio", mkdir),
    "a class among arguments that no network has": argument("more", mkdir),
    "a call that waits for arguments": argument("_partial_", lambda mark: True),
    "a variable of the environment": argument("ratio", lambda mark: "${oc.env:HOME}"),
    "YAML tag": tag,
    "pickle": pickled,
}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    checkpoints.save(tmp_path / "run", build_network(PNU), PNU, {})
    return tmp_path / "run"


def upsample(run: Path) -> subprocess.CompletedProcess[str]:
    points = np.random.default_rng(0).normal(size=(100, 3))
    np.savetxt(run.parent / "cloud.xyz", points / np.linalg.norm(points, axis=1, keepdims=True))
    command = [sys.executable, "-m", "pnu", "upsample", "input=cloud.xyz", "output=dense.xyz", f"run={run}", "ratio=2"]
    return subprocess.run(command, cwd=run.parent, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ATTACKS)
def test_load_runs_nothing(run: Path, name: str) -> None:
    mark = run.parent / "mark"
    ATTACKS[name](run, mark)
    with pytest.raises(ValueError, match=r"config.yaml|best.ckpt|^model") as error:
        pnu.load(run)
    assert "\n" not in str(error.value)
    assert not mark.exists()


def test_the_pickle_would_have_run(run: Path) -> None:
    """The attack is a real one: read without care, it makes the folder."""
    mark = run.parent / "mark"
    pickled(run, mark)
    torch.load(run / "checkpoints/best.ckpt", weights_only=False)
    assert mark.is_dir()


@pytest.mark.parametrize("name", ["os.mkdir", pytest.param("pickle", marks=pytest.mark.slow)])
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


def test_what_belongs_to_other_commands_is_left_alone(run: Path) -> None:
    """Groups beside the network's: trainings are not built, Hydra is not set up."""
    evil = mkdir(run.parent / "mark")
    config = yaml.safe_load((run / "config.yaml").read_text())
    config |= {"hydra": {"launcher": evil, "callbacks": {"evil": evil}}, "callbacks": {"evil": evil}, "trainer": evil}
    (run / "config.yaml").write_text(yaml.safe_dump(config | {"optimizer": evil | {"_partial_": True}}))
    assert pnu.load(run).ratio == 2
    assert not (run.parent / "mark").exists()


@pytest.fixture
def trap(tmp_path: Path) -> Iterator[Path]:
    """A name that, opened, waits for ever: for five seconds here."""

    def stop(*_: object) -> None:
        raise TimeoutError("the other file was opened")

    os.mkfifo(tmp_path / "trap")
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(5)
    yield tmp_path / "trap"
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("kind", ["link", "soft", "storage", "virtual", "aside"])
def test_a_patch_file_opens_no_other_file(tmp_path: Path, trap: Path, kind: str) -> None:
    cloud = np.tile(np.float32([0, 0, 0, 1, 0, 0]), (2, 64, 1))
    cloud[..., :3] = np.random.default_rng(0).random((2, 64, 3))
    with h5py.File(tmp_path / "patches.h5", "w") as file:
        file["padding"] = np.zeros(100_000, np.uint8)
        outside = h5py.ExternalLink(str(trap), "poisson_4096")
        if kind == "link":
            file["poisson_4096"] = outside
        elif kind == "soft":
            file["outside"], file["poisson_4096"] = outside, h5py.SoftLink("/outside")
        elif kind == "storage":
            file.create_dataset("poisson_4096", cloud.shape, cloud.dtype, external=[(str(trap), 0, cloud.nbytes)])
        elif kind == "virtual":
            layout = h5py.VirtualLayout(cloud.shape, cloud.dtype)
            layout[...] = h5py.VirtualSource(trap, "poisson_4096", cloud.shape)
            file.create_virtual_dataset("poisson_4096", layout)
        else:
            file["poisson_4096"], file["outside"] = cloud, outside
    if kind == "aside":
        assert "outside (a link)" in patch_file.describe(tmp_path / "patches.h5")["datasets"]
        return
    with pytest.raises(ValueError, match=r"patches\.h5: poisson_4096 is a link or lies in another file"):
        patch_file.check_patch_file(tmp_path / "patches.h5")


@pytest.mark.parametrize("name", ["mesh.obj", "mesh.ply"])
def test_a_mesh_opens_no_other_file(tmp_path: Path, trap: Path, name: str) -> None:
    """Materials and textures beside it, or anywhere."""
    mesh = shapes.make("mug")
    pnu.io.write_mesh(tmp_path / name, mesh)
    text = (tmp_path / name).read_bytes()
    if name == "mesh.obj":
        text = f"mtllib {trap}\ncall {trap}\nusemtl x\n".encode() + text
    else:
        text = text.replace(b"element vertex", f"comment TextureFile {trap}\nelement vertex".encode(), 1)
    (tmp_path / name).write_bytes(text)
    assert len(pnu.io.read_mesh(tmp_path / name).faces) == len(mesh.faces)


def test_results_stay_in_the_run_folder(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A stranger's run folder may hold links."""
    (run.parent / "private").mkdir()
    (run / "evaluation").symlink_to(run.parent / "private")
    line = [f"run={run}", "shapes=[mug]", "kinds=[uniform]", "points=64", "truth_points=150", "ratio=2"]
    assert "a link leads out of" in refused(capsys, evaluate.main, line)
    assert list((run.parent / "private").iterdir()) == []
