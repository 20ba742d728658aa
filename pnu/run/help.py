"""The text of `--help`: every key with its present value and its line of documentation."""

import dataclasses
import inspect
import typing
from typing import Any

from pnu.run.config import group_choices
from pnu.run.schema import fields


def shown(value: Any) -> str:
    """A value as one types it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def help_text(schema: type, program: str, cfg: Any) -> str:
    """What a command does, and for every key its present value and its line of documentation."""
    from omegaconf import OmegaConf

    lines = []

    def describe(schema: type, cfg: Any, prefix: str) -> None:
        hints = typing.get_type_hints(schema)
        # groups last: keys of the command itself below a group would look like the group's
        for name, field in sorted(fields(schema).items(), key=lambda item: dataclasses.is_dataclass(hints[item[0]])):
            key = f"{prefix}{name}"
            # `in cfg` would leave out those that are still ???; underscores are Hydra's, set by the choice of a group
            if name not in list(cfg) or name.startswith("_"):
                continue
            if dataclasses.is_dataclass(hints[name]):
                options = group_choices(key.replace(".", "/"))
                choices = f" ({key}={'|'.join(options)})" if options else ""
                lines.append(f"\n{field.metadata['doc']}{choices}")
                describe(typing.cast(type, hints[name]), cfg[name] or {}, f"{key}.")
            else:
                missing = OmegaConf.is_missing(cfg, name)
                value = "..." if missing else shown(cfg[name])
                lines.append(f"  {key + '=' + value:<40} {field.metadata['doc']}")

    describe(schema, cfg, "")
    usage = f"usage: {program} [key=value ...]      (-m key=a,b: one run for each value)"
    return "\n".join([usage, "", inspect.getdoc(schema) or "", "", *lines])
