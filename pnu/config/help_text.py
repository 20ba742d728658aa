"""The text of `--help`: every key with its present value and its line of documentation."""

import inspect
from collections.abc import Iterator
from typing import Any

from pnu.config.compose import group_choices
from pnu.config.schema import Groups, class_arguments, fields, groups, library, nested_class, settable
from pnu.config.signature import Argument, arguments, summary


def shown(value: Any) -> str:
    """A value as one types it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def help_text(schema: type, program: str, cfg: Any) -> str:
    """What a command does, and for every key its present value and its line of documentation."""
    from omegaconf import OmegaConf

    usage = f"usage: {program} [key=value ...]      (-m key=a,b: one run for each value)"
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
    return f"  {key + '=' + (value if value == '...' else shown(value)):<40} {words}".rstrip()
