"""Every command that pnu prints is made by pnu.config.quoting, and runs when it is pasted, whatever the names are."""

import ast
import html
import importlib
import io
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pnu
from pnu.commands.upsample import Upsample
from pnu.config.compose import compose_config, parse
from pnu.config.quoting import hydra_text, override, quoted, shell_line, typed, typed_line
from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area
from pnu.io import read_cloud, write_cloud, write_json, write_mesh
from pnu.runtime.system_libraries import open3d_error
from pnu.training import sweeps
from pnu.training.run_folder import RunFolder
from tests.conftest import REPOSITORY
from tests.test_docs import released_checkpoint
from tests.training.test_train import patch_file  # noqa: F401  a fixture

PACKAGE = Path(pnu.__file__).parent
NAMES = ["a b", "it's", 'say "so"', 'it\'s "so"', "k=v,seed=0", "$HOME", "a\\", '\\"', "null", "1e3", "12", "true", ""]
NAMES += ["~/x", "[a]", "(b)", "{c}", "é", "-x", "#x", "a:b", "*", "!x", "%d", "a;b&c|d", "`ls`"]
NASTY = 'it\'s a=b, $HOME "(c)"'
SMALL = ["data.batch_size=5", "data.input_points=64", "data.target_points=256", "trainer.accelerator=cpu", "threads=1"]
SMALL += ["trainer.max_steps=2", "trainer.max_epochs=-1", "trainer.val_check_interval=1", "callbacks.pictures.clouds=0"]


def words(line: str) -> list[str]:
    """What a shell makes of a line."""
    done = subprocess.run(["bash", "-c", f"printf '%s\\0' {line}"], capture_output=True, text=True, check=True)
    return done.stdout.split("\0")[:-1]


# --- quoting ---


@pytest.mark.parametrize("name", NAMES)
def test_a_name_arrives_as_it_is(name: str) -> None:
    program, verb, argument, other = words(shell_line("upsample", input=name, output=[name, "x"]))
    assert (program, verb) == ("pnu", "upsample")
    assert parse([argument])[0].value() == name
    assert parse([other])[0].value() == [name, "x"]
    if name:
        assert compose_config(Upsample, [argument, "output=x.ply"]).input == name


@settings(deadline=None)
@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1))
def test_any_name_arrives_as_it_is(name: str) -> None:
    (argument,) = shlex.split(quoted("key", name))
    expected = re.sub(r"(\\*)\$\{", r"\1\1\\${", name)  # as OmegaConf wants a text that is no interpolation
    assert parse([argument])[0].value() == expected


def test_values_that_are_no_names() -> None:
    given_values = [None, True, False, 3, 0.5, 1e-9, Path("a/b"), [1, "b c", None]]
    texts = ["null", "true", "false", "3", "0.5", "1e-09", "a/b", '[1,"b c",null]']
    assert [hydra_text(value) for value in given_values] == texts
    assert shell_line("train", "-m", **{"data.path": "x.h5"}) == "pnu train -m data.path=x.h5"


def test_what_was_typed_is_told_again() -> None:
    arguments = ["-m", f"run={hydra_text(NASTY)}", "seed=0,1"]
    assert typed_line() == ""
    with typed("train", arguments):
        assert words(typed_line()) == ["pnu", "train", *arguments]
    assert typed_line() == ""


# --- no other place ---


def texts_of(path: Path) -> list[str]:
    """All strings of a module but its docstrings and documentation of keys."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left_out = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            left_out.add(node.value)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "doc":
            left_out |= {part for part in ast.walk(node) if isinstance(part, ast.Constant)}
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and node not in left_out)
    return [node.value for node in nodes if isinstance(node.value, str)]


COMMAND = re.compile(r"\bpython3? .*-m\b|-m pnu|\bpnu[ .-]\w+ (-m|[\w.]+=)")


def test_no_place_makes_a_command_without_quoting() -> None:
    found = {
        f"{path.relative_to(PACKAGE)}: {text}"
        for path in PACKAGE.rglob("*.py")
        if path.name != "quoting.py"
        for text in texts_of(path)
        if COMMAND.search(text)
    }
    assert found == set()


def test_the_search_for_commands_finds_them(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    path.write_text('"""pnu x"""\nprint(f"next: pnu upsample run={run}")\nx = "pnu-train run=a"\n')
    assert [bool(COMMAND.search(text)) for text in texts_of(path)] == [True, True]


# where a line is made -> the test below that runs it
PLACES = {
    "commands/prepare.py next_line": "test_from_patches_to_a_picture",
    "training/run_folder.py line": "test_from_patches_to_a_picture",
    "commands/upsample.py upsample": "test_from_patches_to_a_picture",
    "commands/_tiles.py upsample_in_tiles": "test_a_cloud_within_a_memory",  # in test_tiles.py
    "commands/_tiles.py jobs": "test_tiles_as_jobs_give_the_same_bits",  # in test_tiles.py
    "commands/reconstruct.py reconstruct": "test_from_patches_to_a_picture",
    "commands/scan.py scan": "test_a_scan_then_a_picture",
    "commands/normals.py normals": "test_normals_then_a_denser_cloud",
    "commands/export.py as_safetensors": "test_weights_kept_as_a_file",
    "commands/convert.py convert": "test_weights_of_the_released_code",
    "commands/_normal_task.py evaluate_task": "test_normals_measured_then_made",
    "commands/evaluate.py evaluate": "test_an_evaluation_then_a_comparison",
    "commands/compare.py compare": "test_an_evaluation_then_a_comparison",
    "commands/compare.py upsamplers": "test_a_name_that_is_taken",
    "training/run_folder.py recorded": "test_a_run_that_was_stopped",
    "training/resuming.py open_run": "test_a_finished_run_that_lost_its_last_checkpoint",
    "training/sweeps.py closing_line": "test_a_sweep_then_its_report",
    "training/sweeps.py run": "test_interrupted_with_a_launcher",  # in test_sweep.py
    "commands/_arguments.py of_files": "test_files_of_awkward_names_stand_alone",  # in test_view.py
    "commands/_worker.py read_and_clean": "test_the_browser_gets_what_the_command_writes",  # in test_app.py
    "commands/_worker.py write_file": "test_the_browser_gets_what_the_command_writes",
    "app/sessions.py start_making": "test_the_browser_gets_what_the_command_writes",
    "commands/_entry.py main": "test_interrupted_before_anything_is_made",
    "commands/_entry.py folder_arguments": "test_hydras_folder_is_the_run_folder",  # in test_train.py
    "config/compose.py parse": "test_hints_on_quotes",
    "config/compose.py check_single": "test_hints_on_quotes",
    "report/sweep_results.py collect": "test_a_sweep_then_its_report",
}


def callers(path: Path) -> set[str]:
    makers = {"shell_line", "quoted", "typed_line", "override"}
    found = set()
    for function in ast.parse(path.read_text(encoding="utf-8")).body:
        inner = function.body if isinstance(function, ast.ClassDef) else [function]
        for one in inner:
            calls = (node.func for node in ast.walk(one) if isinstance(node, ast.Call))
            names = {call.id if isinstance(call, ast.Name) else getattr(call, "attr", "") for call in calls}
            if isinstance(one, ast.FunctionDef) and names & makers:
                found.add(one.name)
    return found


def test_every_place_that_makes_a_line_is_run() -> None:
    paths = [path for path in PACKAGE.rglob("*.py") if path.name != "quoting.py"]
    found = {f"{path.relative_to(PACKAGE)} {name}" for path in paths for name in callers(path)}
    found = {place.replace("_entry.py command", "_entry.py main") for place in found}
    assert found == set(PLACES)
    tests = "".join(path.read_text(encoding="utf-8") for path in REPOSITORY.glob("tests/**/test_*.py"))
    for test in PLACES.values():
        assert f"def {test}(" in tests


# --- pasted ---

Say = Callable[..., str]


def paste(line: str, *more: str) -> str:
    """What a line prints that is pasted with `more` after it."""
    program, verb, *arguments = words(line)
    assert program == "pnu"
    with redirect_stdout(io.StringIO()) as out:
        importlib.import_module(f"pnu.commands.{verb}").main([*arguments, *more])
    return out.getvalue()


@pytest.fixture
def say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Say:
    """`paste`, in a folder with a cloud and a folder of an awkward name."""
    monkeypatch.chdir(tmp_path)
    Path(NASTY).mkdir()
    cloud = sample_area(shapes.make("mug"), 300, np.random.default_rng(0))
    write_cloud("cloud.ply", cloud[:, :3], cloud[:, 3:])
    return paste


def printed(text: str, start: str = "next:") -> str:
    return next(line for line in text.splitlines() if line.startswith(start)).removeprefix(start).strip()


def in_nasty(name: str) -> str:
    return f"{NASTY}/{name}"


@pytest.fixture(scope="module")
def training(patch_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:  # noqa: F811
    """A run that the line of `pnu prepare` trained, and what it printed."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path(NASTY).mkdir()
        Path(in_nasty("p.h5")).symlink_to(patch_file)
        line = printed(paste(shell_line("prepare", describe=in_nasty("p.h5"))))
        return folder, paste(line, *SMALL, override("run", in_nasty("run")))


@pytest.fixture
def trained(say: Say, training: tuple[Path, str]) -> str:
    folder, text = training
    shutil.copytree(folder, ".", symlinks=True, dirs_exist_ok=True)
    return text


@pytest.mark.slow
def test_from_patches_to_a_picture(say: Say, trained: str) -> None:
    dense = say(printed(trained), override("output", in_nasty("dense.ply")), "ratio=2")
    assert len(read_cloud(in_nasty("dense.ply")).points) == 600
    if open3d_error():
        pytest.skip("open3d's system libraries are missing")
    mesh = say(printed(dense), override("output", in_nasty("mesh.ply")), "depth=4")
    say(printed(mesh), "size=64")
    assert Path("picture.png").stat().st_size > 0


@pytest.mark.slow
def test_a_scan_then_a_picture(say: Say) -> None:
    if open3d_error():
        pytest.skip("open3d's system libraries are missing")
    made = say(shell_line("scan", input="cloud.ply", output=in_nasty("mesh.ply")), "ratio=1", "depth=4")
    say(printed(made), "size=64")
    assert Path("picture.png").stat().st_size > 0


def test_normals_then_a_denser_cloud(say: Say) -> None:
    made = say(shell_line("normals", input="cloud.ply", output=in_nasty("normals.ply"), viewpoint="0,0,-3"))
    say(printed(made), "ratio=1")
    assert len(read_cloud("dense.ply").points) == len(read_cloud(in_nasty("normals.ply")).points)


def test_normals_measured_then_made(say: Say) -> None:
    Path(in_nasty("shapes")).mkdir()
    write_mesh(in_nasty("shapes/mug.ply"), shapes.make("mug"))
    data = {"task": "normals", "data": "meshes", "data.root": in_nasty("shapes")}
    measured = say(shell_line("evaluate", **data), "method=pca", "kinds=[clean]", "points=100")
    say(printed(measured))
    assert read_cloud("with_normals.ply").normals is not None


@pytest.mark.slow
def test_weights_kept_as_a_file(say: Say, trained: str) -> None:
    kept = say(shell_line("export", run=in_nasty("run"), output=in_nasty("w.safetensors")))
    say(printed(kept), "ratio=2")
    assert len(read_cloud("dense.ply").points) == 600


def test_weights_of_the_released_code(say: Say) -> None:
    released_checkpoint(Path(in_nasty("epoch_1.pt")))
    made = say(shell_line("convert", input=in_nasty("epoch_1.pt"), output=in_nasty("released")))
    say(printed(made), "ratio=2")
    assert len(read_cloud("dense.ply").points) == 600


@pytest.mark.slow
def test_an_evaluation_then_a_comparison(say: Say, trained: str) -> None:
    Path(in_nasty("meshes")).mkdir()
    write_mesh(in_nasty("meshes/mug.ply"), shapes.make("mug"))
    small = ["kinds=[uniform]", "points=300", "truth_points=1200"]
    data = {"data": "meshes", "data.root": in_nasty("meshes")}
    measured = say(shell_line("evaluate", run=in_nasty("run"), **data), *small)
    line = printed(measured)
    say(line, *small, "surfaces=[]", "size=64", "output=page")
    page = Path("page/index.html").read_text(encoding="utf-8")
    made = re.search(r"Made by: (pnu [^<]*)", page)
    assert made is not None
    again = html.unescape(made[1])
    assert words(again)[:3] == words(line)[:3]


def test_a_name_that_is_taken(say: Say, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        say(shell_line("compare", methods=["apss", "apss"]), "points=300", "kinds=[uniform]", "shapes=[mug]")
    cure = capsys.readouterr().err.strip().rpartition("give another one, ")[2]
    assert parse(words(cure))[0].value() == ["NAME:apss"]


@pytest.mark.slow
def test_a_run_that_was_stopped(say: Say, trained: str, capsys: pytest.CaptureFixture[str]) -> None:
    run = RunFolder(in_nasty("run"))
    with pytest.raises(SystemExit), run.recorded({}):
        raise KeyboardInterrupt
    say(printed(capsys.readouterr().err, "stopped; go on with:"), "trainer.max_steps=3", "quiet=true")
    assert run.read_record()["status"] == "finished"


@pytest.mark.slow
def test_a_finished_run_that_lost_its_last_checkpoint(
    say: Say, trained: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(in_nasty("run/checkpoints/last.ckpt")).unlink()
    with pytest.raises(SystemExit):
        say(shell_line("train", run=in_nasty("run"), resume=True))
    line = capsys.readouterr().err.partition("to go on from; ")[2].removesuffix(" starts from it\n")
    data = ["data=patches", override("data.path", in_nasty("p.h5"))]
    assert "start  best validation" in say(line, *data, *SMALL)


@pytest.mark.slow
def test_a_sweep_then_its_report(say: Say, trained: str) -> None:
    folder = Path(in_nasty("sweep"))
    folder.mkdir()
    Path(in_nasty("run")).rename(folder / "default_1")
    closing = sweeps.closing_line(folder)
    report = say(printed(closing))
    (tensorboard,) = re.findall("curves: (.*)", report)
    assert words(tensorboard) == ["tensorboard", "--logdir", str(folder)]
    assert (folder / "report" / "report.html").is_file()
    typed_before = RunFolder(folder / "default_1").read_record()["command"]
    assert typed_before in (folder / "report" / "report.md").read_text()
    assert words(typed_before)[:3] == ["pnu", "train", "data=patches"]
    write_json(folder / "default_1" / "run.json", {"status": "failed"})
    with typed("train", ["-m", "seed=0,1"]):
        assert printed(sweeps.closing_line(folder)) == "pnu train -m seed=0,1"  # nothing to report on


def test_interrupted_before_anything_is_made(
    say: Say, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    line = shell_line("upsample", input="cloud.ply", output=in_nasty("dense.ply"), run="surface")
    monkeypatch.setattr("pnu.upsamplers.whole_clouds.densified", stop)
    with pytest.raises(SystemExit) as stopped:
        say(line)
    assert stopped.value.code == 130
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert words(printed(error, "stopped; start again with:")) == words(line)


@pytest.mark.parametrize("argument", ["output=a b,c", "output=a, 'b'", "output=a(b"])
def test_hints_on_quotes(argument: str, say: Say, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        say(shell_line("upsample", input="x.ply"), argument)
    hint = capsys.readouterr().err.strip().rpartition("quotes, ")[2]
    assert parse(words(hint))[0].value() == argument.partition("=")[2]
