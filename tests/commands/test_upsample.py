"""`pnu upsample` on real files."""

import importlib
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from pnu.commands.upsample import main
from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_poisson_disk
from pnu.io import read_cloud, write_cloud, write_json
from pnu.networks.pnu import PNU
from tests.refusals import ran

MODEL = {"_target_": "pnu.networks.pnu.PNU", "ratio": 2, "local_features": False}


def make_run(folder: Path, status: str = "finished") -> Path:
    """A run folder with the small network, untrained."""
    (folder / "checkpoints").mkdir(parents=True)
    torch.manual_seed(0)
    network = PNU(ratio=2, local_features=False)
    state = {f"model.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state}, folder / "checkpoints" / "best.ckpt")
    (folder / "config.yaml").write_text(yaml.safe_dump({"model": MODEL}))
    write_json(folder / "run.json", {"status": status})
    return folder


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a finished run, and a cloud with normals."""
    make_run(tmp_path / "outputs" / "2026-01-02" / "03-04-05_small")
    points = np.random.default_rng(0).normal(size=(200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    write_cloud(tmp_path / "cloud.ply", 40 * points + 1e6, points)
    return tmp_path


def upsample(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return ran(main, place, *arguments)


def test_newest_run_and_report(place: Path) -> None:
    make_run(place / "outputs" / "2026-01-02" / "04-00-00_dead", status="failed")
    done = upsample(place, "input=cloud.ply", "output=dense.xyz", "ratio=3.5", "run=newest")
    assert done.returncode == 0, done.stderr
    dense = read_cloud(place / "dense.xyz")
    assert dense.points.shape == (700, 3)
    np.testing.assert_allclose(np.linalg.norm(np.loadtxt(place / "dense.xyz")[:, 3:], axis=1), 1, atol=1e-6)
    assert np.abs(dense.points.mean(0) - 1e6).max() < 100
    lines = done.stdout.splitlines()
    assert lines[0] == "input:  cloud.ply, 200 points, with normals"
    assert lines[1].startswith("        spacing ")
    assert lines[2] == "run:    outputs/2026-01-02/03-04-05_small (the newest finished one)"
    assert lines[3].startswith("output: dense.xyz, 700 points with unit normals, ")
    assert lines[4] == "next:   pnu reconstruct input=dense.xyz output=mesh.ply"
    assert "farthest points" in done.stderr


def test_given_run_quiet_and_estimated_normals(place: Path) -> None:
    run = make_run(place / "elsewhere")
    points, normals, *_ = read_cloud(place / "cloud.ply")
    np.save(place / "points.npy", points)
    write_cloud(place / "inward.ply", points, -normals, {"colors": np.zeros((200, 3), np.uint8)})
    done = upsample(place, "input=points.npy", "output=a.npy", f"run={run}", "ratio=2")
    assert "input:  points.npy, 200 points, normals estimated and oriented" in done.stdout
    assert f"run:    {run}\n" in done.stdout
    done = upsample(
        place, "input=inward.ply", "output=b.npy", f"run={run}", "ratio=2", "normals=estimate", "quiet=true"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    np.testing.assert_array_equal(np.load(place / "a.npy"), np.load(place / "b.npy"))
    done = upsample(place, "input=inward.ply", "output=c.pcd", f"run={run}", "ratio=1")
    assert "carried over: colors" in done.stdout
    assert (read_cloud(place / "c.pcd").attributes["colors"] == 0).all()
    assert len(read_cloud(place / "c.pcd").points) == 200


GOOD = ("input=cloud.ply", "output=dense.ply")
BAD = {
    "no file": (("input=no.ply", "output=dense.ply"), "no.ply: no such file; give the path of a point cloud"),
    "empty": (("input=empty.ply", "output=dense.ply"), "empty.ply: the file is empty; expected a point cloud"),
    "suffix": (
        ("input=cloud.ply", "output=dense.e57"),
        "dense.e57: the suffix '.e57' is not a format of a point cloud",
    ),
    "folder": (("input=cloud.ply", "output=no/dense.ply"), "no/dense.ply: the folder no does not exist; create it"),
    "columns": (("input=two.txt", "output=dense.ply"), "two.txt: has 2 columns; expected x y z"),
    "words": (("input=words.txt", "output=dense.ply"), "words.txt: line 1: expected numbers, found 'some'"),
    "same": (("input=cloud.ply", "output=./cloud.ply"), "output=./cloud.ply: is the input; give another name"),
    "ratio": ((*GOOD, "ratio=0.5"), "ratio=0.5: expected a number >= 1, the points out for each point in"),
    "ratio text": ((*GOOD, "ratio=many"), "ratio=many: expected float"),
    "normals": ((*GOOD, "normals=maybe"), "normals=maybe: expected auto, orient, estimate or keep"),
    "key": ((*GOOD, "ratoi=2"), "unknown key 'ratoi': did you mean 'ratio'?"),
    "missing": (("input=cloud.ply",), "output=... is required"),
    "no run": ((*GOOD, "run=nowhere"), "run=nowhere: expected a run folder, such as outputs/<date>/<time>_<name>"),
    "not a run": ((*GOOD, "run=outputs"), "run=outputs: expected a run folder with"),
    "no model": ((*GOOD, "model=nowhere"), "run=nowhere: expected a run folder, such as"),
    "device": ((*GOOD, "device=tpu"), "device=tpu: is not here; expected auto, cpu, or cuda"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(
    place: Path, case: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pnu.commands.upsample import main

    (place / "empty.ply").touch()
    np.savetxt(place / "two.txt", np.ones((20, 2)))
    (place / "words.txt").write_text("some words\n" * 20)
    before = {path: path.stat().st_mtime_ns for path in place.rglob("*") if path.is_file()}
    arguments, message = BAD[case]
    monkeypatch.chdir(place)
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    text = capsys.readouterr().err.strip()
    assert "\n" not in text
    assert text.startswith(f"error: {message}")
    assert before == {path: path.stat().st_mtime_ns for path in place.rglob("*") if path.is_file()}


def test_no_newest_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from pnu.commands.upsample import main

    monkeypatch.chdir(tmp_path)
    np.save("cloud.npy", np.random.default_rng(0).normal(size=(100, 3)))
    with pytest.raises(SystemExit):
        main(["input=cloud.npy", "output=dense.ply", "run=newest"])
    assert capsys.readouterr().err.startswith("error: run=newest: no finished run under outputs/; train one with")


def test_bad_input_of_the_real_command(place: Path) -> None:
    done = upsample(place, *GOOD, "ratio=0.5")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: ratio=0.5: expected a number >= 1, the points out for each point in\n"


def test_no_bar_before_an_error(place: Path) -> None:
    done = upsample(place, *GOOD, "run=outputs")
    assert done.returncode == 2
    assert done.stderr.startswith("error: run=outputs: expected a run folder with")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("run", [[], ["model=surface"]])
def test_the_default_is_what_comes_with_pnu(
    place: Path, run: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever was trained in this folder, from the command line and from Python."""
    import pnu
    from pnu.commands.upsample import main

    monkeypatch.chdir(place)
    points, normals, *_ = read_cloud(place / "cloud.ply")
    np.save(place / "points.npy", points)
    main(["input=cloud.ply", "output=a.npy", *run])
    main(["input=points.npy", "output=b.npy", *run])
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("run:")] == [
        "run:    surface (comes with pnu)",
        "run:    surface_estimated (comes with pnu)",
    ]
    np.testing.assert_array_equal(np.load("a.npy"), pnu.upsample(points, normals))
    np.testing.assert_array_equal(np.load("a.npy"), pnu.upsample(points, normals, model="surface"))
    np.testing.assert_array_equal(np.load("b.npy"), pnu.upsample(points))
    newest = pnu.upsample(points, normals, model="newest")
    np.testing.assert_array_equal(newest, pnu.upsample(points, normals, model="outputs/2026-01-02/03-04-05_small"))
    assert not np.array_equal(newest, np.load("a.npy"))


def test_help_names_every_key(tmp_path: Path) -> None:
    done = upsample(tmp_path, "--help")
    assert done.returncode == 0
    for key in ("input=", "output=", "run=", "ratio=4", "normals=auto", "device=auto", "quiet=false"):
        assert key in done.stdout


def test_long_runs_keep_parts_until_the_output_is_there(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pnu import io

    module = importlib.import_module("pnu.commands.upsample")
    monkeypatch.chdir(place)
    monkeypatch.setattr(module, "LONG", 100)
    parts = place / "dense.ply.parts"

    def fail(*_: object) -> None:
        raise ValueError("no space")

    with monkeypatch.context() as broken:
        broken.setattr(io, "write_cloud", fail)
        with pytest.raises(SystemExit):
            module.main([*GOOD, "quiet=true", "run=surface"])
    assert any(parts.rglob("*.npy"))
    module.main([*GOOD, "quiet=true", "run=surface"])
    assert len(read_cloud(place / "dense.ply").points) == 800
    assert not parts.exists()


@pytest.mark.slow
def test_killed_and_gone_on(tmp_path: Path) -> None:
    """`kill -9` in the middle, and the same command again: the file of a run that was never killed."""
    points = np.random.default_rng(0).normal(size=(8000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    write_cloud(tmp_path / "cloud.ply", points, points)
    code = (
        "import pnu.commands.upsample as module; from pnu.upsamplers import surface_projection\n"
        "if __name__ == '__main__': module.LONG, surface_projection.KEPT = 1, 2**12; module.main()"
    )
    (tmp_path / "run.py").write_text(code)

    def start(output: str) -> subprocess.Popen[str]:
        line = [sys.executable, "run.py", "input=cloud.ply", f"output={output}", "run=surface"]
        return subprocess.Popen(line, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)

    with start("whole.ply") as whole:
        assert "earlier" not in whole.communicate()[0]
    for at_least in (3, 12):
        with start("dense.ply") as process:
            while len(list(tmp_path.glob("dense.ply.parts/*/*.npy"))) < at_least:
                assert process.poll() is None
                time.sleep(0.01)
            process.kill()
    with start("dense.ply") as process:
        assert "parts:  dense.ply.parts, of an earlier start; what fits is taken" in process.communicate()[0]
    assert (tmp_path / "dense.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert not (tmp_path / "dense.ply.parts").exists()


def test_what_was_left_out_while_reading_is_said(place: Path) -> None:
    points, normals, *_ = read_cloud(place / "cloud.ply")
    rows = np.hstack([points, normals])
    rows[:20, 0], rows[20:25, 3:] = np.nan, 0
    np.savetxt(place / "holes.xyz", np.repeat(rows, 10, 0))
    done = upsample(place, "input=holes.xyz", "output=dense.ply", "ratio=2")
    assert done.returncode == 0, done.stderr
    assert "holes.xyz, 180 points, with normals\n" in done.stdout
    assert "200 of 2000 points left out: NaN, infinite" in done.stdout
    assert "1620 of 1800 points left out: at the place of another" in done.stdout
    assert "5 of 180 normals are zero or NaN: theirs are estimated" in done.stdout
    assert len(read_cloud(place / "dense.ply").points) == 360


@pytest.mark.slow
@pytest.mark.parametrize("run", ["surface", "pnu_residual"])
def test_who_tells_the_side_gets_normals_as_good_as_who_does_not(place: Path, run: str) -> None:
    points = sample_poisson_disk(shapes.make("teddy"), 600, np.random.default_rng(0))[:, :3]
    write_cloud(place / "bare.ply", points)
    found = []
    for told in ("side=null", "side=out", "viewpoint=0,0,9"):
        done = upsample(place, "input=bare.ply", "output=dense.ply", f"run={run}", "ratio=2", told)
        assert done.returncode == 0, done.stderr
        assert "normals: 600 estimated; side: " in done.stdout
        found.append(read_cloud(place / "dense.ply"))
    for cloud in found[1:]:
        np.testing.assert_array_equal(cloud.points, found[0].points)
        np.testing.assert_array_equal(cloud.normals, found[0].normals)


@pytest.mark.slow
def test_holes_are_filled_and_flagged(tmp_path: Path) -> None:
    i = np.arange(1500) + 0.5
    z, angle = 1 - 2 * i / 1500, np.pi * (1 + np.sqrt(5)) * i
    points = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)[60:]
    write_cloud(tmp_path / "cloud.ply", points, points, {"intensity": z[60:]})
    line = ("input=cloud.ply", "ratio=1", "keep=true", "outliers=keep", "holes=0.6")
    done = ran(main, tmp_path, *line, "output=closed.ply")
    assert done.returncode == 0, done.stderr
    closed = read_cloud(tmp_path / "closed.ply")
    filled = closed.attributes["filled"] == 1
    np.testing.assert_allclose(closed.points[:1440], points, atol=1e-6)
    assert not filled[:1440].any()
    assert filled[1440:].all()
    assert 30 < filled.sum() < 90  # 60 were taken out
    assert closed.points[filled, 2].min() > 0.9
    assert f"holes:  {filled.sum()} points fill them, flagged by filled\n" in done.stdout
    done = ran(main, tmp_path, *line, "output=closed.xyz")
    assert "points fill them, the last ones; this format has no room for a flag\n" in done.stdout
    done = ran(main, tmp_path, *line[:-1], "holes=-1", "output=open.ply")
    assert done.stderr == "error: holes=-1: expected a radius above 0 in the unit of the points\n"
    assert not (tmp_path / "open.ply").exists()
