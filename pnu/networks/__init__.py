"""Networks in plain PyTorch: one file a network, shared parts in `layers`.

A network maps patches (B, n, 6) to (B, ratio n, 6). `pnu.fast` computes the same faster.
"""

import importlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pnu.config.instantiate import is_within, present_name

if TYPE_CHECKING:
    from torch import nn


def build_network(config: Mapping[str, Any], allow: Sequence[str] = ()) -> "nn.Module":
    """Build a network from a plain config: `_target_` names its class, the other keys are its arguments.

    Only classes below `pnu.networks`, and of the packages `allow`, are built: a config from elsewhere runs no other
    code.

    Raises:
        ValueError: `_target_` is missing, lies outside these packages, or does not accept the arguments.
    """
    from torch import nn

    # as older runs and weights spell it
    arguments = {str(key).replace("neighbour", "neighbor"): value for key, value in config.items()}
    target = present_name(str(arguments.pop("_target_", "")))
    module_name, _, class_name = target.rpartition(".")
    packages = ("pnu.networks", *allow)
    if not any(is_within(target, package) for package in packages):
        own = target.partition(".")[0]
        raise ValueError(
            f"model._target_: expected a class below {' or '.join(packages)}, such as pnu.networks.pnu.PNU, got"
            f" {target!r}; if you trust the package, allow=[{own}] runs its code"
        )
    try:
        cls = getattr(importlib.import_module(module_name), class_name, None)
    except ModuleNotFoundError:
        cls = None
    if not (isinstance(cls, type) and issubclass(cls, nn.Module) and is_defined(cls, packages)):
        raise ValueError(f"model._target_: {target!r} is no network of this version, such as pnu.networks.pnu.PNU")
    try:
        return cls(**arguments)
    except TypeError as error:
        raise ValueError(f"model: {class_name} does not accept these arguments: {error}") from error


def is_defined(cls: type, packages: Sequence[str]) -> bool:
    """Whether one of the packages defines the class, which others may only have imported."""
    return any(is_within(cls.__module__, package) for package in packages)
