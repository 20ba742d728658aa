"""Space cut into cells: each point is in one, whatever it is."""

import numpy as np

from pnu.geometry.cells import Cells


def test_each_point_is_in_one_cell_with_equal_shares() -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3)) * [9, 1, 0.1]
    points[::7] = points[3]  # equal ones stay together
    cells = Cells.of(points, 3)
    home = cells.of_points(points)
    inside = np.stack([cells.inside(points, number) for number in range(8)])
    assert (inside.sum(0) == 1).all()
    np.testing.assert_array_equal(inside.argmax(0), home)
    assert len(set(home[::7])) == 1
    far = np.array([[1e9, -1e9, 0.0], [-1e9, 5, 7]])
    assert all(cells.inside(far, number)[i] for i, number in enumerate(cells.of_points(far)))
    even = np.bincount(Cells.of(np.random.default_rng(1).normal(size=(4096, 3)), 4).of_points(points), minlength=16)
    assert even.sum() == 1000
    line = np.stack([np.arange(8.0), np.zeros(8), np.zeros(8)], 1)
    np.testing.assert_array_equal(Cells.of(line, 2).of_points(line), [0, 0, 1, 1, 2, 2, 3, 3])


def test_depth_and_neighbors() -> None:
    line = np.stack([np.arange(8.0), np.zeros(8), np.zeros(8)], 1)
    cells = Cells.of(line, 2)  # cut at 1.5, 3.5 and 5.5
    np.testing.assert_allclose(cells.depth(line[2:4], 1), [0.5, 0.5])
    np.testing.assert_allclose(cells.depth(line[:1], 0), [1.5])
    assert cells.near(1, 0.1) == [0, 2]
    assert cells.near(1, 2.5) == [0, 2, 3]
    np.testing.assert_array_equal(cells.inside(line, 1, 1.0), [0, 1, 1, 1, 1, 0, 0, 0])
