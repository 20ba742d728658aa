"""Every Python block and every command of README.md, docs/ and data/ runs, trainings and measurements shortened."""

import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pnu.__main__ import verbs
from pnu.commands.train import Train
from pnu.config.compose import compose_config
from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area
from pnu.io import read_cloud, read_mesh, write_cloud, write_mesh
from pnu.networks.pnu import PNU
from pnu.networks.released import rename
from pnu.runtime.system_libraries import open3d_error

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.md"))
PAGES += ["README.md", "data/README.md", "SECURITY.md", "CONTRIBUTING.md"]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
WITH_BLOCKS = [page for page in PAGES if BLOCK.search((ROOT / page).read_text(encoding="utf-8"))]
SHORT = {
    "prepare": ["data.patches=91"],
    "train": [
        *("data.patches=91", "data.input_points=64", "data.target_points=256", "data.batch_size=4", "threads=1"),
        *("trainer.max_steps=2", "trainer.max_epochs=-1", "trainer.accelerator=cpu", "trainer.val_check_interval=1"),
        *("trainer.limit_val_batches=1", "trainer.limit_test_batches=1", "callbacks.pictures.clouds=0"),
    ],
    "evaluate": ["shapes=[mug]", "kinds=[uniform]", "points=300", "truth_points=1200"],
    "compare": ["shapes=[mug]", "kinds=[uniform]", "points=300", "truth_points=1200", "size=64"],
}
CROPS = [
    *("data.validation=[mug]", "data.clouds=8", "data.size=128", "data.batch_size=4", "data.points=128", "threads=1"),
    *("trainer.max_steps=2", "trainer.accelerator=cpu", "trainer.val_check_interval=1", "callbacks.pictures.clouds=0"),
]  # of a training of `surface`
SWEPT = ["setting=default", "seed=0"]  # of an ablation
SEARCHED = ["hydra.sweeper.n_trials=1"]
PRELUDE = "from pnu.io import read_cloud\npoints = read_cloud('scan.ply').points\n"  # what the README takes as given


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def test_each_thing_of_the_paper_is_where_the_map_says() -> None:
    named = re.findall(r"`(pnu(?:\.\w+)+)`", text("docs/paper.md"))
    assert len(named) > 20
    for name in named:
        module, _, attribute = name.rpartition(".")
        assert callable(getattr(importlib.import_module(module), attribute)), name


def test_equations_have_the_numbers_of_the_map() -> None:
    """Seven, the overall loss the last of them; what implements one says its number first."""
    rows = re.findall(r"^\| Eq\. (\d)(.*)", text("docs/paper.md"), re.M)
    assert [int(number) for number, _ in rows] == list(range(1, 8))
    for number, row in rows:
        for name in re.findall(r"`(pnu(?:\.\w+)+)`", row):
            module, _, attribute = name.rpartition(".")
            words = getattr(importlib.import_module(module), attribute).__doc__
            assert re.findall(r"\bEq\. (\d+)", words)[0] == number, name
    for path in [*ROOT.glob("pnu/**/*.py"), *ROOT.glob("conf/**/*.yaml"), *ROOT.glob("docs/**/*.md")]:
        found = re.findall(r"\bEqs?\.[ ~(]*(\d+)(?: (?:to|and) (\d+))?", path.read_text(encoding="utf-8"))
        assert {int(number) for pair in found for number in pair if number} <= set(range(1, 8)), path
    assert re.findall(r"\(Eq\. (\d)\)", text("conf/loss/compound.yaml")) == ["7"]


def released_checkpoint(path: Path) -> None:
    """A checkpoint of random weights with the names that the released code gives them."""
    ours = PNU(ratio=4).state_dict()
    names = [f"GLOBAL_module.{i}.{part}" for i in range(30) for part in ("weight", "bias")]
    parts = [*(f"normlayer.bn.{part}" for part in ("weight", "bias", "running_mean", "running_var"))]
    parts += ["normlayer.bn.num_batches_tracked", "conv.weight", "conv.bias"]
    names += [f"GLOBAL_module.{i}.{part}" for i in range(30) for part in ("running_mean", "running_var")]
    names += [f"GLOBAL_module.{i}.num_batches_tracked" for i in range(30)]
    for kind, mlp in (("SA", "mlps.0"), ("FP", "mlp")):
        names += [f"{kind}_modules.{i}.{mlp}.layer{j}.{part}" for i in range(4) for j in range(3) for part in parts]
    ends = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    names += [f"UPSAMPLING_module.{i}.{end}" for i in (0, 1, 3, 4, 6, 7, 10, 11, 13, 14, 17, 18, 20) for end in ends]
    state = {name: ours[rename(name)] for name in names if rename(name) in ours}
    assert len(state) == len(ours)
    torch.save({"epoch": 1, "model_state_dict": state, "loss": 1.0}, path)


def lay_out(folder: Path, cache: Path) -> None:
    """What the pages assume: a copy of the program to add to, a scan, a surface, a folder of meshes, a checkpoint."""
    for name in ("pnu", "conf"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    cloud = sample_area(shapes.make("mug"), 400, np.random.default_rng(0))
    write_cloud(folder / "scan.ply", cloud[:, :3], cloud[:, 3:])
    write_cloud(folder / "tile.las", cloud[:, :3])
    write_mesh(folder / "mesh.ply", shapes.make("mug"))
    (folder / "meshes").mkdir()
    for name in [*shapes.names()[:3], "mug"]:
        write_mesh(folder / "meshes" / f"{name}.ply", shapes.make(name))
    (folder / "data").symlink_to(cache)  # patches of the procedural shapes are cut once for all pages
    released_checkpoint(folder / "epoch_N.pt")


def run(folder: Path, command: list[str]) -> None:
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stderr}"


def filled(folder: Path, line: str) -> str:
    """A line with names of this folder where the page has FOLDER, MESHES, FILE, outputs/... and what took hours."""
    line = line.replace("data.root=FOLDER/truth", "data.root=FOLDER").replace("[camel,casting,elephant]", "[mug]")
    line = line.replace("data.root=FOLDER", "data.root=meshes").replace("output=FOLDER", "output=converted")
    line = line.replace("data.root=MESHES", "data.root=meshes")
    line = re.sub(r"(outputs/quality|FOLDER/truth)/[\w/]+\.ply", "mesh.ply", line)
    if "outputs/..." in line:
        run = max(folder.glob("outputs/*/*_train"), default=None, key=lambda path: path.stat().st_mtime)
        line = line.replace("outputs/...", str(run.relative_to(folder)) if run else "surface")
    if "FILE" in line:
        line = line.replace("FILE", str(next(folder.glob("data/*.h5")).relative_to(folder)))
    return line


def run_line(folder: Path, line: str) -> None:
    program, *arguments = shlex.split(filled(folder, line), comments=True)
    if program == "make":
        run(ROOT, ["make", "--dry-run", *arguments])
        return
    if program == ".ci/run":  # an hour
        assert os.access(ROOT / program, os.X_OK)
        run(ROOT, ["bash", "-n", program])
        return
    if program in ("torchrun", "srun"):  # GPUs, a cluster: at least the keys exist
        compose_config(Train, arguments[arguments.index("pnu.train") + 1 :])
        return
    if program == "python":
        assert arguments[0] == "-m", line
        if arguments[1].startswith("bench"):  # minutes
            run(ROOT, [sys.executable, *arguments[:2], "--help"])
            return
        assert arguments[1] == "pnu.train", line
        arguments = ["train", *arguments[2:]]
    else:
        assert program == "pnu", line
    if arguments[:1] == ["app"] or (arguments[0] == "view" and "page=" not in line):  # serve until stopped
        arguments = [arguments[0], "--help"]
    if open3d_error():  # its system libraries are missing; tested in test_reconstruct.py
        if arguments[0] == "reconstruct":
            return
        arguments = [argument.replace("poisson", "midpoint") for argument in arguments]
    given = {argument.partition("=")[0] for argument in arguments}
    if not given & {"describe", "resume"}:
        short = CROPS if "ablation=surface" in arguments else SHORT.get(arguments[0], [])
        if "data._target_" in given:  # whose arguments are its own
            short = [option for option in short if not option.startswith("data.")]
        keep = {"shapes", "kinds", "points"} & given
        arguments += [option for option in short if option.partition("=")[0] not in keep]
        arguments += SWEPT if "ablation" in given else []
        arguments += SEARCHED if "hparams_search" in given else []
    run(folder, [sys.executable, "-m", "pnu", *arguments])


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_BLOCKS)
def test_blocks_run_in_order(page: str, cache: Path, tmp_path: Path) -> None:
    lay_out(tmp_path, cache)
    for language, block in BLOCK.findall(text(page)):
        named = re.match(r"(?:# @package \S+\n)?# ((?:pnu/|conf/|mylab)\S+)\n", block)
        if named:
            (tmp_path / named[1]).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / named[1]).write_text(block, encoding="utf-8")
        elif language == "python":
            run(tmp_path, [sys.executable, "-c", PRELUDE + filled(tmp_path, block)])
        else:
            for line in filter(None, block.splitlines()):
                run_line(tmp_path, line)


def test_a_network_takes_under_60_lines() -> None:
    blocks = [block for language, block in BLOCK.findall(text("docs/network.md")) if language in ("python", "yaml")]
    assert len(blocks) == 2
    assert sum(block.count("\n") for block in blocks) < 60


@pytest.mark.slow
def test_the_options_that_the_paper_page_names_exist() -> None:
    options = re.findall(r"`((?:model|loss|optimizer|data)[\w.]*=[\w.-]+)`", text("docs/paper.md"))
    assert len(options) >= 9
    for option in options:
        compose_config(Train, [option])


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", text(page)):
        assert link.startswith("https://") or (ROOT / page).parent.joinpath(link).exists(), link


@pytest.mark.parametrize("page", PAGES)
def test_modules_named_on_a_page_exist(page: str) -> None:
    for module in re.findall(r"python -m (pnu\.\w+)", text(page)):
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file(), module
    for verb in re.findall(r"^pnu (\w+)", text(page), re.M):
        assert verb in verbs(), verb


MADE = re.compile(
    r"^Revisions? (not recorded|unknown|version \S+|[0-9a-f]{10}\+?( and [0-9a-f]{10}\+?)*); .+; "
    r"(single seeds|\d+ seeds|\d+ to \d+ seeds)\.$",
    re.M,
)
TABLE = re.compile(r"(?:^\|.*\|\n)+", re.M)


def unexplained(page: str) -> list[str]:
    """First lines of the tables of measurements that no line on their making precedes or follows in their section.

    A table of measurements is one in whose columns behind the first two cells of five begin with a number.
    """
    found = []
    for section in re.split(r"^#+ .*\n", BLOCK.sub("", page), flags=re.M):
        tables = []
        for table in TABLE.findall(section):
            cells = [cell.strip(" *") for row in table.splitlines()[2:] for cell in row.split("|")[2:-1]]
            if sum(bool(re.match(r"[+-]?\d", cell)) for cell in cells) > 0.4 * len(cells):
                tables.append(table.partition("\n")[0])
        found += tables[len(MADE.findall(section)) :]
    return found


def test_a_table_of_measurements_is_known_as_such() -> None:
    table = "| a | b |\n|---|---|\n| x | 0.12 s |\n| y | **3.4** |\n"
    line = "Revision 0123456789+; Xeon, 2 threads; single seeds.\n"
    assert unexplained(f"## A\n\n{table}\n## B\n\n{line}") == ["| a | b |"]
    assert unexplained(f"{line}\n{table}") == unexplained(f"{table}\n{line}") == []
    assert unexplained(f"{table}\n{line}\n{table}") == ["| a | b |"]
    assert unexplained("| a | b |\n|---|---|\n| x | `10` |\n| 1 | yes |\n") == []
    measured = {page for page in PAGES if unexplained(MADE.sub("", text(page)))}
    assert measured >= {"README.md", "docs/speed.md", "docs/surface.md", "docs/rivals.md", "docs/ablations/normals.md"}


@pytest.mark.parametrize("page", PAGES)
def test_tables_of_measurements_say_how_they_were_made(page: str) -> None:
    assert not unexplained(text(page))


@pytest.mark.slow
@pytest.mark.parametrize("own", [False, True])
def test_example_goes_from_scan_to_mesh(own: bool, tmp_path: Path) -> None:
    given = []
    if own:
        write_cloud(tmp_path / "scan.ply", shapes.make("mug").vertices[:500])
        given = ["scan.ply", "results"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, ROOT / "docs" / "scan_to_mesh.py", *given]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / ("results" if own else "scan_to_mesh")
    scan = 500 if own else 1500
    assert len(read_cloud(folder / "dense.ply").points) == 4 * scan
    assert np.asarray(Image.open(folder / "steps.png")).std() > 10
    if not own:
        distance, angle = (float(value) for value in re.findall(r"([\d.]+)(?:e-3 from| degrees)", done.stdout))
        assert distance < 4
        assert angle < 20
    if open3d_error():
        assert "no mesh: " in done.stdout
    else:
        assert len(read_mesh(folder / "mesh.ply").faces) > 1000
