"""`pnu convert` on checkpoints as the released code writes them."""

from pathlib import Path

import numpy as np
import pytest
import torch

import pnu
from pnu.commands.convert import main
from pnu.io import read_json
from tests.refusals import refused


@pytest.fixture
def released(shared: Path, tmp_path: Path) -> dict[str, np.ndarray]:
    """Makes epoch_7.pt of the reference's state."""
    reference = dict(np.load(shared / "reference" / "released_reference.npz"))
    state = {name[6:]: torch.as_tensor(value) for name, value in reference.items() if name.startswith("state/")}
    optimizer = {"state": {}, "param_groups": [{"lr": 5e-4}]}
    content = {"epoch": 7, "model_state_dict": state, "optimizer_state_dict": optimizer, "loss": np.float32(0.25)}
    torch.save(content, tmp_path / "epoch_7.pt")
    return reference


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_conversion(released: dict[str, np.ndarray], capsys: pytest.CaptureFixture[str]) -> None:
    main(["input=epoch_7.pt", "output=run"])
    assert capsys.readouterr().out.splitlines() == [
        "input:  epoch_7.pt, epoch 7",
        "run:    run",
        "next:   pnu upsample run=run input=cloud.ply output=dense.ply",
    ]
    network = pnu.load("run")
    with torch.no_grad():
        output = network(torch.from_numpy(released["input"]))
    torch.testing.assert_close(output, torch.from_numpy(released["output"]), rtol=0, atol=1e-6)
    record = read_json("run/run.json")
    assert record["status"] == "finished"
    assert (record["source"], record["epoch"], record["training_loss"]) == ("epoch_7.pt", 7, 0.25)
    assert "exists already" in refused(capsys, main, ["input=epoch_7.pt", "output=run"])


@pytest.mark.slow
def test_bad_input(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"epoch": 1, "model_state_dict": {"encoder.weight": torch.ones(2)}}, "other.pt")
    torch.save({"epoch": 1, "model_state_dict": {"UPSAMPLING_module.20.bias": torch.ones(6)}}, "part.pt")
    torch.save({"epoch": 1, "state_dict": {}}, "without.pt")
    torch.save(torch.nn.Linear(2, 2), "module.pt")
    Path("text.pt").write_text("EPOCH 1, TRAINING_LOSS 2")
    before = sorted(place.iterdir())
    expected = {
        "other": "other.pt: is not of the released network: expected the names of the released network, "
        "found 'encoder.weight'",
        "part": "part.pt: is not of the released network: expected the state of PNU",
        "without": "without.pt: expected a dict with model_state_dict, as the released code saves, found none",
        "module": "module.pt: expected a checkpoint of tensors and plain types, found a broken file or one with other",
        "text": "text.pt: expected a checkpoint of tensors and plain types",
        "none": "input=none.pt: no such file; expected a checkpoint epoch_N.pt",
    }
    for name, text in expected.items():
        assert refused(capsys, main, [f"input={name}.pt", "output=run"]).startswith(f"error: {text}")
    assert "the folder nowhere does not exist" in refused(capsys, main, ["input=other.pt", "output=nowhere/run"])
    assert sorted(place.iterdir()) == before
