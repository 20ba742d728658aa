"""What tables and records say of revision, machine and seeds."""

import platform
import re
import subprocess
from pathlib import Path

import pytest

from pnu.runtime import provenance as provenance_of
from pnu.runtime.provenance import machine, provenance, short_revision


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with pnu/runtime/provenance.py and docs/page.md, that the program seems to run from."""
    for name in ("pnu/runtime/provenance.py", "docs/page.md", ".gitignore"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("*.pyc\n")
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", "/dev/null")
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "-A"], [*who, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    monkeypatch.setattr(provenance_of, "__file__", str(tmp_path / "pnu/runtime/provenance.py"))
    return tmp_path


@pytest.mark.parametrize(
    ("name", "dirty"),
    [
        ("pnu/new.py", True),
        ("pnu/new folder/ä.py", True),
        ("conf/setting/mine.yaml", True),
        ("docs/page.md", True),  # known to git
        ("notes.txt", False),
        ("docs/pnu/a.py", False),
        ("pnu/a.pyc", False),  # ignored
    ],
)
def test_a_tree_with_files_that_count_is_not_clean(name: str, dirty: bool, checkout: Path) -> None:
    clean = provenance_of.git_revision()
    assert clean is not None
    assert re.fullmatch("[0-9a-f]{40}", clean)
    (checkout / name).parent.mkdir(parents=True, exist_ok=True)
    (checkout / name).write_text("x")
    assert provenance_of.git_revision() == clean + "+" * dirty


def test_the_line_of_a_table() -> None:
    assert provenance([1, 1], ["a" * 40], ["Xeon, 2 threads"]) == "Revision aaaaaaaaaa; Xeon, 2 threads; single seeds."
    assert provenance([3, 3], ["a" * 40 + "+", "b" * 40], ["X"]) == "Revision aaaaaaaaaa+ and bbbbbbbbbb; X; 3 seeds."
    assert provenance([2, 5, 3], [], []) == "Revision unknown; machine unknown; 2 to 5 seeds."
    assert short_revision("c" * 40 + "+") == "cccccccccc+"


def test_the_machine_has_no_name_and_no_path() -> None:
    line = provenance([1])
    assert re.fullmatch(r"Revision ([0-9a-f]{10}\+?|version \S+); .+; single seeds\.", line) or "version" in line
    assert re.search(r", \d+ threads?\b", machine())
    assert platform.node() not in machine()
    assert "/" not in machine().replace("/s", "")


def test_tables_of_measurements_tell_it(tmp_path: Path) -> None:
    from bench.__main__ import facts, markdown
    from bench.quality import written
    from pnu.io import write_json

    assert provenance([1]) in markdown(facts(), [], [])
    write_json(tmp_path / "quality_given.json", {"rows": [], "surfaces": [], "made": "Revision a; b; single seeds."})
    assert written(tmp_path).strip() == "Revision a; b; single seeds."
