"""Run folders: loading, finding, and what is refused."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import pnu
from pnu.io import read_json, write_json
from pnu.networks import checkpoints
from pnu.networks.pnu import PNU

MODEL = {"_target_": "pnu.networks.pnu.PNU", "ratio": 2, "local_features": False}


def network(seed: int = 0) -> PNU:
    torch.manual_seed(seed)
    return PNU(ratio=2, local_features=False).eval()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    checkpoints.save(tmp_path / "run", network(), MODEL, {"epoch": 3})
    return tmp_path / "run"


def test_round_trip(run: Path) -> None:
    loaded = pnu.load(str(run))
    assert not loaded.training
    patch = torch.randn(1, 64, 6)
    with torch.no_grad():
        assert torch.equal(loaded(patch), network()(patch))
    assert read_json(run / "run.json") == {"status": "finished", "ratio": 2, "epoch": 3}
    assert [path.name for path in run.parent.iterdir()] == ["run"]


def test_best_before_last(run: Path) -> None:
    state = {f"model.{name}": value for name, value in network(1).state_dict().items()}
    torch.save({"state_dict": {**state, "loss.scale": torch.ones(1)}}, run / "checkpoints" / "last.ckpt")
    assert torch.equal(pnu.load(run).head[0].linear.weight, network(0).head[0].linear.weight)
    (run / "checkpoints" / "best.ckpt").unlink()
    assert torch.equal(pnu.load(run).head[0].linear.weight, network(1).head[0].linear.weight)


def test_code_is_not_run(run: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return os.mkdir, (str(run / "evil"),)

    (run / "checkpoints" / "best.ckpt").write_bytes(pickle.dumps({"state_dict": Evil()}))
    with pytest.raises(
        ValueError, match=r"best.ckpt: expected a checkpoint of tensors and plain types, found a broken"
    ):
        pnu.load(run)
    config = yaml.safe_dump({"model": {"_target_": "os.mkdir", "path": str(run / "evil")}})
    (run / "config.yaml").write_text(config)
    with pytest.raises(ValueError, match=r"model._target_: expected a class below pnu.networks.* got 'os.mkdir'"):
        pnu.load(run)
    (run / "config.yaml").write_text(f"model: !!python/object/apply:os.mkdir ['{run / 'evil'}']")
    with pytest.raises(ValueError, match=r"config.yaml: is not YAML \(could not determine a constructor"):
        pnu.load(run)
    assert not (run / "evil").exists()


def test_no_run_folder(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="run=.*nothing: expected a run folder, such as .*, found no folder"):
        pnu.load(tmp_path / "nothing")
    with pytest.raises(ValueError, match="expected a run folder with config.yaml, found none"):
        pnu.load(tmp_path)
    (run / "checkpoints" / "best.ckpt").unlink()
    with pytest.raises(ValueError, match=r"expected checkpoints/best.ckpt or checkpoints/last.ckpt, found neither"):
        pnu.load(run)


@pytest.mark.parametrize("text", ["model: 3", "[1]", "", "models: {}"])
def test_config_without_model(run: Path, text: str) -> None:
    (run / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match="config.yaml: expected a group 'model'"):
        pnu.load(run)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"ratio": 4}, r"expected the state of PNU .*, found another network's: head.* missing|expansions.* is "),
        ({"local_features": True}, r"local_features\S* is missing, not \(32, 6\)"),
        ({"input_normals": False}, r"global_features.0.linear.weight is \(32, 6\), not \(32, 3\)"),
        ({"global_features": False}, r"head.0.linear.weight is \(512, 518\), not \(512, 6\)"),
    ],
)
def test_state_of_another_network(run: Path, change: dict[str, object], text: str) -> None:
    (run / "config.yaml").write_text(yaml.safe_dump({"model": {**MODEL, **change}}))
    with pytest.raises(ValueError, match=text):
        pnu.load(run)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (torch.ones(3), "a dict, found Tensor"),
        ({"epoch": 1}, "a 'state_dict', found none"),
        ({"state_dict": {}}, "missing"),
    ],
)
def test_other_content(run: Path, content: object, text: str) -> None:
    torch.save(content, run / "checkpoints" / "best.ckpt")
    with pytest.raises(ValueError, match=text):
        pnu.load(run)


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 broken", bytes(range(256)), b"\x80\x04c"])
def test_broken_file(run: Path, content: bytes) -> None:
    (run / "checkpoints" / "best.ckpt").write_bytes(content)
    with pytest.raises(ValueError, match=r"best.ckpt: expected a checkpoint of tensors and plain types"):
        pnu.load(run)


def test_numpy_scalars_are_plain(tmp_path: Path) -> None:
    torch.save({"loss": np.float32(0.25), "epoch": np.int64(3), "other": np.float64(0.5)}, tmp_path / "a.pt")
    assert checkpoints.read_checkpoint(tmp_path / "a.pt") == {"loss": 0.25, "epoch": 3, "other": 0.5}


def test_newest_run(tmp_path: Path) -> None:
    assert checkpoints.newest_run(tmp_path) is None
    ends = {"b": "2026-01-02T10:00:00+00:00", "a": "2026-01-02T12:30:00+02:00", "c": "2026-01-01T10:00:00+00:00"}
    for name, ended in ends.items():
        checkpoints.save(tmp_path / name, network(), MODEL, {"ended": ended})
    assert checkpoints.newest_run(tmp_path) == tmp_path / "a"
    write_json(tmp_path / "a" / "run.json", {"status": "failed", "ended": "2027-01-01T00:00:00+00:00"})
    assert checkpoints.newest_run(tmp_path) == tmp_path / "b"
    (tmp_path / "b" / "checkpoints" / "best.ckpt").unlink()
    (tmp_path / "a" / "run.json").write_text("{broken")
    assert checkpoints.newest_run(tmp_path) == tmp_path / "c"
    checkpoints.save(tmp_path / "d", network(), MODEL, {})  # ended when its record was written: now
    assert checkpoints.newest_run(tmp_path) == tmp_path / "d"


def test_failed_save_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(ValueError, match=r"run: cannot be written \(No space left on device\); choose another folder"):
        checkpoints.save(tmp_path / "run", network(), MODEL, {})
    assert not list(tmp_path.iterdir())
