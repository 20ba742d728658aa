"""Files of weights: written, read, found by name, refused."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

import pnu
from pnu import weights
from pnu.commands.export import main
from pnu.networks import checkpoints
from pnu.networks.surface import Surface

MODEL = {"_target_": "pnu.networks.surface.Surface", "neighbors": 12, "reach": 12, "width": 16}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a run."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    checkpoints.save(tmp_path / "run", Surface(neighbors=12, reach=12, width=16), MODEL, {})
    return tmp_path


def test_exported_weights_are_those_of_the_run(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["run=run", "output=small.safetensors"])
    assert capsys.readouterr().out.splitlines()[1].startswith("next:   pnu upsample run=small.safetensors")
    ours, theirs = pnu.load("run"), pnu.load("small.safetensors")
    assert isinstance(theirs, Surface)
    assert not theirs.training
    assert theirs.neighbors == 12
    for name, value in ours.state_dict().items():
        assert torch.equal(theirs.state_dict()[name], value)
    assert sorted(path.name for path in place.iterdir()) == ["run", "small.safetensors"]


def test_tiny_weights_are_written_as_zero_and_others_as_they_are(tmp_path: Path) -> None:
    state = {"some": torch.tensor([1e-39, -1e-21, 1e-19, -2.0, float("nan")]), "count": torch.tensor(3)}
    weights.write(tmp_path / "a.safetensors", MODEL, state)
    read = weights.read(tmp_path / "a.safetensors").state
    assert torch.equal(read["some"][:4], torch.tensor([0.0, 0.0, 1e-19, -2.0]))
    assert read["some"][4].isnan()
    assert read["count"] == 3


@pytest.mark.parametrize("name", weights.shipped_names())
def test_no_weights_that_ship_are_tiny(name: str) -> None:
    for values in weights.read(weights.FOLDER / f"{name}.safetensors").state.values():
        assert not ((values != 0) & (values.abs() < weights.TINY)).any()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["run=run", "output=small.pt"], "output=small.pt: expected a name that ends with .safetensors or .onnx"),
        (["run=run", "output=no/a.safetensors"], "output=no/a.safetensors: the folder no does not exist"),
        (
            ["run=run", "output=a.onnx", "format=safetensors"],
            "output=a.onnx: expected a name that ends with .safetensors",
        ),
        (["run=nothing", "output=a.safetensors"], "run=nothing: expected a run folder"),
    ],
)
def test_bad_export(place: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], text: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line


def test_points_of_a_patch_are_kept(place: Path) -> None:
    config = Path("run/config.yaml")
    config.write_text(config.read_text() + "data: {input_points: 64}\n")
    main(["run=run", "output=small.safetensors", "quiet=true"])
    assert pnu.load("small.safetensors").patch_size == 64
    weights.write("odd.safetensors", MODEL, {}, -1)
    with pytest.raises(ValueError, match=r"odd\.safetensors: expected a whole number of points as patch_size"):
        pnu.load("odd.safetensors")


def test_broken_and_foreign_files_are_refused(place: Path) -> None:
    Path("broken.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match=r"broken\.safetensors: expected weights as safetensors"):
        pnu.load("broken.safetensors")
    save_file({"a": torch.zeros(1)}, "foreign.safetensors")
    with pytest.raises(ValueError, match=r"foreign\.safetensors: expected weights written by `pnu export`"):
        pnu.load("foreign.safetensors")
    weights.write("other.safetensors", MODEL | {"width": 8}, Surface(12, 12, 12, 16).state_dict())
    with pytest.raises(ValueError, match=r"other\.safetensors: expected the state of Surface"):
        pnu.load("other.safetensors")


def test_code_in_a_config_is_not_run(place: Path) -> None:
    weights.write("evil.safetensors", {"_target_": "os.mkdir", "path": "evil"}, {})
    with pytest.raises(ValueError, match="expected a class below pnu"):
        pnu.load("evil.safetensors")
    assert not Path("evil").exists()


@pytest.mark.parametrize("name", weights.shipped_names())
def test_shipped_weights_load_and_have_a_card(name: str) -> None:
    path = weights.FOLDER / f"{name}.safetensors"
    assert path.stat().st_size < 10e6
    card = path.with_suffix(".md").read_text()
    for word in ("Data", "Command", "Results", "Limits", "Licence"):
        assert f"## {word}" in card
    assert all(torch.isfinite(value).all() for value in pnu.load(name).state_dict().values())
