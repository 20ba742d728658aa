"""The wheel: installed alone in another folder, every command works from any directory."""

import os
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from pnu import weights
from pnu.__main__ import verbs
from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area
from pnu.io import read_cloud, write_cloud, write_mesh
from pnu.runtime.system_libraries import open3d_error
from tests.test_docs import SHORT, released_checkpoint

ROOT = Path(__file__).resolve().parents[1]
ALL_HELP = """
import contextlib, importlib.metadata, io, pathlib, sys, pnu
from pnu import weights
from pnu.__main__ import verbs
(found,) = importlib.metadata.distributions(name="pnu", path=[sys.argv[1]])
(script,) = [entry for entry in found.entry_points if entry.group == "console_scripts"]
assert script.name == "pnu"
print(pathlib.Path(pnu.__file__).parent)
for verb in set(verbs()) - {"doctor"}:  # which has no keys
    with contextlib.redirect_stdout(io.StringIO()) as said:
        script.load()([verb, "--help"])
    assert "quiet" in said.getvalue() and f"usage: pnu {verb}" in said.getvalue(), said.getvalue()
    print(verb)
"""


def test_the_workflow_runs_on_every_python_that_is_asked_for() -> None:
    asked = SpecifierSet(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"])
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"].values()
    assert job["strategy"]["matrix"]["python"] == [f"3.{n}" for n in range(30) if f"3.{n}" in asked]


def test_everything_that_is_asked_for_has_a_pin_that_fits() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    versions = {canonicalize_name(pin.name): next(iter(pin.specifier)).version for pin in pins}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    asked = [*project["dependencies"], *(line for name in extras if name != "ray" for line in extras[name])]
    unpinned = {"pnu", "triton"}  # itself; of Linux on x86-64 alone
    for needed in map(Requirement, asked):
        if needed.name not in unpinned:
            assert needed.specifier.contains(versions[canonicalize_name(needed.name)], prereleases=True), needed


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    copy = folder / "source"  # the checkout stays as it is
    for name in ("pnu", "conf"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    pip("wheel", "--no-build-isolation", "--wheel-dir", folder, copy)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def site(wheel: Path) -> Path:
    pip("install", "--target", wheel.parent / "site", wheel)
    return wheel.parent / "site"


def pip(command: str, *arguments: str | Path) -> None:
    quiet = [sys.executable, "-m", "pip", command, "--quiet", "--disable-pip-version-check", "--no-deps"]
    done = subprocess.run([*quiet, *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def run(site: Path, folder: Path, *command: str | Path) -> str:
    environment = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(list(map(str, command)), cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_what_the_package_reads(wheel: Path) -> None:
    packed = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"pnu/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "conf").rglob("*.yaml")}
    files = [path for path in (ROOT / "pnu").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    wanted |= {path.relative_to(ROOT).as_posix() for path in files}
    assert {"pnu/conf/train.yaml", "pnu/py.typed", "pnu/weights/surface.safetensors", "pnu/report/base.html"} <= wanted
    rivals = {f"pnu/weights/{name}{ending}" for name in weights.RIVALS for ending in (".md", weights.SUFFIX)}
    assert wanted - packed == rivals
    assert wheel.stat().st_size < 9e6
    assert any(name.endswith("licenses/LICENSE") for name in packed)
    assert {name.split("/")[0].partition("-")[0] for name in packed} == {"pnu"}


def test_every_verb_answers_from_another_directory(site: Path, tmp_path: Path) -> None:
    package, *answered = run(site, tmp_path, sys.executable, "-c", ALL_HELP, site).split()
    assert Path(package) == site / "pnu"
    assert set(answered) == set(verbs()) - {"doctor"}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_installed_script_upsamples_with_the_shipped_weights(site: Path, tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    np.savetxt(tmp_path / "sphere.xyz", np.hstack([points, points]))
    keys = ["input=sphere.xyz", "output=dense.xyz", "run=surface", "ratio=2", "quiet=true"]
    run(site, tmp_path, site / "bin" / "pnu", "upsample", *keys)
    dense = np.loadtxt(tmp_path / "dense.xyz")
    assert dense.shape == (400, 6)
    assert np.abs(np.linalg.norm(dense[:, :3], axis=1) - 1).max() < 0.1


@pytest.mark.slow
def test_every_verb_does_its_work_in_another_directory(site: Path, tmp_path: Path) -> None:
    """From a scan and meshes to patches, networks, clouds, tables and pictures."""
    mug = shapes.make("mug")
    scan = sample_area(mug, 400, np.random.default_rng(0))
    write_cloud(tmp_path / "scan.ply", scan[:, :3], scan[:, 3:])
    (tmp_path / "meshes").mkdir()
    for name in ("mug", "nut", "bolt"):
        write_mesh(tmp_path / "meshes" / f"{name}.ply", shapes.make(name))
    released_checkpoint(tmp_path / "epoch_1.pt")
    measured = "shapes=[mug] kinds=[uniform] points=300 truth_points=1200 data=meshes data.root=meshes"
    trained = f"data=patches data.path=patches.h5 {' '.join(SHORT['train'][1:])}"
    lines = [
        "pnu prepare data=meshes data.root=meshes data.patches=12 output=patches.h5",
        f"pnu train run=run {trained}",
        f"pnu train -m loss.w3=0,0.05 sweep=s {trained}",
        "pnu report sweep=outputs/sweeps/s",
        f"pnu evaluate run=run {measured}",
        f"pnu compare methods=[run,midpoint] surfaces=[] size=64 output=page {measured}",
        "pnu export run=run output=mine.safetensors",
        "pnu convert input=epoch_1.pt output=converted",
        "pnu upsample input=scan.ply output=dense.ply run=mine.safetensors",
        "pnu picture inputs=[scan.ply,dense.ply] output=figure.png size=64",
        "pnu normals input=scan.ply output=normals.ply",
        "pnu view scan.ply dense.ply page=view.html",
    ]
    made = "patches.h5 run/metrics.json outputs/sweeps/s/report/report.md run/evaluation page/index.html converted"
    if not open3d_error():
        lines.append("pnu reconstruct input=scan.ply output=mesh.ply")
        made += " mesh.ply"
    for line in lines:
        script, *arguments = shlex.split(line)
        run(site, tmp_path, site / "bin" / script, *arguments)
    elsewhere = {"reconstruct", "scan", "doctor", "app"}  # want Open3D's system libraries, or a browser
    assert {line.split()[1] for line in lines} | elsewhere == set(verbs())
    assert len(read_cloud(tmp_path / "dense.ply").points) == 1600
    for path in [*made.split(), "figure.png", "normals.ply", "view.html"]:
        assert (tmp_path / path).exists(), path
