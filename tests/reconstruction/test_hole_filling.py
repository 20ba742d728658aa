"""Points over holes."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pnu.io import Mesh
from pnu.reconstruction import fill_holes
from pnu.reconstruction.hole_filling import hole_faces


def sphere(n: int) -> np.ndarray:
    """Evenly spread points of the unit sphere with normals, (n, 6)."""
    i = np.arange(n) + 0.5
    angle, z = np.pi * (1 + np.sqrt(5)) * i, 1 - 2 * i / n
    points = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)
    return np.hstack([points, points])


@pytest.mark.slow
def test_a_hole_narrower_than_the_radius_is_filled_and_no_other() -> None:
    whole = 40 * sphere(4000) + [100, 0, 0, 0, 0, 0]
    whole[:, 3:] /= 40
    narrow = np.linalg.norm(whole[:, :3] - [100, 0, 40], axis=1) < 10
    wide = np.linalg.norm(whole[:, :3] - [100, 0, -40], axis=1) < 26
    cloud = whole[~(narrow | wide)]
    filled = fill_holes(cloud, 14.0)
    assert 0.6 * narrow.sum() < len(filled) < 1.2 * narrow.sum()
    assert filled[:, 2].min() > 38 * 0.9
    assert np.abs(np.linalg.norm(filled[:, :3] - [100, 0, 0], axis=1) - 40).max() < 1.0
    outward = (filled[:, :3] - [100, 0, 0]) / 40
    assert (filled[:, 3:] * outward).sum(1).min() > 0.95
    np.testing.assert_allclose(np.linalg.norm(filled[:, 3:], axis=1), 1)
    gap = cKDTree(np.vstack([cloud, filled])[:, :3]).query(whole[narrow, :3])[0].max()
    assert gap < 3.0  # spacing of the cloud: 2.2; it was 10
    assert len(fill_holes(cloud, 5.0)) == 0


@pytest.mark.slow
def test_an_open_border_stays_open() -> None:
    cap = sphere(4000)
    assert len(fill_holes(cap[cap[:, 2] > 0.3], 0.3)) == 0
    flat = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [1, 1, 0]
    assert len(fill_holes(np.hstack([flat, np.tile([0.0, 0, 1], (3000, 1))]), 0.2)) <= 30  # gaps of the drawing


def test_faces_that_close_a_hole_by_hand() -> None:
    # a strip of five squares; the middle vertices of the second lie far from points, the last end is a border
    x = np.arange(6.0)
    vertices = np.stack([np.tile(x, 3), np.repeat([0.0, 1, 2], 6), np.zeros(18)], 1)
    square = [(6 * r + c, 6 * r + c + 1, 6 * r + c + 7, 6 * r + c + 6) for r in (0, 1) for c in range(5)]
    faces = np.array([f for a, b, c, d in square for f in ((a, b, c), (a, c, d))])
    distance = np.zeros(18)
    distance[7], distance[11] = 0.5, 0.5  # the row in the middle: one inside, one at the end
    closing, supported = hole_faces(Mesh(vertices, faces), distance, 0.4, 0.6)
    np.testing.assert_array_equal(closing, (faces == 7).any(1))
    np.testing.assert_array_equal(supported, ~((faces == 7) | (faces == 11)).any(1))
    assert not hole_faces(Mesh(vertices, faces), distance, 0.4, 0.45)[0].any()


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf")])
def test_a_radius_is_above_0(radius: float) -> None:
    with pytest.raises(ValueError, match=r"holes=.*: expected a radius above 0"):
        fill_holes(sphere(100), radius)
