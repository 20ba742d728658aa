"""The command of the slow tests goes through to the end and counts right."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CONTENT = """
import pytest

@pytest.mark.slow
def test_good(): pass

@pytest.mark.slow
def test_bad(): assert False

@pytest.mark.slow
def test_elsewhere(): pytest.skip("not here")

def test_fast(): assert False
"""


@pytest.mark.slow
def test_a_failure_does_not_end_it_and_is_told(tmp_path: Path) -> None:
    for name in ("test_soak.py", "test_other.py"):
        (tmp_path / name).write_text(CONTENT)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "tests.nightly", "-q", "-p", "no:cacheprovider", "-c", "pytest.ini", "."]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    text = (tmp_path / "outputs" / "nightly.md").read_text()
    assert done.stdout.endswith(f"\n{text}\n")
    lines = text.splitlines()
    assert "| killed at random moments, and on with it | 1 | 1 | 1 | 0.0 |" in lines
    assert "| all others | 1 | 1 | 1 | 0.0 |" in lines
    assert "| every documented command | 0 | 0 | 0 | 0.0 |" in lines
    assert [line for line in lines if line.startswith("- ")] == [
        "- failed: test_other.py::test_bad",
        "- failed: test_soak.py::test_bad",
    ]


def test_the_named_parts_are_there() -> None:
    from tests.nightly import PARTS

    for name in PARTS:
        (path,) = (ROOT / "tests").rglob(name)
        assert "mark.slow" in path.read_text(), name
