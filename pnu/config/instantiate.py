"""Build the object that a group of the config describes."""

import functools
import importlib
from collections.abc import Mapping, Sequence
from typing import Any

PACKAGES = {  # which may define the classes of a group; `allow` adds to them
    "data": ("pnu.data",),
    "model": ("pnu.networks",),
    "loss": ("pnu.losses",),
    "protocol": ("pnu.benchmark",),
    "optimizer": ("torch.optim",),
    "scheduler": ("torch.optim.lr_scheduler",),
    "trainer": ("lightning.pytorch",),
    "callbacks": ("pnu.training.callbacks", "pnu.training.captured_step", "lightning.pytorch.callbacks"),
    "logger": ("lightning.pytorch.loggers",),
}
RENAMED = {"pnu.models.": "pnu.networks."}  # in the configs of older runs and weights
NEEDS = {"WandbLogger": "wandb", "MLFlowLogger": "mlflow"}  # packages that loggers want, and the extras that have them
LENGTH = "is the number of steps of the training; trainer.max_steps or trainer.max_epochs sets it"
GIVEN = {  # arguments that the program gives, and why a config cannot
    "optimizer": {"params": "are the network's"},
    "scheduler": {"optimizer": "is the one of optimizer=...", "total_steps": LENGTH, "T_max": LENGTH},
    "callbacks": {"run": "is the run folder, run=FOLDER", "objective": "is that of the search, objective=[chamfer_sq]"},
    "logger": {"save_dir": "is the run folder, run=FOLDER"},
    "trainer": {
        "callbacks": "are a group of their own: callbacks=[default,ema], +callbacks.NAME._target_=CLASS",
        "logger": "is a group of its own: logger=csv, logger=[tensorboard,csv], logger=none",
        "barebones": "leaves out what a run folder is made of: curves, checkpoints, validation",
        "plugins": "are objects, which a config cannot hold; those that pnu needs are there",
        "default_root_dir": "is the run folder, run=FOLDER",
        "enable_checkpointing": "pnu writes its own: callbacks.checkpoints.every_n_steps=N, ~callbacks.checkpoints",
        "log_every_n_steps": "every step is logged, so that a run that goes on has each step once",
        "inference_mode": "its tensors would stay in the metrics, of no use to the training after them",
        "use_distributed_sampler": "the data's sampler gives each process its share and goes on where a run stopped",
    },
}


def instantiate(
    config: Mapping[str, Any] | None, within: str | Sequence[str], *, allow: Sequence[str] = (), **more: Any
) -> Any:
    """The object of class `config._target_` with the config's other keys and `more` as arguments; None without target.

    With `_partial_: true` a function that still waits for arguments (an optimizer, for the parameters).

    Args:
        within: package or packages that must define the class, such as "torch.optim": a config from elsewhere runs no
            other code.
        allow: packages of the user's own that may define it too.

    Raises:
        ValueError: the target is no class of those packages, or does not accept the arguments.
    """
    from omegaconf import DictConfig, OmegaConf

    if isinstance(config, DictConfig):
        config = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    arguments = dict(config or {})
    target = arguments.pop("_target_", None)
    partial = arguments.pop("_partial_", False)
    if target is None:
        return None
    cls = find_class(str(target), within, allow)
    if partial:
        return functools.partial(cls, **arguments, **more)
    try:
        return cls(**arguments, **more)
    except TypeError as error:
        raise ValueError(f"{target}: {error}") from error


def find_metric(target: str, *, allow: Sequence[str] | None = None) -> type:
    """The class of a metric: of `pnu.metrics`, or of a package of the user's own that `allow` names."""
    return find_class(target, "pnu.metrics", allow or ())


def find_class(target: str, within: str | Sequence[str], allow: Sequence[str] = ()) -> type:
    """The class of that dotted name, if one of the packages defines it. What a module merely imported (`pnu.io.os`) is
    refused."""
    packages = [*([within] if isinstance(within, str) else within), *allow]
    module_name, _, class_name = target.rpartition(".")
    found = None
    if any(is_within(target, package) for package in packages):
        try:
            found = getattr(importlib.import_module(module_name), class_name, None)
        except ModuleNotFoundError as error:
            if error.name is None or not is_within(module_name, error.name):  # one that the package itself imports
                raise ValueError(
                    f"_target_={target}: its package needs {error.name}, which is not installed"
                ) from error
    if not isinstance(found, type) or not any(is_within(found.__module__, package) for package in packages):
        raise ValueError(f"_target_={target}: expected a class of {' or '.join(packages)}")
    return found


def present_name(target: str) -> str:
    """The name that a class has now."""
    return next((new + target.removeprefix(old) for old, new in RENAMED.items() if target.startswith(old)), target)


def is_within(name: str, package: str) -> bool:
    """Whether a dotted name is that of a package or below it."""
    return bool(package) and f"{name}.".startswith(f"{package}.")
