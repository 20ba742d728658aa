"""What people type, as the `key=value` that Hydra reads: names of files alone, `--key value`, `-i` and `-o`, ~/."""

import typing
from collections.abc import Mapping, Sequence
from pathlib import Path

from pnu.config import quoting
from pnu.config.schema import fields, file_keys, nearest_key

# options of Hydra: whether a value follows
HYDRA = {
    **dict.fromkeys(("--help", "-h", "--hydra-help", "--version", "--resolve", "--run", "-r"), False),
    **dict.fromkeys(("--multirun", "-m", "--shell-completion", "-sc"), False),
    **dict.fromkeys(("--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn"), True),
    **dict.fromkeys(("--config-dir", "-cd", "--experimental-rerun", "--info", "-i"), True),
}
INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
LETTERS = {"-i": "input", "-o": "output"}


def keyed(arguments: Sequence[str], schema: type) -> list[str]:
    """The arguments of a command, as options of Hydra and `key=value` alone.

    Names of files that stand alone go to the keys that `file_keys` names: `scan.ply mesh.ply` is `input=scan.ply
    output=mesh.ply`. `--ratio 8` and `--ratio=8` are `ratio=8`, `--quiet` is `quiet=true`.

    Raises:
        ValueError: an option that neither the command nor Hydra has, one without its value, or more names than keys.
    """
    known, types = {*fields(schema), *getattr(schema, "also", {})}, typing.get_type_hints(schema)
    left = [*arguments]
    names: list[str] = []
    rest: list[str] = []
    while left:
        argument = left.pop(0)
        option, equals, value = argument.partition("=")
        key = LETTERS.get(option, option.lstrip("-").replace("-", "_"))
        own = key.partition(".")[0] in known
        if not argument.startswith("-"):
            (rest if equals or (argument.startswith("~") and argument[1:2] != "/") else names).append(argument)
        elif option in HYDRA and not (own and (equals or (option == "-i" and left and left[0] not in INFO))):
            rest.append(argument)
            if HYDRA[option] and not equals and left and (option not in ("-i", "--info") or left[0] in INFO):
                rest.append(left.pop(0))
        elif not own:
            near = nearest_key(key, sorted(fields(schema)))
            raise ValueError(f"unknown option {option}: keys are given as key=value, is {near}=... meant?")
        elif equals or types.get(key) is bool:
            rest.append(f"{key}={value if equals else 'true'}")
        elif not left or left[0].startswith("--") or ("=" in left[0] and left[0].partition("=")[0] in known):
            raise ValueError(f"{option}: expected a value, {key}=...")
        else:
            rest.append(f"{key}={left.pop(0)}")
    also, commas = getattr(schema, "also", {}), getattr(schema, "commas", ())
    rest = [argument if argument.startswith("-") else renamed(argument, also, commas) for argument in rest]
    return [*of_files([str(Path(name).expanduser()) for name in names], rest, schema), *rest]


def of_files(names: Sequence[str], rest: Sequence[str], schema: type) -> list[str]:
    """Names of files that stand alone, as `key=value`; keys that are given otherwise are passed over."""
    keys = file_keys(schema)
    if isinstance(keys, str):
        return [quoting.override(keys, [*names])] if names else []
    free = [key for key in keys if not any(argument.startswith(f"{key}=") for argument in rest)]
    if len(names) > len(free):
        cure = "--help lists the keys" if not keys else f"one for each of {', '.join(keys)} can stand alone"
        raise ValueError(f"cannot read {names[len(free)]!r}: expected key=value; {cure}")
    return [quoting.override(key, name) for key, name in zip(free, names, strict=False)]


def renamed(argument: str, names: Mapping[str, str], commas: Sequence[str] = ()) -> str:
    """An argument as Hydra shall see it: the key by its first name, and ~/ expanded, which shells leave after `=`.

    commas: keys whose values hold commas, which would be several values to Hydra.
    """
    key, equals, value = argument.partition("=")
    if key in commas and "," in value and not value.startswith(('"', "'")):
        value = f'"{value.strip("[] ")}"'
    if value.startswith("~/"):
        value = str(Path(value).expanduser())
    return f"{names.get(key, key)}{equals}{value}"
