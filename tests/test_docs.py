"""Every Python block and every command of docs/ runs, trainings shortened."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pnu.data import shapes
from pnu.io import write_cloud, write_mesh
from pnu.ops.surface import sample_area
from pnu.run.config import compose_config
from pnu.train import Train

ROOT = Path(__file__).resolve().parents[1]
PAGES = ["quickstart", "scans", "training", "metrics", "network"]
SHORT = [
    "data.patches=91",
    "data.input_points=64",
    "data.target_points=256",
    "data.batch_size=4",
    "trainer.max_steps=2",
]
SHORT += [
    "trainer.max_epochs=-1",
    "trainer.accelerator=cpu",
    "callbacks.pictures.clouds=0",
    "trainer.val_check_interval=1",
]
SHORT += ["trainer.limit_val_batches=1", "trainer.limit_test_batches=1", "threads=1"]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)


def text(page: str) -> str:
    return (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")


def lay_out(folder: Path) -> None:
    """What the pages assume: a copy of the program to add to, a scan, a folder of meshes."""
    for name in ("pnu", "conf"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    cloud = sample_area(shapes.make("mug"), 400, np.random.default_rng(0))
    write_cloud(folder / "scan.ply", cloud[:, :3], cloud[:, 3:])
    (folder / "meshes").mkdir()
    for name in shapes.names()[:4]:
        write_mesh(folder / "meshes" / f"{name}.ply", shapes.make(name))


def run(folder: Path, command: list[str]) -> None:
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stderr}"


def run_line(folder: Path, line: str) -> None:
    python, *arguments = shlex.split(line)
    assert python == "python", line
    if arguments[1] == "pnu.train":
        arguments += SHORT
    elif arguments[1] == "pnu.prepare":
        arguments += SHORT[:1]
    run(folder, [sys.executable, *arguments])


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_run_in_order(page: str, tmp_path: Path) -> None:
    lay_out(tmp_path)
    blocks = BLOCK.findall(text(page))
    assert blocks
    for language, block in blocks:
        named = re.match(r"# ((?:pnu|conf)/\S+)\n", block)
        if named:
            (tmp_path / named[1]).write_text(block, encoding="utf-8")
        elif language == "python":
            run(tmp_path, [sys.executable, "-c", block])
        else:
            for line in block.strip().splitlines():
                if "pnu.reconstruct" not in line:  # needs system libraries; tested in test_reconstruct.py
                    run_line(tmp_path, line)


def test_a_network_takes_under_60_lines() -> None:
    lines = [block for language, block in BLOCK.findall(text("network")) if language in ("python", "yaml")]
    assert len(lines) == 2
    assert sum(block.count("\n") for block in lines) < 60


def test_the_options_that_the_paper_page_names_exist() -> None:
    options = re.findall(r"`((?:model|loss|optimizer|data)[\w.]*=[\w.-]+)`", text("paper"))
    assert len(options) >= 9
    for option in options:
        compose_config(Train, [option])


@pytest.mark.parametrize("page", [*PAGES, "paper"])
def test_links_lead_somewhere(page: str) -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", text(page)):
        assert (ROOT / "docs" / link).exists(), link
