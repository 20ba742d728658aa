"""Work of one step on several threads, each with operations of one thread.

Threads that wait for each other after every operation lose more than they gain where operations are short, all the more
on a machine that does something else too; here they meet once, at the end.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

import torch

Part = TypeVar("Part")
Result = TypeVar("Result")


def map_on_threads(work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """`work` of each part, without gradient, on as many threads as torch uses; results in the order of the parts."""
    threads = torch.get_num_threads()

    def quiet(part: Part) -> Result:
        with torch.no_grad():  # the mode is each thread's own
            return work(part)

    if threads == 1:
        return [quiet(part) for part in parts]
    torch.set_num_threads(1)  # for a single part too: its last digits are those that it has among others
    try:
        if len(parts) == 1:
            return [quiet(parts[0])]
        return list(_pool(threads, os.getpid()).map(quiet, parts))
    finally:
        torch.set_num_threads(threads)


@lru_cache(maxsize=1)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    # the number of threads of an operation is each calling thread's own, too
    return ThreadPoolExecutor(threads, "pnu", initializer=torch.set_num_threads, initargs=(1,))
