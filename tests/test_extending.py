"""Classes from a package of one's own: a loss, a network, data, a callback; named by `allow`, and by nothing else."""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import yaml

import pnu
from pnu.commands.train import Train, main
from pnu.config.compose import compose_config
from pnu.config.help_text import help_text
from pnu.networks.checkpoints import read_checkpoint
from tests.refusals import refused

PAGE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"
ALL = ["loss._target_=mylab.Laplacian", "model._target_=mylab.Split", "data._target_=mylab.Spheres", "data.samples=16"]
SHORT = ["trainer.max_steps=2", "trainer.accelerator=cpu", "callbacks.pictures.clouds=0", "quiet=true"]


@pytest.fixture
def mylab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package of the page, on Python's path."""
    from pnu.config import signature

    (source,) = re.findall(r"^```python\n(# mylab\.py\n.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    (tmp_path / "mylab.py").write_text(source, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    for cached in (signature.arguments, signature.definition, signature.parsed):
        cached.cache_clear()
    yield tmp_path / "mylab.py"
    sys.modules.pop("mylab", None)


def test_arguments_of_an_own_class_are_keys_at_once(mylab: Path) -> None:
    cfg = compose_config(Train, ["allow=[mylab]", *ALL, "loss.w_laplacian=1", "loss.k=7"])
    assert (cfg.loss.w_laplacian, cfg.loss.k, cfg.loss.w3) == (1.0, 7, 0.05)
    assert (cfg.data.samples, cfg.data.points, cfg.data.seed) == (16, 64, 0)
    assert "augmentation" not in cfg.data  # what conf/ says to the class that stood there
    text = help_text(Train, "train", cfg)
    assert "loss.w_laplacian=1                       weight of the squared distance to that middle" in text
    assert "mylab" not in sys.modules


def test_adding_an_argument_changes_one_file(mylab: Path) -> None:
    from pnu.config import signature

    source = mylab.read_text(encoding="utf-8")
    source = source.replace("width: int = 32)", 'width: int = 32, kind: str = "relu")')
    mylab.write_text(
        source.replace("        width: of the hidden layer\n", "        width: of it\n        kind: of layer\n")
    )
    for cached in (signature.arguments, signature.definition, signature.parsed):
        cached.cache_clear()
    cfg = compose_config(Train, ["allow=[mylab]", "model._target_=mylab.Split", "model.kind=gelu"])
    assert cfg.model == {"_target_": "mylab.Split", "ratio": 4, "width": 32, "kind": "gelu"}
    assert "model.kind=gelu                          of layer" in help_text(Train, "train", cfg)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["loss._target_=mylab.Laplacian"], "allow=[mylab] lets a package of your own define it"),
        (["allow=[mylab]", "loss._target_=mylab.Nothing"], "found no such class"),
        (["allow=[mylab]", "loss._target_=os.system"], "expected a class of pnu.losses"),
        (["allow=[mylab]", "loss._target_=mylab.torch.Tensor"], "found no such class"),
        (["allow=[mylab]", *ALL, "loss.w_laplace=1"], "unknown key 'loss.w_laplace': did you mean 'loss.w_laplacian'?"),
        (["allow=[mylab]", *ALL, "loss.w_laplacian=x"], "loss.w_laplacian=x: expected float (weight of the squared"),
    ],
)
def test_what_is_not_allowed_or_not_there_is_refused(
    mylab: Path, overrides: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(capsys, main, overrides)
    assert "mylab" not in sys.modules


@pytest.mark.slow
def test_an_own_loss_network_and_data_train_go_on_and_load(mylab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["allow=[mylab]", *ALL, *SHORT, "run=own", "quiet=false"])
    assert "next: pnu upsample input=cloud.ply output=dense.ply run=own 'allow=[mylab]'" in capsys.readouterr().out
    assert "laplacian" in yaml.safe_dump(yaml.safe_load(Path("own/config.yaml").read_text()))

    with pytest.raises(ValueError, match=r"expected a class below pnu\.networks.*allow=\[mylab\]"):
        pnu.load("own")
    network = pnu.load("own", allow=["mylab"])
    assert type(network).__name__ == "Split"
    cloud = torch.nn.functional.normalize(torch.randn(80, 3), dim=-1).repeat(1, 2).numpy()
    assert pnu.upsample(cloud, model=network).shape == (320, 6)

    # a run folder allows nothing by itself
    assert "expected a class of pnu." in refused(capsys, main, ["run=own", "resume=true", "trainer.max_steps=4"])
    main(["run=own", "resume=true", "trainer.max_steps=4", "allow=[mylab]", "quiet=true"])
    assert read_checkpoint(Path("own/checkpoints/last.ckpt"))["global_step"] == 4


@pytest.mark.slow
def test_commands_take_an_own_network(mylab: Path) -> None:
    from pnu.data import shapes
    from pnu.io import write_cloud

    main(["allow=[mylab]", *ALL, *SHORT, "run=own"])
    write_cloud("scan.ply", shapes.make("mug").vertices[:300])
    for line in (
        "upsample input=scan.ply output=dense.ply run=own",
        "export run=own output=own.safetensors",
        "evaluate run=own shapes=[mug] kinds=[uniform] points=300 truth_points=1200",
    ):
        verb, *words = line.split()
        done = subprocess.run(
            [sys.executable, "-m", "pnu", verb, *words, "allow=[mylab]"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
