"""Command lines to be pasted: every one that pnu prints is made here, quoted for Hydra's grammar and for the shell."""

import os
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

TYPED = "PNU_COMMAND"  # what was typed, for the processes that a sweep or a distributed training starts
PLAIN = re.compile(r"(?=.*[A-Za-z_/])[\w./+-]+", re.ASCII)
OTHER_TYPE = re.compile(r"null|true|false|[+-]?(inf|nan|[\d_.]+(e[+-]?[\d_]+)?)", re.I)


def shell_line(name: str, *options: str, **keys: Any) -> str:
    """The line that starts a command: shell_line("upsample", ratio=8, input="a b.ply") gives
    pnu upsample ratio=8 'input="a b.ply"'.

    Args:
        name: the verb.
        options: those without a value, such as "-m".
        keys: value of each key; dotted ones as `**{"data.path": path}`. Lists may hold what keys may.
    """
    words = [shlex.join(["pnu", name, *options]), *(quoted(key, v) for key, v in keys.items())]
    return " ".join(words)


def quoted(key: str, value: Any) -> str:
    """key=value as the shell takes it."""
    return shlex.quote(override(key, value))


def override(key: str, value: Any) -> str:
    """key=value as Hydra takes it."""
    return f"{key}={hydra_text(value)}"


def hydra_text(value: Any) -> str:
    """A value as Hydra's grammar reads it back: numbers, strings, paths, lists of them, null."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{','.join(hydra_text(item) for item in value)}]"
    text = re.sub(r"(\\*)\$\{", r"\1\1\\${", str(value))  # no interpolation
    if PLAIN.fullmatch(text) and not OTHER_TYPE.fullmatch(text):
        return text
    mark = "'" if '"' in text and "'" not in text else '"'
    text = re.sub(rf"(\\*){mark}", rf"\1\1\\{mark}", text)
    text = re.sub(r"(\\+)$", r"\1\1", text)
    return f"{mark}{text}{mark}"


def program(name: str) -> str:
    """How a command is started: pnu NAME, or python -m pnu.train, which is as good."""
    own = getattr(sys.modules["__main__"], "__spec__", None)
    return "python -m pnu.train" if own and own.name == "pnu.train" else f"pnu {name}"


@contextmanager
def typed(name: str, arguments: Sequence[str]) -> Iterator[None]:
    """Keep what was typed for `typed_line`."""
    before = os.environ.get(TYPED)
    os.environ[TYPED] = f"{program(name)} {shlex.join(arguments)}".rstrip()
    try:
        yield
    finally:
        del os.environ[TYPED]
        if before is not None:
            os.environ[TYPED] = before


def typed_line() -> str:
    """The line that started this command, to be pasted again; empty where none did."""
    return os.environ.get(TYPED, "")


def retyped(command: str) -> str:
    """The line of a run's record, without an interpreter's path and options, which older records have."""
    return re.sub(r"^\S*python\S* (.* )?-m (?=pnu\.)", "python -m ", command)
