"""Where compiled kernels are kept, and how they come there. This file loads no numba until something is compiled.

They are kept twice: as numba's own files, whose loading takes a second with numba, and as one file of machine code that
is loaded without it (`code_loading`). A process takes the second where it is there and whole, and otherwise the first;
what is missing or damaged is then made anew.

Compiled code lies in a folder whose name tells sources, versions and processor apart, so what is found fits. It is made
once: by `pnu doctor --install` (so by `make setup`), or in the background by a process of low priority, which the first
long computation starts. Where no folder can be written nothing is compiled, and that is no error.
"""

import contextlib
import hashlib
import importlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pnu.kernels.code_loading import MachineCode

HERE = Path(__file__).parent
KERNELS = ("boxes", "neighbors", "greedy_sampling", "frames", "projector", "dipoles", "planes", "pushes")
COMPLETE, LOCK, FAILED, CODE, NO_CODE = "complete", "lock", "failed", "code", "no_code"
OLD = 30 * 86400  # seconds
EXACT = {"nnan", "ninf", "nsz"}  # results have the bits of NumPy's operations in the order written
LOOSE = {"nnan", "ninf", "nsz", "arcp", "contract", "reassoc"}  # to rounding
_made: dict[str, tuple[str, Any]] = {}  # by numba in this process: signatures and functions by the names of kernels


def kernel(*signature: str, exact: bool = False, inner: bool = False) -> Callable[[Any], Any]:
    """Decorator: a compiled function that frees the interpreter's lock, loaded from where it is kept.

    signature: of the types it takes; without one it is compiled with what calls it. exact: additions and products as
    they are written; otherwise they may be fused and reordered. inner: becomes part of what calls it.
    """
    code = machine_code()
    if code is not None:
        return lambda function: function if inner else code.kernel(_name(function), signature[0], function)
    from numba import config, njit

    flags = EXACT if exact else LOOSE
    options: dict[str, Any] = {"nogil": True, "fastmath": flags, "error_model": "numpy", "boundscheck": False}
    place = folder()

    def decorate(function: Callable[..., Any]) -> Any:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(place or "")
        try:
            made = njit(*signature, cache=place is not None and not inner, **options)(function)
        finally:
            config.CACHE_DIR = before
        if not inner:
            _made[_name(function)] = signature[0], made
        return made

    return decorate


def _name(function: Callable[..., Any]) -> str:
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


@cache  # the same for all files of kernels in a process
def machine_code() -> "MachineCode | None":
    """What is kept for processes without numba; None where there is none, so that numba makes the kernels."""
    from pnu.kernels.code_loading import load_code

    place = folder()
    return load_code(place / CODE) if place is not None and _complete(place) else None


def by_numba() -> bool:
    """Whether numba makes the kernels of this process, so that what they are written with is needed."""
    return machine_code() is None


@cache
def folder() -> Path | None:
    """Where compiled kernels of these sources belong; None where numba is missing or nothing can be written."""
    if importlib.util.find_spec("numba") is None:
        return None
    key = _key()
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    for root in (HERE / "__pycache__", home / "pnu"):
        above = root
        while not above.exists() and above != above.parent:
            above = above.parent
        if above.is_dir() and os.access(above, os.W_OK):
            return root / f"kernels-{key}"
    return None


def complete() -> bool:
    """Whether all kernels are compiled."""
    return _complete(folder())


def wanting() -> bool:
    """Whether something is to be compiled: kernels, or machine code that is missing or damaged and can be kept."""
    from pnu.kernels.code_loading import intact

    place = folder()
    return place is not None and not (_complete(place) and (intact(place / CODE) or (place / NO_CODE).exists()))


def compile_all(*, wait: bool = True) -> bool:
    """Compile what is not compiled yet, one process at a time; whether all kernels are now.

    wait: for another process that is at it.
    """
    place = folder()
    if place is None or not wanting():
        return complete()
    try:
        place.mkdir(parents=True, exist_ok=True)
        with open(place / LOCK, "w") as lock:
            if not _taken(lock, wait):
                return complete()
            if wanting():
                for name in KERNELS:
                    importlib.import_module(f"pnu.kernels.{name}")
                _keep_code(place)
                (place / COMPLETE).touch()
                _forget_old(place)
    except Exception as error:  # a compiler can fail in many ways, and nobody needs it
        _note(place / FAILED, error)
    return complete()


def _keep_code(place: Path) -> None:
    """Machine code beside numba's files; where that cannot be, processes start a second later."""
    from pnu.kernels import code_writing

    try:
        code_writing.write_code(place / CODE, _made)
    except Exception as error:
        _note(place / NO_CODE, error)


def reason() -> str | None:
    """Why kernels cannot be compiled here; None where they can."""
    if importlib.util.find_spec("numba") is None:
        return "numba is not installed"
    place = folder()
    if place is None:
        return "neither the package nor ~/.cache can be written"
    failed = place / FAILED
    return failed.read_text().strip().partition("\n")[0][:200] if failed.exists() else None


def compile_in_background() -> None:
    """Compile in a process of low priority that outlives this one, at most one a machine, and once if it fails."""
    place = folder()
    unwanted = os.environ.get("PNU_FAST") == "0" or os.environ.keys() & {"CI", "PYTEST_VERSION"}
    if place is None or unwanted or not wanting() or (place / FAILED).exists():
        return
    with contextlib.suppress(OSError):
        _start()


@cache  # once a process
def _start() -> None:
    quiet: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    subprocess.Popen([sys.executable, "-m", __name__], start_new_session=True, **quiet)


def _forget_old(place: Path) -> None:
    """Remove what was compiled long ago of other states of these files; what is newer may be in use."""
    for other in place.parent.glob("kernels-*"):
        if other != place and time.time() - other.stat().st_mtime > OLD:
            shutil.rmtree(other, ignore_errors=True)


def _complete(place: Path | None) -> bool:
    return place is not None and (place / COMPLETE).exists()


def _taken(lock: Any, wait: bool) -> bool:
    try:
        import fcntl
    except ImportError:  # Windows: at worst two compile the same
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        return False
    return True


def _note(path: Path, error: Exception) -> None:
    with contextlib.suppress(OSError):
        path.write_text(f"{type(error).__name__}: {error}\n")


def _key() -> str:
    """Of all that compiled code depends on."""
    digest = hashlib.sha256()
    for path in sorted(HERE.glob("*.py")):
        digest.update(f"{path} {path.stat().st_mtime_ns}".encode() + path.read_bytes())
    for package in ("numba", "llvmlite", "numpy"):
        try:
            digest.update(version(package).encode())
        except PackageNotFoundError:
            digest.update(b"none")
    digest.update(f"{sys.version} {platform.machine()} {_processor()} {os.environ.get('PNU_LANES')}".encode())
    return digest.hexdigest()[:16]


def _processor() -> str:
    """What tells processors with different instructions apart."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    kept = ("model name", "flags", "Features", "CPU part")
    return "".join(line for line in lines if line.startswith(kept))


if __name__ == "__main__":
    with contextlib.suppress(AttributeError, OSError):  # Windows has no such number
        os.nice(19)
    sys.exit(not importlib.import_module("pnu.kernels.compilation").compile_all(wait=False))
