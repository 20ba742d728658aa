"""Which shapes a network has seen in its training, and that a comparison says so."""

from pathlib import Path

import pytest
import yaml

from pnu import weights
from pnu.benchmark import case_source
from pnu.benchmark.trained_shapes import Trained, of_card, trained_on
from pnu.commands.compare import main, upsamplers
from pnu.data import shapes
from pnu.io import write_mesh
from pnu.training.run_folder import run_name
from tests.reconstruction.test_surfaces import icosphere

SYNTHETIC = {"_target_": "x", "kinds": ["organic", "cad"], "val_share": 0.1, "test_share": 0.1}


def run(folder: Path, data: dict, **more: object) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump({"data": data, "model": {}} | more))
    return folder


def test_a_run_on_procedural_shapes_has_seen_those_that_are_not_kept(tmp_path: Path) -> None:
    trained = trained_on(run(tmp_path / "run", SYNTHETIC))
    parts = {part: case_source(SYNTHETIC, part=part).shapes for part in ("train", "val", "test")}
    assert trained.of(parts["train"], True) == parts["train"]
    assert trained.of(parts["val"] + parts["test"], True) == []
    assert trained.of(parts["train"], False) == []  # meshes of such names are others


def test_a_run_on_meshes_and_what_it_began_with(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    for name in "abcd":
        write_mesh(tmp_path / "meshes" / f"{name}.ply", icosphere(0))
    root = str(tmp_path / "meshes")
    first = run(tmp_path / "first", {"root": root, "procedural": True, "validation": ["a", "mug"]})
    trained = trained_on(first)
    assert trained.of(["a", "b", "z"], False) == ["b"]
    assert trained.of(["mug", "pear"], True) == ["pear"]
    later = run(tmp_path / "later", {"root": root, "procedural": False, "validation": ["b"]}, weights=str(first))
    assert trained_on(later).of(["a", "b", "c"], False) == ["a", "b", "c"]  # b in the first, a in the second
    both = {"root": root, "procedural": ["organic", "cad"], "val_share": 0.1, "test_share": 0.1}
    seen = trained_on(run(tmp_path / "both", both))  # a split of all together
    assert len(seen.of(list("abcd"), False)) + len(seen.of(shapes.names(), True)) == 95 - 2 * 10
    gone = run(tmp_path / "gone", {"root": "nowhere"}, weights="no/such/run")
    assert trained_on(gone).unknown == "its meshes in nowhere are not here"
    assert trained_on(run(tmp_path / "own", {}, weights="pnu")).of(shapes.names(), True)


def test_every_card_says_what_it_was_trained_on() -> None:
    for name in weights.shipped_names():
        trained = trained_on(name)
        assert len(trained.procedural) > 60, name
        assert trained.procedural <= set(shapes.names())
    surface = trained_on("surface")
    assert surface.of(["tds_plato", "goathead", "tds_nymph", "kitten", "om_x_link1", "cube"], False) == [
        "tds_plato",
        "cube",
    ]
    assert of_card("no such line") == Trained()


@pytest.mark.slow
def test_a_comparison_says_it_and_names_runs_without_their_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "meshes").mkdir()
    for name in ("cube", "ball"):
        write_mesh(tmp_path / "meshes" / f"{name}.ply", icosphere(2))
    data = ["data=meshes", "data.root=meshes", "kinds=[uniform]", "points=100", "truth_points=300", "surfaces=[]"]
    main(["methods=[surface,midpoint]", *data, "ratio=2", "size=64", "quiet=true", "output=out"])
    said = "surface: was trained on 1 of the 2 shapes, by their names, and is not tested by them: cube"
    assert capsys.readouterr().err.splitlines() == [f"warning: {said}"]
    assert said in (tmp_path / "out" / "index.html").read_text()


def test_names_of_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_name("outputs/2026-01-01/12-30-01_no_cd") == "no_cd"
    assert run_name("outputs/pnu") == "pnu"
    assert run_name("outputs/12-30-01_") == "12-30-01_"
    folders = [tmp_path / "12-30-01_wide", tmp_path / "12-31-01_wide", tmp_path / "12-32-01_deep"]
    for folder in folders:
        folder.mkdir()
    monkeypatch.setattr("pnu.networks.checkpoints.load", lambda folder, allow: None)
    monkeypatch.setattr("pnu.benchmark.network_upsampler", lambda *args, **options: None)
    from omegaconf import OmegaConf

    keys = {"ratio": 4, "passes": False, "batch_size": None, "device": "cpu", "seed": 0, "allow": []}
    cfg = OmegaConf.create({"methods": [str(folder) for folder in folders]} | keys)
    monkeypatch.setattr("pnu.commands.compare.runs_of_sweep", lambda method: [])
    assert list(upsamplers(cfg)) == ["12-30-01_wide", "12-31-01_wide", "deep"]
