"""Which of many things hang together, by pairs that do."""

import numpy as np
from numpy.typing import NDArray

MANY = 2**19  # pairs from which on SciPy is faster, though its import takes a quarter of a second
Index = NDArray[np.integer]


def connected_parts(first: Index, second: Index, n: int) -> NDArray[np.int64]:
    """The number of the part that each of n things is in, (n,), from 0 on; first[i] and second[i] hang together."""
    if len(first) > MANY:
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import connected_components

        graph = csr_matrix((np.ones(len(first), bool), (first, second)), (n, n))
        return np.asarray(connected_components(graph, directed=False)[1], np.int64)
    root = np.arange(n)
    while True:  # the roots of both take the lower one, then everything its root's root
        before = root.copy()
        low = np.minimum(before[first], before[second])
        np.minimum.at(root, before[first], low)
        np.minimum.at(root, before[second], low)
        while (root != root[root]).any():
            root = root[root]
        if (root == before).all():
            return np.unique(root, return_inverse=True)[1]
