"""The text of `--help`: every key with its present value and its line of documentation."""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pnu.config.compose import group_choices
from pnu.config.instantiate import PACKAGES
from pnu.config.schema import Groups, class_arguments, fields, file_keys, groups, library, nested_class, settable
from pnu.config.signature import Argument, arguments, summary


def as_typed(value: Any) -> str:
    """A value as one types it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def written(path: Path) -> Any:
    """What Hydra composes of a file of conf/ where the command line says nothing, without waiting for Hydra.

    The defaults list may hold files beside this one, a choice for each group and `_self_`; what it overrides of Hydra's
    own, and the key `hydra`, are left out. None where a file asks for more.
    """
    from omegaconf import OmegaConf

    if not path.is_file() or "@package" in path.read_text(encoding="utf-8"):
        return None
    own: Any = OmegaConf.load(path)
    own.pop("hydra", None)
    defaults = own.pop("defaults", [])
    parts = []
    for entry in defaults if "_self_" in defaults else [*defaults, "_self_"]:
        if entry == "_self_":
            parts.append(own)
        elif isinstance(entry, str):
            parts.append(written(path.with_name(f"{entry}.yaml")))
        else:
            for group, choice in entry.items():
                if choice is not None and not group.startswith("override "):
                    part = written(path.parent / group / f"{choice}.yaml")
                    parts.append(None if part is None else {group: part})
    return None if any(part is None for part in parts) else OmegaConf.merge(*parts)


def help_text(schema: type, program: str, cfg: Any) -> str:
    """What a command does, and for every key its present value and its line of documentation."""
    from omegaconf import OmegaConf

    keys = file_keys(schema)
    alone = f"[{keys.upper()} ...] " if isinstance(keys, str) else "".join(f"[{key.upper()}] " for key in keys)
    usage = f"usage: {program} {alone}[key=value ...]      (-m key=a,b: one run for each value)"
    lines = [usage, "", inspect.getdoc(schema) or "", ""]
    kinds = groups(schema)
    # groups last: keys of the command itself below a group would look like the group's
    for name, field in fields(schema).items():
        if name not in kinds and name in list(cfg):  # `in cfg` would leave out those that are still ???
            lines.append(line(name, "..." if OmegaConf.is_missing(cfg, name) else cfg[name], field.metadata["doc"]))
    for name, kind in kinds.items():
        if name not in list(cfg):
            continue
        options = group_choices(name)
        lines.append(
            f"\n{fields(schema)[name].metadata['doc']}" + (f" ({name}={'|'.join(options)})" if options else "")
        )
        content = cfg[name] or {}
        allow = cfg.get("allow") or ()
        if kind is Groups and "_target_" not in content:
            for one, arguments_ in content.items():
                lines += [f"\n{name}.{one}: {summary(str(arguments_['_target_']))}"]
                lines += group_lines(arguments_, name, f"{name}.{one}.", allow)
        else:
            lines += group_lines(content, name, f"{name}.", allow)
    return "\n".join(lines)


def group_lines(content: Any, group: str, prefix: str, allow: Any) -> Iterator[str]:
    """The lines on a group's keys; of a library's class those in use, and the names of the others."""
    if "_target_" not in content:
        return
    target = str(content["_target_"])
    known = {**dict(settable(group, class_arguments(group, target, allow)))}
    nested_last = sorted(content.items(), key=lambda item: item[0] in known and bool(nested_class(known[item[0]].hint)))
    for key, value in nested_last:
        if key.startswith("_"):  # Hydra's, set by the choice of a group
            continue
        argument = known.get(key) or Argument(key, Any, None, "")
        nested = nested_class(argument.hint)
        if nested is not None and value is not None:
            yield f"\n{prefix}{key}: {argument.words}"
            inner = arguments(nested.target) or {}
            yield from (line(f"{prefix}{key}.{name}", one, inner[name].words) for name, one in value.items())
        else:
            yield line(f"{prefix}{key}", value, argument.words)
    unsaid = [key for key in known if key not in content and "." not in key]
    if library(target) and unsaid:
        yield f"  also arguments of {target}: {', '.join(unsaid)}"


def line(key: str, value: Any, words: str) -> str:
    """One key of the help."""
    return f"  {key + '=' + (value if value == '...' else as_typed(value)):<40} {words}".rstrip()


def reference() -> str:
    """docs/config.md: the arguments of every class that conf/ names, as `--help` has them."""
    import yaml

    from pnu.config.schema import config_folder, targets, type_name
    from pnu.config.signature import REQUIRED, UNREADABLE

    lines = [
        "# The keys of conf/",
        "",
        "Each group's keys are the arguments of the class that it names, with the words of its constructor; of classes",
        "of libraries those that conf/ sets, and every other may be given too. `PNU_WRITE=1 make test",
        "ARGS=tests/config/test_schema.py` writes this page.",
    ]
    for group in sorted(path.name for path in config_folder().iterdir() if path.is_dir()):
        for choice, named in targets(group).items() if group in PACKAGES else ():
            content = yaml.safe_load((config_folder() / group / f"{choice}.yaml").read_text(encoding="utf-8"))
            for name, target in named.items():
                prefix = f"{group}.{name}." if name else f"{group}."
                known = dict(settable(group, class_arguments(group, target)))
                here = content[name] if name else content
                lines += ["", f"## {group}={choice}: `{target}`", "", "| key | type | value | |", "|---|---|---|---|"]
                for key, argument in known.items():
                    if library(target) and key not in here:
                        continue
                    value = here.get(key, argument.default)
                    text = "" if value is REQUIRED or value is UNREADABLE else f"`{as_typed(value)}`"
                    lines.append(f"| `{prefix}{key}` | {type_name(argument.hint)} | {text} | {argument.words} |")
    return "\n".join(lines) + "\n"
