"""Parts that hang together, against SciPy's."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from pnu.geometry import connected_parts as module
from pnu.geometry.connected_parts import connected_parts


@pytest.mark.parametrize("many", [0, 2**19])
@pytest.mark.parametrize(("n", "pairs"), [(1, 0), (5, 0), (50, 30), (400, 390), (400, 800)])
def test_parts_are_those_of_the_graph(monkeypatch: pytest.MonkeyPatch, n: int, pairs: int, many: int) -> None:
    monkeypatch.setattr(module, "MANY", many)
    first, second = np.random.default_rng(n + pairs).integers(n, size=(2, pairs))
    found = connected_parts(first, second, n)
    count, expected = connected_components(csr_matrix((np.ones(pairs), (first, second)), (n, n)), directed=False)
    assert len(np.unique(np.stack([found, expected]), axis=1).T) == count == found.max() + 1


def test_a_long_chain_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    order = np.random.default_rng(0).permutation(3000)
    assert (connected_parts(order[:-1], order[1:], 3001) == (np.arange(3001) == 3000)).all()
