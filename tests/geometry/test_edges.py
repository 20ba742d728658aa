"""Sharp edges of meshes."""

import numpy as np
import pytest

from pnu.geometry.sharp_edges import sharp_edge_points, sharp_edges
from pnu.io import Mesh


@pytest.fixture
def box() -> Mesh:
    """The unit cube: 12 edges of length 1, and 6 diagonals that are none."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corners, np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]))


def test_edges_of_a_box(box: Mesh) -> None:
    edges = sharp_edges(box)
    assert edges.shape == (12, 2, 3)
    assert np.allclose(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1), 1)
    assert len(sharp_edges(box, angle=91)) == 0


def test_edges_of_a_soup_are_those_of_the_mesh(box: Mesh) -> None:
    soup = Mesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(12, 3))
    assert len(sharp_edges(soup)) == 12


def test_open_border_is_no_edge(box: Mesh) -> None:
    assert len(sharp_edges(Mesh(box.vertices, box.faces[2:]))) == 8


def test_points_lie_on_the_edges(box: Mesh) -> None:
    points = sharp_edge_points(box, spacing=0.3)
    assert len(points) == 12 * 5
    assert (((points == 0) | (points == 1)).sum(1) >= 2).all()
    assert len(sharp_edge_points(box, spacing=0.3, angle=100)) == 0
