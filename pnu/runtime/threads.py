"""Work of one step on several threads, each with operations of one thread.

Threads that wait for each other after every operation lose more than they gain where operations are short, all the more
on a machine that does something else too; here they meet once, at the end.
"""

import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, TypeVar

from pnu.runtime import denormals

Part = TypeVar("Part")
Result = TypeVar("Result")


def torch_if_loaded() -> Any:
    """torch where it is imported already, else None: an import takes a second or two."""
    module = sys.modules.get("torch")
    return module if hasattr(module, "get_num_threads") else None


def thread_count() -> int:
    """Threads to work on: those of torch; where it is not loaded `OMP_NUM_THREADS`, or else a processor each."""
    torch = torch_if_loaded()
    if torch is not None:
        return int(torch.get_num_threads())
    wanted = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    if wanted.isdecimal() and int(wanted) > 0:
        return int(wanted)
    return processor_count()


def processor_count() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_on_threads(work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """`work` of each part, without gradient, on `thread_count` threads; results in the order of the parts."""
    threads, torch = thread_count(), torch_if_loaded()
    if torch is None:
        if threads == 1 or len(parts) == 1:
            return [work(part) for part in parts]
        return list(_pool(threads, os.getpid(), False).map(work, parts))

    zero = denormals.are_zero()

    def quiet(part: Part) -> Result:
        torch.set_flush_denormal(zero)
        with torch.no_grad():  # both modes are each thread's own
            return work(part)

    if threads == 1:
        return [quiet(part) for part in parts]
    torch.set_num_threads(1)  # for a single part too: its last digits are those that it has among others
    try:
        if len(parts) == 1:
            return [quiet(parts[0])]
        return list(_pool(threads, os.getpid(), True).map(quiet, parts))
    finally:
        torch.set_num_threads(threads)


@lru_cache(maxsize=1)
def _pool(threads: int, process: int, torch: bool) -> ThreadPoolExecutor:
    if not torch:
        return ThreadPoolExecutor(threads, "pnu")
    # the number of threads of an operation is each calling thread's own, too
    return ThreadPoolExecutor(threads, "pnu", initializer=torch_if_loaded().set_num_threads, initargs=(1,))
