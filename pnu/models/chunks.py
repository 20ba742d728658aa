"""Rows in chunks that fit the cache of a core, one thread a chunk. CPU only."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from pnu.models.neighborhoods import Groups

CHUNK = 2**17  # floats in the widest matrix of a chunk: 512 KiB, a handful of which fit the cache of a core
T = TypeVar("T")


class Chunk(NamedTuple):
    """Rows start..stop; where they are pooled, groups first..last of equal size."""

    number: int
    start: int
    stop: int
    first: int = 0
    last: int = 0

    @property
    def rows(self) -> slice:
        return slice(self.start, self.stop)

    @property
    def groups(self) -> slice:
        return slice(self.first, self.last)

    def grouped(self, rows: Tensor) -> Tensor:
        """Rows (r, C) of this chunk as (groups, size, C)."""
        return rows.view(self.last - self.first, -1, rows.shape[1])


def row_chunks(rows: int, width: int) -> list[Chunk]:
    """Chunks of rows whose widest matrix has `width` columns."""
    step = max(CHUNK // width, 1)
    return [Chunk(i, start, min(start + step, rows)) for i, start in enumerate(range(0, rows, step))]


def group_chunks(groups: Groups, width: int) -> list[Chunk]:
    """Chunks of whole groups of equal size."""
    chunks: list[Chunk] = []
    row = group = 0
    for number, size in groups.runs:
        step = max(CHUNK // (width * size), 1)
        for first in range(0, number, step):
            last = min(first + step, number)
            chunks.append(Chunk(len(chunks), row + first * size, row + last * size, group + first, group + last))
        row, group = row + number * size, group + number
    return chunks


class Scratch:
    """Matrices that stay in the cache: one thread's own."""

    def __init__(self, part: list[Chunk], like: Tensor) -> None:
        self.rows = max(chunk.stop - chunk.start for chunk in part)
        self.like, self.ones = like, like.new_ones(self.rows)

    def __call__(self, width: int) -> Tensor:
        return self.like.new_empty(self.rows, width)


def spread(work: Callable[[list[Chunk]], T], chunks: list[Chunk]) -> list[T]:
    """Call `work` with consecutive parts of the chunks, one part a thread of torch; results in order."""
    threads = torch.get_num_threads()
    if min(threads, len(chunks)) == 1:
        return [_without_gradient(work, chunks)]
    parts: list[list[Chunk]] = [[] for _ in range(threads)]
    for chunk in chunks:
        parts[(chunk.start + chunk.stop) * threads // (2 * chunks[-1].stop)].append(chunk)
    # one thread for each operation: waiting for each other after every one costs more than it gains
    torch.set_num_threads(1)
    try:
        return list(_threads(threads, os.getpid()).map(lambda part: _without_gradient(work, part), filter(None, parts)))
    finally:
        torch.set_num_threads(threads)


def _without_gradient(work: Callable[[list[Chunk]], T], part: list[Chunk]) -> T:
    with torch.no_grad():  # the mode is each thread's own
        return work(part)


@lru_cache(maxsize=1)
def _threads(number: int, process: int) -> ThreadPoolExecutor:
    # the number of threads of an operation is each calling thread's own, too
    return ThreadPoolExecutor(number, "pnu-chunks", initializer=torch.set_num_threads, initargs=(1,))
