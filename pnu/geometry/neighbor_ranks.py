"""Which of its neighbors a point looks at: near ones all, farther ones thinned out."""

import numpy as np

DENSE = 16  # neighbors that are all looked at


def neighbor_ranks(neighbors: int, reach: int, n: int) -> list[int]:
    """Ranks, from 0 on, of `neighbors` of the `reach` nearest, of those that a cloud of n points has."""
    count = max(neighbors - DENSE, 0)
    step, i = np.float32((reach - 1 - DENSE) / max(count - 1, 1)), np.arange(count, dtype=np.float32)
    # as torch.linspace rounds them, with which networks were trained
    even = np.where(i < max(count // 2, 1), DENSE + step * i, reach - 1 - step * (count - 1 - i))
    far = np.round(even).astype(int).tolist()
    return [rank for rank in [*range(min(DENSE, neighbors)), *far] if rank < n]
