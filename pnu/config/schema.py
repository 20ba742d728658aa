"""Which keys a command's config has, of which type, with a line on each.

The keys of a command itself are fields of its dataclass. Those of a group (`Group`) are the arguments of the class that
the group's `_target_` names, as `pnu.config.signature` reads them from its source: an argument is described where it is
made. The same words stand in `--help`, in error messages and in docs/config.md. What a config does not say has the
constructor's default; classes of libraries keep theirs unsaid.
"""

import dataclasses
import difflib
import functools
import importlib.util
import re
import types
import typing
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pnu.config.instantiate import GIVEN, NEEDS, PACKAGES, is_within, present_name
from pnu.config.signature import (
    REQUIRED,
    Argument,
    Class,
    Union,
    arguments,
    default_arguments,
    first_sentence,
    members_of,
)
from pnu.extras import EXTRAS, require

PACKAGE = Path(__file__).resolve().parents[1]
OWN = {  # keys of every group that are Hydra's
    "_target_": Argument("_target_", str, REQUIRED, "class"),
    "_partial_": Argument("_partial_", bool, False, "true: training adds what is missing"),
}


class Group:
    """The type of a key that is a group: its keys are the arguments of the class that `_target_` names."""


class Groups(Group):
    """Of a key that holds several such groups, each under a name of its own."""


def doc(text: str) -> Any:
    """A field of a command's dataclass: its documentation. The value stands in conf/, and only there."""
    return dataclasses.field(default="???", metadata={"doc": text})


def fields(schema: type) -> dict[str, dataclasses.Field[Any]]:
    """The fields of a command's dataclass, by name."""
    return {field.name: field for field in dataclasses.fields(schema)}


def file_keys(schema: type) -> str | tuple[str, ...]:
    """The keys that names of files standing alone are given to, or the key of the list of them: `files` of a schema."""
    if {"input", "output"} <= fields(schema).keys():
        return "input", "output"
    found: str | tuple[str, ...] = getattr(schema, "files", ())
    return found


def groups(schema: type) -> dict[str, type[Group]]:
    """The groups among a command's keys."""
    hints = typing.get_type_hints(schema)
    return {
        name: hints[name] for name in fields(schema) if isinstance(hints[name], type) and issubclass(hints[name], Group)
    }


def config_folder() -> Path:
    """conf/ beside the package in a checkout, inside it in an installed wheel."""
    for folder in (PACKAGE / "conf", PACKAGE.parent / "conf"):
        if (folder / "command.yaml").is_file():
            return folder
    raise FileNotFoundError(f"no conf/ folder in or beside {PACKAGE}: the installation is not complete")


# --- the arguments of a group's class ---


def class_arguments(group: str, target: str, allow: Sequence[str] = ()) -> dict[str, Argument]:
    """What a config may set of the class of that dotted name; under "**" what else it takes, if anything.

    Raises:
        ValueError: the class does not belong to the group's packages or those of `allow`, or is not there.
    """
    packages = (*PACKAGES[group], *allow)
    expected = f"_target_={target}: expected a class of {' or '.join(PACKAGES[group])}"
    if not any(is_within(target, package) for package in packages):
        raise ValueError(f"{group}.{expected}; allow=[{target.partition('.')[0]}] lets a package of your own define it")
    found = arguments(target)
    if found is None:
        if (package := target.partition(".")[0]) in EXTRAS:
            require(package, f"{group}._target_={target}")
        raise ValueError(f"{group}.{expected}, found no such class" + (f" in {', '.join(allow)} either" * bool(allow)))
    return {name: argument._replace(words=words(group, target, argument)) for name, argument in found.items()}


def words(group: str, target: str, argument: Argument) -> str:
    """The line on an argument. Of a library's class: the comment in conf/, or the start of the library's own words."""
    if not library(target):
        return argument.words
    return comments(group).get(argument.name) or first_sentence(argument.words)


@functools.cache
def comments(group: str) -> dict[str, str]:
    """The comments behind values in the files of a group, by key."""
    found: dict[str, str] = {}
    for path in sorted((config_folder() / group).glob("*.yaml")):
        for key, text in re.findall(r"^ *(\w+):.*?\S +# (.+)$", path.read_text(encoding="utf-8"), re.M):
            found.setdefault(key, text)
    return found


def library(target: str) -> bool:
    """Whether a class is a library's, whose defaults are its own affair."""
    return target.partition(".")[0] in ("torch", "lightning")


@functools.cache
def targets(group: str) -> dict[str, dict[str, str]]:
    """The classes of a group's files: {choice: {name of the group in it, or "": _target_}}."""
    import yaml

    found = {}
    for path in sorted((config_folder() / group).glob("*.yaml")):
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        named = {"": content} | {key: value for key, value in content.items() if isinstance(value, dict)}
        found[path.stem] = {name: str(one["_target_"]) for name, one in named.items() if "_target_" in one}
    return found


def unsaid_keys(schema: type) -> set[str]:
    """The keys of libraries' classes that conf/ does not name: few mean them."""
    found = set()
    for group in groups(schema):
        said = comments(group)
        for named in targets(group).values():
            for name, target in named.items():
                if library(target):
                    prefix = f"{group}.{name}." if name else f"{group}."
                    found |= {prefix + key for key in class_arguments(group, target) if key not in said}
    return found


def known_keys(schema: type) -> dict[str, str]:
    """Every key that a command may have with any choice of its groups, dotted, and the line on it."""
    keys = {name: field.metadata["doc"] for name, field in fields(schema).items()}
    for group in groups(schema):
        for named in targets(group).values():
            for name, target in named.items():
                prefix = f"{group}.{name}." if name else f"{group}."
                keys |= {prefix.rstrip("."): fields(schema)[group].metadata["doc"]}
                for key, argument in settable(group, class_arguments(group, target)):
                    keys.setdefault(prefix + key, argument.words)
    return keys


def settable(group: str, known: Mapping[str, Argument]) -> Iterator[tuple[str, Argument]]:
    """The arguments that a config may set, those of arguments that are groups themselves under dotted keys."""
    for name, argument in known.items():
        if name != "**" and name not in GIVEN.get(group, {}):
            yield name, argument
            if nested := nested_class(argument.hint):
                yield from ((f"{name}.{key}", inner) for key, inner in (arguments(nested.target) or {}).items())


def nested_class(hint: Any) -> Class | None:
    """The class whose arguments a group within a group holds."""
    return next((member for member in members_of(hint) if isinstance(member, Class)), None)


def nearest_key(key: str, known: Sequence[str], rare: Container[str] = ()) -> str:
    """The known key that a mistyped one most likely means, by its whole or last part (epochs: trainer.max_epochs)."""

    def likeness(candidate: str) -> float:
        whole = difflib.SequenceMatcher(None, key, candidate).ratio()
        last = difflib.SequenceMatcher(None, key.rpartition(".")[2], candidate.rpartition(".")[2]).ratio()
        return max(whole, (0.6 if candidate in rare else 0.9) * last)

    return max(known, key=likeness)


# --- check ---


def checked_config(cfg: Any, schema: type, *, complete: bool = True) -> Any:
    """A config resolved and filled up: every key known, every value of its type (`1` becomes 1.0 for a float).

    Args:
        cfg: DictConfig.
        complete: refuse values that are still `???`.
    Raises:
        ValueError: one line that names the key, what was expected and what was found.
    """
    from omegaconf import OmegaConf

    hints = typing.get_type_hints(schema)
    known = {name: Argument(name, hints[name], REQUIRED, f.metadata["doc"]) for name, f in fields(schema).items()}
    allow = tuple(cfg.get("allow") or ()) if "allow" in known else ()
    checked: dict[str, Any] = {}
    for name in cfg:
        if name not in known:
            raise ValueError(f"unknown key '{name}': did you mean '{nearest_key(str(name), list(known))}'?")
        value = get(cfg, name, name, known[name].words, complete=complete)
        kind = groups(schema).get(name)
        if kind is None:
            checked[name] = value if is_missing(value) else converted(value, known[name], name)
        elif value is not None and not isinstance(value, Mapping):
            raise ValueError(f"{name}={value}: expected a group of keys ({name}.KEY=VALUE) or one of its choices")
        elif kind is Groups and "_target_" not in (value or {}):
            checked[name] = {
                one: check_group(node, name, f"{name}.{one}.", allow, complete=complete)
                for one, node in (value or {}).items()
            }
        else:
            checked[name] = value if value is None else check_group(value, name, f"{name}.", allow, complete=complete)
    return OmegaConf.create(checked)


def check_group(cfg: Any, group: str, prefix: str, allow: Sequence[str], *, complete: bool) -> dict[str, Any]:
    """A group as its class takes it, with the defaults of what it does not say."""
    if not isinstance(cfg, Mapping):
        raise ValueError(f"{prefix.rstrip('.')}={cfg}: expected a group of keys, such as {prefix}_target_=CLASS")
    target = cfg.get("_target_")
    if target is None:
        if cfg:
            raise ValueError(no_use(group, f"{prefix}{next(iter(cfg))}"))
        return {}
    target = present_name(str(target))
    try:
        known = class_arguments(group, target, allow)
    except ValueError as error:
        raise ValueError(str(error).replace(f"{group}.", prefix, 1)) from None
    needed = NEEDS.get(target.rpartition(".")[2])
    if complete and needed and importlib.util.find_spec(needed) is None:
        raise ValueError(f"{prefix.rstrip('.')}: needs {needed}, which is not here; pip install 'pnu[{needed}]'")
    checked = check_arguments(cfg, group, prefix, known, complete=complete)
    defaults = {} if library(target) else default_arguments(dict(settable_here(group, known)))
    return {**defaults, **checked, "_target_": target}


def settable_here(group: str, known: Mapping[str, Argument]) -> Iterator[tuple[str, Argument]]:
    """Which arguments of a group the config may set."""
    return ((key, argument) for key, argument in settable(group, known) if "." not in key)


def check_arguments(
    cfg: Mapping[str, Any], group: str, prefix: str, known: Mapping[str, Argument], *, complete: bool
) -> dict[str, Any]:
    """The keys of a group, each known and of its type."""
    checked: dict[str, Any] = {}
    given = GIVEN.get(group, {})
    for name in map(str, cfg):
        key = f"{prefix}{name}"
        argument = {**OWN, **known}.get(name) or known.get("**")
        if name in given and name in known:
            raise ValueError(f"{key}: {given[name]}")
        if argument is None:
            others = {key for key in all_arguments(group) if "." not in key}
            if name in others:
                raise ValueError(no_use(group, key))
            candidates = [key for key, _ in settable_here(group, known)] or ["_target_"]
            raise ValueError(f"unknown key '{key}': did you mean '{prefix}{nearest_key(name, candidates)}'?")
        value = get(cfg, name, key, argument.words, complete=complete)
        nested = nested_class(argument.hint)
        if nested is not None and isinstance(value, Mapping):
            inner = arguments(nested.target) or {}
            found = check_arguments(value, "", f"{key}.", inner, complete=complete)
            checked[name] = default_arguments(inner) | found
        else:
            checked[name] = value if is_missing(value) else converted(value, argument, key)
    for name, argument in settable_here(group, known):
        if name not in cfg and argument.default is REQUIRED and complete and name != "**":
            raise ValueError(f"{prefix}{name}=... is required: {argument.words}")
    return checked


def no_use(group: str, key: str) -> str:
    """Why a key that another class of the group takes means nothing here, and with which choices it does."""
    having = [
        choice
        for choice, named in targets(group).items()
        for name, target in named.items()
        for inner, _ in settable(group, class_arguments(group, target))
        if key == ".".join(filter(None, (group, name, inner)))
    ]
    cure = (
        f"it is one of {' or '.join(f'{group}={choice}' for choice in having)}" if having else "--help shows its keys"
    )
    return f"key '{key}' has no use with this {group}: {cure}"


@functools.cache
def all_arguments(group: str) -> frozenset[str]:
    """What any class of the group's files takes."""
    found = (class_arguments(group, target) for named in targets(group).values() for target in named.values())
    return frozenset(key for known in found for key, _ in settable(group, known))


def get(cfg: Any, name: str, key: str, text: str, *, complete: bool) -> Any:
    """A value of a config, its references resolved; "???" where it is to be given."""
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if isinstance(cfg, DictConfig) and OmegaConf.is_missing(cfg, name):
        if complete:
            raise ValueError(f"{key}=... is required: {text}")
        return "???"
    try:
        return cfg[name]
    except OmegaConfBaseException as error:
        raise ValueError(f"{key}: {str(error).splitlines()[0]}") from None


def is_missing(value: Any) -> bool:
    """Whether a value is still to be given, ???."""
    return isinstance(value, str) and value == "???"


# --- types ---


def converted(value: Any, argument: Argument, key: str) -> Any:
    """A value as its argument's type has it; `ValueError` names the key."""
    from omegaconf import OmegaConf

    try:
        plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
        return as_type(plain, argument.hint)
    except TypeError:
        text = f" ({argument.words})" if argument.words else ""
        raise ValueError(f"{key}={value}: expected {type_name(argument.hint)}{text}") from None


def as_type(value: Any, hint: Any) -> Any:
    """A value as a type wants it: first as it is, then as YAML may have meant it (1 for 1.0, 7 for "7").

    Raises:
        TypeError: it is none.
    """
    members = members_of(hint)
    for attempt in (exact, meant):
        for member in members:
            try:
                return attempt(value, member)
            except (TypeError, ValueError):
                continue
    raise TypeError


def exact(value: Any, hint: Any) -> Any:
    """Whether a value is of a type as it stands."""
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin is Any:
        return value
    if origin is typing.Literal:
        right = any(type(choice) is type(value) and choice == value for choice in inner)
    elif origin is list and isinstance(value, list):
        return [as_type(item, inner[0]) for item in value] if inner else value
    elif origin is tuple and isinstance(value, list) and len(value) == len(inner):
        return [as_type(item, one) for item, one in zip(value, inner, strict=True)]
    elif origin in (bool, int, float, str, type(None)):
        right = type(value) is origin
    else:
        right = origin is dict and isinstance(value, dict)
    if not right:
        raise TypeError
    return value


def meant(value: Any, hint: Any) -> Any:
    """A value as the type that was meant, 1 as 1.0 for a float; None where it is none."""
    if hint is float and type(value) in (int, str):
        return float(value)
    if hint is int and type(value) is str:
        return int(value)
    if hint is str and type(value) in (bool, int, float):
        return str(value)
    if hint is bool and str(value).lower() in ("yes", "on", "true", "1", "no", "off", "false", "0"):
        return str(value).lower() in ("yes", "on", "true", "1")
    if typing.get_origin(hint) is typing.Literal and str(value) in typing.get_args(hint):
        return str(value)
    raise TypeError


def type_name(hint: Any) -> str:
    """A type as an error message and the docs name it."""
    if isinstance(hint, Union | types.UnionType) or len(members_of(hint)) > 1:
        parts = sorted(members_of(hint), key=lambda part: part is type(None))
        return " or ".join(dict.fromkeys(type_name(part) for part in parts))
    if hint is type(None):
        return "null"
    if hint is dict or isinstance(hint, Class):
        return "a group of keys"
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return " or ".join(map(str, inner))
    if origin is list:
        return f"list of {type_name(inner[0])}" if inner[0] is not Any else "list"
    if origin is tuple:
        return f"list of {len(inner)} {type_name(inner[0])}"
    return hint.__name__ if isinstance(hint, type) else "any value"
