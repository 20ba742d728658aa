"""Scores of clouds made from scans, by hand."""

import numpy as np
import pytest

from pnu.metrics.scan_scores import COLUMNS, scan_scores


def test_scores_of_four_points_above_a_plane() -> None:
    up, down = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]
    closest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    points = closest + np.array([[0, 0, 0], [0, 0, 0.01], [0, 0, -0.01], [0, 0, 0.1]])
    normals = np.array([up, down, [np.sqrt(0.5), 0, np.sqrt(0.5)], up])
    seen = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0.01]])
    found = scan_scores(np.hstack([points, normals]), seen, closest, np.tile(up, (4, 1)))
    assert tuple(found) == COLUMNS
    assert found["accuracy"] == pytest.approx(30)
    assert found["p95"] == pytest.approx(1e3 * np.quantile([0, 0.01, 0.01, 0.1], 0.95))
    assert found["stray"] == 25
    assert found["complete"] == pytest.approx(1e3 * (0 + 0.01 + 2) / 3)
    assert found["gap"] == pytest.approx(2000)
    assert found["normal"] == pytest.approx(45 / 4)
    assert found["flipped"] == 25
