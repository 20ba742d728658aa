"""Networks in plain PyTorch: one file a network, shared parts in `layers`.

A network maps patches (B, n, 6) to (B, ratio n, 6). `pnu.fast` computes the same faster.
"""

import importlib
import re
from collections.abc import Mapping
from typing import Any

from torch import nn


def build(config: Mapping[str, Any]) -> nn.Module:
    """Build a network from a plain config: `_target_` names its class, the other keys are its arguments.

    Only classes below `pnu.networks` are built, so that a config from elsewhere cannot run other code.

    Raises:
        ValueError: `_target_` is missing, lies outside `pnu.networks`, or does not accept the arguments.
    """
    arguments = {str(key): value for key, value in config.items()}
    target = str(arguments.pop("_target_", ""))
    target = re.sub(r"^pnu\.models\.", "pnu.networks.", target)  # as older runs and weights have it
    module_name, _, class_name = target.rpartition(".")
    if not target.startswith("pnu.networks."):
        raise ValueError(
            f"model._target_: expected a class below pnu.networks, such as pnu.networks.pnu.PNU, got {target!r}"
        )
    try:
        cls = getattr(importlib.import_module(module_name), class_name, None)
    except ModuleNotFoundError:
        cls = None
    if not (isinstance(cls, type) and issubclass(cls, nn.Module) and cls.__module__ == module_name):
        raise ValueError(f"model._target_: {target!r} is no network of this version, such as pnu.networks.pnu.PNU")
    try:
        return cls(**arguments)
    except TypeError as error:
        raise ValueError(f"model: {class_name} does not accept these arguments: {error}") from error
