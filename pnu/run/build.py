"""Build the object that a group of the config describes."""

import functools
import importlib
from collections.abc import Mapping, Sequence
from typing import Any


def build(config: Mapping[str, Any] | None, within: str, **more: Any) -> Any:
    """The object of class `config._target_` with the config's other keys and `more` as arguments; None without target.

    With `_partial_: true` a function that still waits for arguments (an optimizer, for the parameters).

    Args:
        within: package that must define the class, such as "torch.optim": a config from elsewhere runs no other code.

    Raises:
        ValueError: the target is no class of that package, or does not accept the arguments.
    """
    from omegaconf import DictConfig, OmegaConf

    if isinstance(config, DictConfig):
        config = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    arguments = dict(config or {})
    target = arguments.pop("_target_", None)
    partial = arguments.pop("_partial_", False)
    if target is None:
        return None
    cls = find_class(str(target), within)
    if partial:
        return functools.partial(cls, **arguments, **more)
    try:
        return cls(**arguments, **more)
    except TypeError as error:
        raise ValueError(f"{target}: {error}") from error


def find_metric(target: str, *, allow: Sequence[str] | None = None) -> type:
    """The class of a metric: of `pnu.metrics`, or of a package of the user's own that `allow` names."""
    own = (package for package in allow or () if f"{target}.".startswith(f"{package}."))
    return find_class(target, next(own, "pnu.metrics"))


def find_class(target: str, within: str) -> type:
    """The class of that dotted name, if `within` defines it. What a module merely imported (`pnu.io.os`) is refused."""
    module_name, _, class_name = target.rpartition(".")
    found = None
    if f"{target}.".startswith(f"{within}."):
        try:
            found = getattr(importlib.import_module(module_name), class_name, None)
        except ModuleNotFoundError:
            found = None
    if not isinstance(found, type) or not f"{found.__module__}.".startswith(f"{within}."):
        raise ValueError(f"_target_={target}: expected a class of {within}")
    return found
