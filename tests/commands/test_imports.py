"""What each verb imports: nothing heavy for help and mistakes, no torch and no numba where compiled kernels do all."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pnu.__main__ import verbs
from pnu.io import read_cloud, write_cloud
from pnu.upsamplers.whole_clouds import normals, upsample

HEAVY = {
    "hydra", "numpy", "scipy", "llvmlite", "numba", "torch", "lightning", "torchmetrics", "tensorboard", "open3d",
    "h5py", "PIL", "matplotlib", "rich", "trimesh", "laspy", "pandas",
}  # fmt: skip
ALLOWED = {  # of the heavy ones, beside those of the lines above
    "help": set(),
    "mistakes": {"hydra"},
    "normals": {"numpy", "scipy", "llvmlite", "rich"},
    "upsample": set(),
}
PROGRAM = """
import contextlib, io, json, sys
from pnu.__main__ import main
heavy, verbs, work = json.loads(sys.argv[1])
def run(*arguments):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        with contextlib.suppress(SystemExit):
            main(arguments)
def told(occasion):
    print(occasion, *sorted(set(heavy) & sys.modules.keys()))
for verb in verbs:
    run(verb, "--help")
told("help")
for verb in verbs:
    run(verb, "no_such_key=1")
told("mistakes")
for verb, lines in work.items():
    for line in lines:
        run(verb, *line)
    told(verb)
"""


def loaded(folder: Path, work: dict[str, list[list[str]]]) -> dict[str, set[str]]:
    """Heavy modules that are imported after each occasion, in one process."""
    given = json.dumps([sorted(HEAVY), [*verbs()], work])
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("COV_", "COVERAGE"))}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, given], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return {(words := line.split())[0]: {*words[1:]} for line in done.stdout.splitlines()}


@pytest.mark.usefixtures("compiled")
def test_nothing_is_imported_that_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).normal(size=(120, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    write_cloud(tmp_path / "given.ply", points, points)
    write_cloud(tmp_path / "bare.ply", points, None)
    found = loaded(
        tmp_path,
        {
            "normals": [["input=bare.ply", "output=normals.ply"]],
            "upsample": [[f"input={name}.ply", f"output=dense_{name}.ply", "ratio=2"] for name in ("given", "bare")],
        },
    )
    allowed: set[str] = set() if sys.platform.startswith("linux") else {"numba"}
    for occasion, more in ALLOWED.items():
        allowed |= more
        assert found[occasion] <= allowed, occasion
    assert "llvmlite" in found["normals"]  # kernels answered
    monkeypatch.setenv("PNU_FAST", "0")  # the same by torch
    for name, normal in (("given", points), ("bare", None)):
        dense = read_cloud(tmp_path / f"dense_{name}.ply")
        by_torch = upsample(points, normal, ratio=2)
        assert dense.normals is not None
        same = np.abs(np.hstack([dense.points, dense.normals]) - by_torch).max(1) < 1e-4
        assert same.mean() > 0.95, name  # a tie that falls otherwise moves a point and its neighbors
    found_normals = read_cloud(tmp_path / "normals.ply").normals
    np.testing.assert_allclose(found_normals, normals(points), atol=1e-4)
