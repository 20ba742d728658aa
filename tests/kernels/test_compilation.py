"""Where compiled kernels are kept: what is found, what is not, and that nothing of it is an error."""

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pnu import kernels
from pnu.commands.doctor import kernels_line
from pnu.kernels import compilation

KERNEL = "KERNELS", ("boxes",)
NOTHING = hashlib.sha256().digest()  # an intact file of no code


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A machine on which nothing is compiled, and where compiling means to import one file that is."""
    monkeypatch.setattr(compilation, "folder", lambda: tmp_path / "kernels-new")
    monkeypatch.setattr(compilation, *KERNEL)
    monkeypatch.setattr("pnu.kernels.code_writing.write_code", lambda path, kernels: path.write_bytes(NOTHING))
    yield tmp_path / "kernels-new"
    compilation._start.cache_clear()


def test_what_is_complete_is_used_unless_it_is_not_wanted(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not kernels.ready()
    assert compilation.compile_all()
    assert kernels.ready()
    monkeypatch.setenv("PNU_FAST", "0")
    assert not kernels.ready()


def test_a_failure_is_noted_and_said(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "KERNELS", ("no_such_kernel",))
    assert not compilation.compile_all()
    assert not kernels.ready()
    assert "no_such_kernel" in (compilation.reason() or "")
    assert "no_such_kernel" in kernels_line(install=True)
    monkeypatch.setattr(compilation, *KERNEL)
    assert kernels_line(install=True) == "Compiled kernels are here.", "it is tried again where that is asked for"


def test_the_doctor_compiles(empty: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "pnu doctor --install compiles them" in kernels_line(install=False)
    assert kernels_line(install=True) == "Compiled kernels are here."
    assert "about a minute" in capsys.readouterr().out


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Programs that were begun, in a process that is no test."""
    programs: list[list[str]] = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: programs.append(command))
    for name in ("PYTEST_VERSION", "CI"):
        monkeypatch.delenv(name, raising=False)
    return programs


def test_compiled_in_the_background_once(empty: Path, begun: list[list[str]]) -> None:
    for _ in range(3):
        compilation.compile_in_background()
    assert begun == [[sys.executable, "-m", "pnu.kernels.compilation"]]


@pytest.mark.parametrize("why", ["compiled", "failed", "PNU_FAST=0", "a test"])
def test_nothing_is_compiled_in_the_background_where(
    empty: Path, begun: list[list[str]], monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    if why in ("compiled", "failed"):
        empty.mkdir()
        for name in (compilation.COMPLETE, compilation.NO_CODE) if why == "compiled" else (compilation.FAILED,):
            (empty / name).touch()
    else:
        monkeypatch.setenv(*{"PNU_FAST=0": ("PNU_FAST", "0"), "a test": ("PYTEST_VERSION", "9")}[why])
    compilation.compile_in_background()
    assert begun == []


@pytest.mark.parametrize("damage", ["cut off", "changed", "missing"])
def test_damaged_code_is_written_anew(empty: Path, begun: list[list[str]], damage: str) -> None:
    """By a process in the background, and by the doctor; kernels answer all the while."""
    assert compilation.compile_all()
    code = empty / compilation.CODE
    code.unlink() if damage == "missing" else code.write_bytes(NOTHING[:-1] if damage == "cut off" else NOTHING + b"1")
    assert kernels.ready()
    assert kernels_line(install=False).endswith("missing or damaged: pnu doctor --install writes it anew.")
    compilation.compile_in_background()
    assert len(begun) == 1
    assert kernels_line(install=True) == "Compiled kernels are here."
    assert code.read_bytes() == NOTHING


def test_code_that_cannot_be_kept_is_tried_once(
    empty: Path, begun: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path, kernels: object) -> None:
        tried.append(path)
        raise NotImplementedError("not here")

    tried: list[Path] = []
    monkeypatch.setattr("pnu.kernels.code_writing.write_code", refused)
    for _ in range(2):
        assert compilation.compile_all()
        compilation.compile_in_background()
    assert kernels_line(install=False) == "Compiled kernels are here."
    assert len(tried) == 1
    assert begun == []


def test_one_process_compiles(empty: Path) -> None:
    empty.mkdir()
    with open(empty / compilation.LOCK, "w") as lock:
        assert compilation._taken(lock, wait=False)
        assert not compilation.compile_all(wait=False)
    assert compilation.compile_all(wait=False)


def test_where_nothing_can_be_written_nothing_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert compilation.folder.__wrapped__() is None
    monkeypatch.setattr(compilation, "folder", lambda: None)
    assert not compilation.compile_all()
    assert not kernels.ready()
    compilation.compile_in_background()
    assert "can be written" in kernels_line(install=True)


def test_without_numba_nothing_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert compilation.folder.__wrapped__() is None
    assert compilation.reason() == "numba is not installed"


def test_another_source_has_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "HERE", tmp_path)
    (tmp_path / "boxes.py").write_text("a = 1")
    before = compilation._key()
    assert compilation._key() == before
    (tmp_path / "boxes.py").write_text("a = 2")
    assert compilation._key() != before


def test_old_states_are_forgotten_newer_ones_are_not(empty: Path) -> None:
    for name, age in (("old", 40), ("newer", 2)):
        other = empty.with_name(f"kernels-{name}")
        other.mkdir()
        past = time.time() - age * 86400
        os.utime(other, (past, past))
    assert compilation.compile_all()
    assert {path.name for path in empty.parent.iterdir()} == {"kernels-new", "kernels-newer"}


@pytest.mark.slow
def test_the_background_compiles_while_torch_answers(tmp_path: Path) -> None:
    """A copy of the package on which nothing is compiled; then the same call is answered by kernels."""
    package = Path(compilation.__file__).parents[1]
    shutil.copytree(package, tmp_path / "pnu", ignore=shutil.ignore_patterns("__pycache__"))
    code = """
import time, numpy as np, pnu
from pnu import kernels
points = np.random.default_rng(0).normal(size=(2600, 3))
points /= np.linalg.norm(points, axis=1, keepdims=True)
def make():
    return pnu.upsample(points, points, ratio=4, outliers="keep")
assert not kernels.ready()
plain = make()
ends = time.time() + 900
while not kernels.ready():
    assert time.time() < ends
    time.sleep(1)
found = make()
print((abs(found - plain).max(1) < 1e-5).mean())
"""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTEST_VERSION", "CI", "PNU_FAST")}
    environment |= {"PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 0.98


@pytest.mark.slow
def test_sixteen_lanes_compute_the_same(untraced: None) -> None:
    """What a processor with AVX-512 takes, in halves here."""
    root = Path(__file__).resolve().parents[2]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "tests/fast/test_compiled_projector.py",
        "-k",
        "projection or feet",
    ]
    environment = os.environ | {"PNU_LANES": "16"}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
