"""Neighborhoods without their repetitions.

A ball query fills up small balls with copies of their first point: of 32 neighbors in a patch of 1024 points often 20
are copies. They change the statistics of batch norm, by their number, but neither the maximum nor its gradient.
`Neighborhoods` keeps each neighbor once, with its multiplicity.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Neighborhoods(NamedTuple):
    """Rows, one a neighbor, in groups, one a neighborhood; groups of equal size stand together.

    Neighborhoods and points are counted through the batch: neighborhood i of cloud b is b m + i.
    """

    source: Tensor  # (R,): row r is point source[r]
    owner: Tensor  # (R,): row r belongs to neighborhood owner[r]
    multiplicity: Tensor | None  # (R,) float: how often row r counts; None: every row once
    order: Tensor | None  # (G,): group g is neighborhood order[g]; None: they stand in order
    runs: list[tuple[int, int]]  # (number, size) of groups of equal size, in the order of rows

    @property
    def number(self) -> int:
        """Groups in all."""
        return sum(number for number, _ in self.runs)


def single(neighbors: Tensor, n: int) -> Neighborhoods:
    """Groups of neighbors (B, m, k) in clouds of n points: every neighbor one row, in order."""
    clouds, m, k = neighbors.shape
    source = (neighbors + torch.arange(clouds, device=neighbors.device).view(-1, 1, 1) * n).flatten()
    owner = torch.arange(clouds * m, device=neighbors.device).repeat_interleave(k)
    return Neighborhoods(source, owner, None, None, [(clouds * m, k)])


def distinct(neighbors: Tensor, n: int) -> Neighborhoods:
    """Groups of neighbors (B, m, k) in clouds of n points; copies of a neighborhood's first are counted, not kept."""
    clouds, m, k = neighbors.shape
    flat = (neighbors + torch.arange(clouds).view(-1, 1, 1) * n).view(clouds * m, k)
    kept = flat != flat[:, :1]
    kept[:, 0] = True
    size, order = kept.sum(1).sort(stable=True)
    multiplicity = torch.ones(clouds * m, k)
    multiplicity[:, 0] = k + 1.0 - kept.sum(1)
    kept = kept[order]
    numbers = torch.bincount(size, minlength=k + 1).tolist()
    return Neighborhoods(
        source=flat[order][kept],
        owner=order.repeat_interleave(size),
        multiplicity=multiplicity[order][kept],
        order=order,
        runs=[(number, size) for size, number in enumerate(numbers) if number],
    )


def whole(clouds: int, n: int) -> Neighborhoods:
    """One group for each cloud of n rows."""
    owner = torch.arange(clouds).repeat_interleave(n)
    return Neighborhoods(torch.arange(clouds * n), owner, None, None, [(clouds, n)])


def pool(rows: Tensor, groups: Neighborhoods) -> Tensor:
    """Maximum of the rows (R, C) of each neighborhood: (G, C), in the order of neighborhoods."""
    parts, start = [], 0
    for number, size in groups.runs:
        stop = start + number * size
        parts.append(rows[start:stop].view(number, size, -1).amax(1))
        start = stop
    return ungroup(torch.cat(parts), groups)


def ungroup(pooled: Tensor, groups: Neighborhoods) -> Tensor:
    """Values (G, C) of groups in the order of neighborhoods."""
    return pooled if groups.order is None else torch.empty_like(pooled).index_copy(0, groups.order, pooled)
