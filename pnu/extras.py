"""Packages that only some uses need: which extra of pnu brings each, and one line where it is missing.

with needed("training"):
    import lightning
"""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

# package -> the extra of pnu that brings it
EXTRAS = {
    **dict.fromkeys(("lightning", "torchmetrics", "h5py", "tensorboard"), "train"),
    "matplotlib": "figures",
    "open3d": "poisson",
    **dict.fromkeys(("laspy", "lazrs"), "las"),
    "pye57": "e57",
    "optuna": "sweeps",
    **dict.fromkeys(("onnx", "onnxruntime", "onnxscript"), "onnx"),
}


class MissingExtra(ModuleNotFoundError, ValueError):
    """A package is not installed, and which extra brings it; at the command line one line and exit code 2."""


@contextmanager
def needed(purpose: str) -> Iterator[None]:
    """Imports of packages in `EXTRAS`; where one is not installed, it is said for what it is needed, and the cure.

    Raises:
        MissingExtra: the package is not there.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if isinstance(error, MissingExtra) or package not in EXTRAS:
            raise
        raise MissingExtra(missing(package, purpose), name=error.name) from None


def require(package: str, purpose: str) -> None:
    """As `needed`, for a package that another process will import.

    Raises:
        MissingExtra: the package is not there.
    """
    with needed(purpose):
        found = importlib.util.find_spec(package)
    if found is None:
        raise MissingExtra(missing(package, purpose), name=package)


def missing(package: str, purpose: str) -> str:
    """What is said where a package is not installed."""
    return f'{purpose} needs {package}, which is not installed: pip install "pnu[{EXTRAS[package]}]"'
