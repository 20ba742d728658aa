"""Rows in chunks that fit the cache of a core, one thread a chunk. CPU only."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from pnu.fast.neighborhoods import Neighborhoods
from pnu.runtime import threads

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
        """Its rows, as an index."""
        return slice(self.start, self.stop)

    @property
    def groups(self) -> slice:
        """Its groups, as an index."""
        return slice(self.first, self.last)

    def grouped(self, rows: Tensor) -> Tensor:
        """Rows (r, C) of this chunk as (groups, size, C)."""
        return rows.view(self.last - self.first, -1, rows.shape[1])


def row_chunks(rows: int, width: int) -> list[Chunk]:
    """Chunks of rows whose widest matrix has `width` columns."""
    step = max(CHUNK // width, 1)
    return [Chunk(i, start, min(start + step, rows)) for i, start in enumerate(range(0, rows, step))]


def group_chunks(groups: Neighborhoods, width: int) -> list[Chunk]:
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


def map_chunks(work: Callable[[list[Chunk]], T], chunks: list[Chunk]) -> list[T]:
    """Call `work` with consecutive parts of the chunks, one part a thread of torch; results in order."""
    number, rows = torch.get_num_threads(), chunks[-1].stop
    parts: list[list[Chunk]] = [[] for _ in range(number)]
    for chunk in chunks:
        parts[(chunk.start + chunk.stop) * number // (2 * rows)].append(chunk)
    return threads.map_on_threads(work, [part for part in parts if part])
