"""What tests of several commands share."""

from collections.abc import Callable, Sequence

import pytest


def refused(capsys: pytest.CaptureFixture[str], main: Callable[..., object], arguments: Sequence[str]) -> str:
    """The one line on stderr of a command that ends with exit code 2."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main(list(arguments))
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line
