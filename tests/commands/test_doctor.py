"""The check for system libraries: what is missing, the line that installs it, exit codes."""

import sys
from pathlib import Path

import pytest

from pnu.runtime import system_libraries

MISSING = {"libnothing-here.so.0": "libnothing0", "libc.so.6": "libc6"}
LINE = "apt-get install --no-install-recommends libnothing0"


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Debian that lacks a library; open3d cannot be imported."""
    if not sys.platform.startswith("linux"):
        pytest.skip("asks for libraries of Linux")
    monkeypatch.setattr(system_libraries, "LIBRARIES", MISSING)
    monkeypatch.setattr(system_libraries, "open3d_error", lambda: "ImportError: libnothing-here.so.0: no such file")
    monkeypatch.setattr(sys, "argv", ["doctor"])


def apt_get(folder: Path, monkeypatch: pytest.MonkeyPatch, code: int = 0) -> Path:
    """A program of that name which notes how it was called."""
    (folder / "apt-get").write_text(f'#!/bin/sh\necho "$@" >> {folder}/calls\nexit {code}\n')
    (folder / "apt-get").chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=":")
    monkeypatch.setattr("os.geteuid", lambda: 0)
    return folder / "calls"


def test_says_what_is_missing_and_the_line_to_run(capsys: pytest.CaptureFixture[str]) -> None:
    system_libraries.main()
    printed = capsys.readouterr()
    assert LINE in printed.out
    assert printed.err == "open3d cannot be imported: ImportError: libnothing-here.so.0: no such file\n"


def test_require_is_an_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["doctor", "--require"])
    with pytest.raises(SystemExit) as stopped:
        system_libraries.main()
    assert stopped.value.code == 1


def test_installs_as_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    calls = apt_get(tmp_path, monkeypatch)
    monkeypatch.setattr(sys, "argv", ["doctor", "--install"])
    system_libraries.main()
    assert calls.read_text().splitlines() == ["update -qq", "install -qq --no-install-recommends libnothing0"]
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == f"installing system libraries that open3d needs: {LINE}"
    assert any(LINE in line for line in rest), "it is still missing: the program did nothing"


def test_no_system_installs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = apt_get(tmp_path, monkeypatch)
    monkeypatch.setattr(sys, "argv", ["doctor", "--install", "--no-system"])
    system_libraries.main()
    assert not calls.exists()
    assert LINE in capsys.readouterr().out


@pytest.mark.parametrize("why", ["no root", "no apt-get", "it fails"])
def test_where_it_cannot_install_it_says_so_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], why: str
) -> None:
    calls = apt_get(tmp_path, monkeypatch, code=100)
    if why == "no root":
        monkeypatch.setattr("os.geteuid", lambda: 1000)
    if why == "no apt-get":
        monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(sys, "argv", ["doctor", "--install"])
    assert not system_libraries.install(["libnothing0"])
    assert calls.exists() == (why == "it fails")
    system_libraries.main()
    assert LINE in capsys.readouterr().out


def test_all_is_there(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(system_libraries, "LIBRARIES", {"libc.so.6": "libc6"})
    monkeypatch.setattr(system_libraries, "open3d_error", lambda: None)
    system_libraries.main()
    assert capsys.readouterr().out == "open3d and the system libraries it needs are here.\n"


def test_help_is_an_answer_and_another_option_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pnu", "--help"])
    system_libraries.main()
    assert "--no-system" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["pnu", "--instal"])
    with pytest.raises(SystemExit) as stop:
        system_libraries.main()
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith("error: unknown option --instal: expected --install, --no-system, ")
