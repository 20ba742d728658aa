"""What tests of several commands share."""

import contextlib
import io
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest


def ran(main: Callable[..., object], folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command with these arguments in a folder, within this process: a new one takes seconds to start."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(list(arguments))
        except SystemExit as stop:
            code = int(stop.code or 0)
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def refused(capsys: pytest.CaptureFixture[str], main: Callable[..., object], arguments: Sequence[str]) -> str:
    """The one line on stderr of a command that ends with exit code 2."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main(list(arguments))
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line
