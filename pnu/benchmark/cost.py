"""What a computation costs: wall time and peak memory."""

import contextlib
import time
from pathlib import Path

import torch

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]

STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Cost:
    """Measures the block of code inside `with Cost() as cost:`; `cost.values` has the result after it.

    seconds: wall time. peak_memory_mb: most memory at once in MiB, of the GPU where one is used, else of the process
    with all that it holds already (and of the largest child that it waited for); NaN where the system does not tell.
    """

    def __enter__(self) -> "Cost":
        self.values: dict[str, float] = {}
        self.children_s = children()[0]
        reset_peak()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()
        self.start = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        gpu = 0
        if torch.cuda.is_available():
            torch.cuda.synchronize()
            gpu = torch.cuda.max_memory_allocated()
        self.values["seconds"] = time.perf_counter() - self.start
        after_s, child = children()
        self.values["peak_memory_mb"] = (gpu or peak() + (child if after_s > self.children_s else 0)) / 2**20


def reset_peak() -> None:
    """Let the system count the process's peak memory anew, where it can (Linux)."""
    with contextlib.suppress(OSError):
        RESET.write_text("5")


def peak() -> float:
    """Most bytes of the process since `reset_peak`, or since its start where that has no effect; NaN if unknown."""
    try:
        line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmHWM:"))
        return 1024 * float(line.split()[1])
    except (OSError, StopIteration):
        return float("nan")


def children() -> tuple[float, float]:
    """Seconds of work of all child processes that have ended, and bytes of the largest of them."""
    if resource is None:
        return 0.0, 0.0
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime, 1024 * usage.ru_maxrss
