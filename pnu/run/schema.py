"""Dataclasses that document a command's keys: which keys there are, of which type, with a line on each."""

import dataclasses
import difflib
import types
import typing
from collections.abc import Sequence
from typing import Any


def doc(text: str) -> Any:
    """A field of a command's dataclass: its documentation. The value stands in conf/, and only there."""
    return dataclasses.field(default="???", metadata={"doc": text})


def fields(schema: type) -> dict[str, dataclasses.Field[Any]]:
    return {field.name: field for field in dataclasses.fields(schema)}


def known_keys(schema: type, prefix: str = "") -> dict[str, str]:
    """Every key of a dataclass, dotted, and its documentation."""
    hints = typing.get_type_hints(schema)
    keys = {}
    for name, field in fields(schema).items():
        keys[prefix + name] = field.metadata["doc"]
        if dataclasses.is_dataclass(hints[name]):
            keys |= known_keys(typing.cast(type, hints[name]), f"{prefix}{name}.")
    return keys


def nearest_key(key: str, known: Sequence[str]) -> str:
    """The known key that a mistyped one most likely means, by its whole or last part (epochs: trainer.max_epochs)."""

    def likeness(candidate: str) -> float:
        whole = difflib.SequenceMatcher(None, key, candidate).ratio()
        last = difflib.SequenceMatcher(None, key.rpartition(".")[2], candidate.rpartition(".")[2]).ratio()
        return max(whole, 0.9 * last)

    return max(known, key=likeness)


def check(cfg: Any, schema: type, *, complete: bool = True, prefix: str = "") -> Any:
    """A config resolved, every key known to the dataclass and every value of its type (`1` becomes 1.0 for a float).

    Args:
        cfg: DictConfig.
        complete: refuse values that are still `???`.
    Raises:
        ValueError: one line that names the key, what was expected and what was found.
    """
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    hints = typing.get_type_hints(schema)
    known = fields(schema)
    checked: dict[str, Any] = {}
    typed = OmegaConf.structured(schema)
    for name in cfg:
        key = f"{prefix}{name}"
        if name not in known:
            raise ValueError(f"unknown key '{key}': did you mean '{prefix}{nearest_key(str(name), list(known))}'?")
        text = known[name].metadata["doc"]
        if OmegaConf.is_missing(cfg, name):
            if complete:
                raise ValueError(f"{key}=... is required: {text}")
            checked[name] = "???"
            continue
        try:
            value = cfg[name]
        except OmegaConfBaseException as error:
            raise ValueError(f"{key}: {str(error).splitlines()[0]}") from None
        if dataclasses.is_dataclass(hints[name]):
            if not isinstance(value, DictConfig | types.NoneType):
                raise ValueError(f"{key}={value}: expected a group of keys ({key}.KEY=VALUE) or one of its choices")
            checked[name] = value and check(value, typing.cast(type, hints[name]), complete=complete, prefix=f"{key}.")
            continue
        try:
            typed[name] = value
        except OmegaConfBaseException:
            raise ValueError(f"{key}={value}: expected {type_name(hints[name])} ({text})") from None
        checked[name] = typed[name]
    return OmegaConf.create(checked)


def type_name(hint: Any) -> str:
    if hint is type(None):
        return "null"
    if isinstance(hint, types.UnionType):
        return " or ".join(type_name(part) for part in typing.get_args(hint))
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)
