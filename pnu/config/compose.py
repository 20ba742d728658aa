"""Compose a command's config with Hydra; its long errors become one-line `ValueError`s."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

from pnu.config.instantiate import GIVEN
from pnu.config.quoting import quoted
from pnu.config.schema import (
    Groups,
    checked_config,
    class_arguments,
    config_folder,
    fields,
    groups,
    known_keys,
    nearest_key,
    nested_class,
    no_use,
    unsaid_keys,
)
from pnu.config.signature import arguments

OVERLAYS = ("experiment", "scale", "debug", "ablation")
EXTRAS = dict.fromkeys(("joblib", "submitit_local", "submitit_slurm", "optuna"), "sweeps") | {"ray": "ray"}


@contextmanager
def composer(name: str, extra_folder: str | None = None) -> Iterator[Callable[..., Any]]:
    """Gives compose(overrides) -> DictConfig for conf/<name>.yaml; Hydra's long errors become one-line ValueErrors.

    What it gives is shared by all who ask for the same, and read-only.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException, MissingConfigException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    search_path = [f"hydra.searchpath=[file://{Path(extra_folder).absolute()}]"] if extra_folder else []
    # files of an extra folder may change between two commands of a process, those of pnu do not
    composed = composed_afresh if extra_folder else composed_once

    def compose(overrides: list[str], return_hydra_config: bool = False) -> Any:
        try:
            cfg = composed(name, (*overrides, *search_path))
            if return_hydra_config:
                return cfg
            own = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
            OmegaConf.set_struct(own, True)
            return own
        except MissingConfigException as error:
            missing = error.missing_cfg_file or "?"
            group, _, choice = missing.removesuffix("/").rpartition("/")
            choice += missing[len(group) + 1 + len(choice) :]  # data=FOLDER/
            if group in ("hydra/launcher", "hydra/sweeper") and choice in EXTRAS:
                raise ValueError(f"{group}={choice}: is not here; pip install 'pnu[{EXTRAS[choice]}]'") from None
            known = ", ".join(sorted(error.options or []))
            raise ValueError(f"{group}={choice}: expected one of {known}" if known else one_line(error)) from None
        except (HydraException, OmegaConfBaseException) as error:
            cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
            raise ValueError(str(cause).strip().splitlines()[0]) from None

    before = GlobalHydra.instance().hydra
    try:
        GlobalHydra.instance().clear()
        with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
            yield compose
    finally:
        GlobalHydra.instance().hydra = before


def composed_afresh(name: str, overrides: tuple[str, ...]) -> Any:
    """conf/<name>.yaml with overrides, Hydra's own config too, read-only; Hydra is initialized."""
    import hydra
    from omegaconf import OmegaConf

    cfg = hydra.compose(name, list(overrides), return_hydra_config=True)
    OmegaConf.set_readonly(cfg, True)
    return cfg


composed_once = lru_cache(maxsize=64)(composed_afresh)  # a command asks several times, at a quarter of a second each


def compose_config(
    schema: type, overrides: Sequence[str] = (), name: str | None = None, *, complete: bool = True
) -> Any:
    """The checked config of a command, as its function gets it. For use from Python and in tests."""
    with composer(name or schema.__name__.lower()) as compose:
        spelled = spell(list(overrides), schema, compose)
        check_keys(spelled, schema, compose)
        return checked(spelled, schema, compose, complete=complete)


def checked(overrides: Sequence[str], schema: type, compose: Callable[..., Any], *, complete: bool = True) -> Any:
    """The config that overrides describe, as a command's function gets it."""
    from omegaconf import OmegaConf

    cfg = compose(list(overrides), True)
    own, _ = fitted(OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"]), cfg.hydra, schema, overrides)
    return checked_config(own, schema, complete=complete)


def printed(
    overrides: Sequence[str], schema: type, compose: Callable[..., Any], package: str | None, *, resolve: bool
) -> str:
    """What `--cfg job` prints: the config as `checked` makes it for the command, as YAML.

    Args:
        package: the part of it to print, null: all.
        resolve: with the values of references; without, what refers to another key does so still.

    Raises:
        ValueError: a value that does not fit, or no such package.
    """
    from omegaconf import Container, OmegaConf

    cfg = checked(overrides, schema, compose, complete=False)
    if not resolve:
        plain: Any = OmegaConf.to_container(cfg)
        written: Any = OmegaConf.to_container(compose(list(overrides)))
        for key, value in flatten(written).items():
            if key in flatten(plain) and isinstance(value, str) and "${" in value:
                OmegaConf.update(cfg, key, value)
    if package in (None, "_global_"):
        return OmegaConf.to_yaml(cfg)
    found = OmegaConf.select(cfg, str(package))
    if found is None:
        raise ValueError(f"package {package}: is not in the config")
    return f"# @package {package}\n{OmegaConf.to_yaml(found)}" if isinstance(found, Container) else f"{found}\n"


def parse(overrides: list[str]) -> list[Any]:
    """Overrides as Hydra's parser reads them; `ValueError` with a hint on quotes."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    parsed = []
    for override in overrides:
        try:
            parsed += parser.parse_overrides([override])
        except HydraException:
            key, equals, value = override.partition("=")
            hint = f"special characters want quotes, {quoted(key, value)}" if equals else "expected key=value"
            raise ValueError(f"cannot read {override!r}: {hint}") from None
    return parsed


def variations(overrides: list[str]) -> Iterator[list[str]]:
    """Override lists in which each value of each sweep (`a=1,2 b=x,y`) appears once: the sum, not the product."""
    parsed = parse(overrides)
    values = []
    for raw, override in zip(overrides, parsed, strict=True):
        if (
            override.is_sweep_override()
            and override.is_discrete_sweep()
            and override.value_type.name != "GLOB_CHOICE_SWEEP"
        ):
            key = override.get_key_element()
            values.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        elif override.is_sweep_override():  # an interval or a pattern: the sweeper knows its values
            values.append([])
        else:
            values.append([raw])
    first = [options[:1] for options in values]
    yield list(chain(*first))
    for i, options in enumerate(values):
        for option in options[1:]:
            yield list(chain(*first[:i], [option], *first[i + 1 :]))


def check_single(overrides: list[str]) -> None:
    """Refuse several values of a key where one run is wanted."""
    for raw, override in zip(overrides, parse(overrides), strict=True):
        if override.is_sweep_override():
            key, _, value = raw.partition("=")
            raise ValueError(
                f"{raw}: for one run with each value, add -m; a comma in a value wants quotes, {quoted(key, value)}"
            )


def spell(overrides: list[str], schema: type, compose: Callable[..., Any]) -> list[str]:
    """Overrides as Hydra wants them: `++key=value` for an argument that conf/ does not show, and wherever a `+` is.

    `check_keys` has the last word on whether there is such a key, so a `+` has nothing to say.
    """
    from omegaconf import OmegaConf

    parsed = parse(overrides)
    if not any("." in override.key_or_group for override in parsed):
        return overrides
    choices = choices_of(compose)
    # Hydra composes a sweep without what it sweeps over at first
    chosen = [
        raw
        for raw, override in zip(overrides, parsed, strict=True)
        if override.key_or_group in choices and not override.is_sweep_override()
    ]
    shown = flatten(OmegaConf.to_container(compose(chosen)))
    spelled = []
    for raw, override in zip(overrides, parsed, strict=True):
        key = override.key_or_group
        plain = raw.lstrip("+")
        mine = key not in choices and key.partition(".")[0] in groups(schema) and not override.is_delete()
        spelled.append(f"++{plain}" if mine and (key not in shown or plain != raw) else raw)
    return spelled


def choices_of(compose: Callable[..., Any]) -> list[str]:
    """The groups of conf/ that an override may choose from."""
    return list(compose([], return_hydra_config=True).hydra.runtime.choices)


def check_keys(overrides: list[str], schema: type, compose: Callable[..., Any]) -> None:
    """Refuse overrides of keys that do not exist, naming the nearest one that does."""
    parsed = parse(overrides)
    if not any(override.is_delete() or _may_be_wrong(override.key_or_group, schema) for override in parsed):
        return  # as in most commands; composing to find that out takes a tenth of a second
    choices = choices_of(compose)
    own = [override for override in parsed if override.key_or_group not in choices]
    for override in parsed:
        key = override.key_or_group
        if key in choices and not isinstance(override.value(), str | list | None):
            raise ValueError(f"{key}={override.value()}: expected one of {', '.join(group_choices(key))}")
    for override in own:
        if override.key_or_group.partition(".")[0] not in fields(schema):
            raise unknown(override.key_or_group, schema, choices)
    # what is deleted must be there before
    before = compose([raw for raw, override in zip(overrides, parsed, strict=True) if not override.is_delete()])
    for override in own:
        check_key(override.key_or_group, before, schema, choices)


def _may_be_wrong(key: str, schema: type) -> bool:
    """Whether a key is not simply one of the command's own, and no group."""
    return key not in fields(schema) or (config_folder() / key).is_dir()


def check_key(key: str, cfg: Any, schema: type, choices: Sequence[str]) -> None:
    """Refuse a dotted key that is no argument of the class that its group has in a composed config."""
    top, *parts = key.split(".")
    kind = groups(schema).get(top)
    if not parts:
        return
    if kind is None:
        raise unknown(key, schema, choices)
    if parts[-1] in GIVEN.get(top, {}):
        raise ValueError(f"{key}: {GIVEN[top][parts[-1]]}")
    node = cfg[top]
    if kind is Groups and "_target_" not in (node or {}):
        name, *parts = parts
        if name not in (node or {}) or (parts and "_target_" not in (node[name] or {})):
            raise unused(key, schema, choices)
        node = node[name]
    if not parts or parts[0].startswith("_"):
        return
    if not node or "_target_" not in node:
        raise unused(key, schema, choices)
    known = class_arguments(top, str(node["_target_"]), cfg.get("allow") or ())
    argument = known.get(parts[0]) or known.get("**")
    if argument is None:
        raise unused(key, schema, choices, [f"{top}.{name}" for name in known if name not in GIVEN.get(top, {})])
    nested = nested_class(argument.hint)
    if len(parts) > 1 and nested is not None and parts[1] not in (arguments(nested.target) or {}):
        raise unknown(key, schema, choices)


def unknown(key: str, schema: type, choices: Sequence[str], more: Sequence[str] = ()) -> ValueError:
    """The error for a key that does not exist: it names the nearest known one."""
    others = [choice for choice in choices if not choice.startswith("hydra/")]
    nearest = nearest_key(key, [*known_keys(schema), *others, *more], unsaid_keys(schema))
    return ValueError(f"unknown key '{key}': did you mean '{nearest}'?")


def unused(key: str, schema: type, choices: Sequence[str], more: Sequence[str] = ()) -> ValueError:
    """Of a key that this choice of its group does not have: whether another has it."""
    if key in known_keys(schema):
        return ValueError(no_use(key.partition(".")[0], key))
    return unknown(key, schema, choices, more)


def fitted(cfg: Any, hydra: Any, schema: type, overrides: Sequence[str]) -> tuple[Any, list[str]]:
    """A config without what an overlay (experiment, scale, debug) says to a class that has no such argument.

    An overlay fits every choice of the groups so: scale=small names the size of patches, of which data=surface has
    none. What the command line says, and a setting of an ablation, stays for `check` to refuse.

    Args:
        hydra: Hydra's own config: which files were chosen.
        overrides: of the command line.

    Returns:
        The config, and the keys that were left out.
    """
    from omegaconf import OmegaConf

    given = [override.key_or_group for override in parse(list(overrides))]
    overlaid = {key for overlay in OVERLAYS for key in overlay_keys(hydra.runtime, overlay)}
    plain: Any = OmegaConf.to_container(cfg)
    left: list[str] = []
    for group, kind in groups(schema).items():
        node = plain.get(group)
        if not isinstance(node, dict):
            continue
        several = kind is Groups and "_target_" not in node
        parts = {f"{group}.{name}.": one for name, one in node.items()} if several else {f"{group}.": node}
        for prefix, one in parts.items():
            if not isinstance(one, dict):
                continue
            replaced = f"{prefix}_target_" in given  # what conf/ says to the class that stood there
            for name in misfits(one, group, plain.get("allow") or ()):
                key = f"{prefix}{name}"
                if key not in given and (key in overlaid or replaced):
                    del one[name]
                    left.append(key)
            if several and not one:
                del node[prefix.split(".")[1]]
    return (OmegaConf.create(plain) if left else cfg), left


def misfits(node: dict[str, Any], group: str, allow: Sequence[str]) -> list[str]:
    """The keys of a group that its class has no argument for."""
    target = node.get("_target_")
    try:
        known = class_arguments(group, str(target), allow) if target else {}
    except ValueError:  # `check` tells
        return []
    return [name for name in node if not name.startswith("_") and name not in known and "**" not in known]


def overlay_keys(runtime: Any, overlay: str) -> set[str]:
    """The dotted keys that the chosen file of an overlay, and those it builds on, set."""
    from omegaconf import OmegaConf

    keys: set[str] = set()
    waiting = [runtime.choices.get(overlay)]
    while waiting:
        choice = waiting.pop()
        folders = [Path(source.path) for source in runtime.config_sources if source.schema == "file"]
        path = next((p for folder in folders if (p := folder / overlay / f"{choice}.yaml").is_file()), None)
        if choice is None or path is None:
            continue
        content: Any = OmegaConf.to_container(OmegaConf.load(path))
        waiting += [base for base in content.pop("defaults", []) if isinstance(base, str) and base != "_self_"]
        keys |= flatten(content).keys()
    return keys


def said(left: Sequence[str], choices: Mapping[str, Any]) -> str:
    """The line on what `fitted` left out."""
    overlays = ", ".join(f"{overlay}={choices[overlay]}" for overlay in OVERLAYS if choices.get(overlay))
    return f"left out, since nothing here takes them: {', '.join(left)}" + (f" ({overlays})" if overlays else "")


def group_choices(group: str) -> list[str]:
    """What `group=...` may be."""
    return sorted(path.stem for path in (config_folder() / group).glob("*.yaml"))


def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Every node of nested dicts under its dotted key."""
    nodes = {}
    for name, value in tree.items():
        nodes[f"{prefix}{name}"] = value
        if isinstance(value, dict):
            nodes |= flatten(value, f"{prefix}{name}.")
    return nodes


def in_multirun() -> bool:
    """Whether the code runs as one job of several that a sweeper started."""
    from hydra.core.hydra_config import HydraConfig

    return HydraConfig.initialized() and str(HydraConfig.get().mode) == "RunMode.MULTIRUN"


def one_line(error: BaseException) -> str:
    """An exception's message on one line."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__
