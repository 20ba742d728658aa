"""Each point of a cloud has one near it: by hand, and as by looking at everything again after each move."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pnu.upsamplers import coverage
from pnu.upsamplers.coverage import COVERED, NEARER, SPACED, Coverage


def test_the_nearest_comes_to_a_bare_point() -> None:
    points = np.column_stack([np.arange(20.0), np.zeros((20, 2))])  # in the middle the spacing is 2
    made = np.concatenate([points[:10] + [0.0, 0.1, 0.0], points[13:]])
    rows, places = Coverage(points, made, made[:0]).approach()
    # 13 comes to nine tenths of half a spacing from 11, the barest; 9 comes nearer to 10
    assert rows.tolist() == [10, 9]
    assert np.linalg.norm(places[0] - points[11]) == pytest.approx(0.9)
    assert Coverage(points, made, points[11:13]).approach()[0].tolist() == []


def plainly(points: np.ndarray, made: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`Coverage.approach`, by loops over all points."""
    spacing = cKDTree(points).query(points, SPACED + 1)[0][:, 1:].mean(1)
    far, row = cKDTree(np.concatenate([made, kept])).query(points)
    rows: list[int] = []
    places = []
    for i in np.argsort(-far / spacing, kind="stable"):
        if far[i] > COVERED * spacing[i] and row[i] < len(made) and row[i] not in rows:
            rows.append(int(row[i]))
            way = (points[i] - made[row[i]]) / far[i]
            places.append(made[row[i]] + (far[i] - NEARER * COVERED * spacing[i]) * way)
    return np.array(rows), np.array(places).reshape(-1, 3)


@pytest.mark.parametrize("at_hand", [1, 16])
@pytest.mark.parametrize("kept", [0, 60])
def test_what_moves_is_as_by_looking_anew(monkeypatch: pytest.MonkeyPatch, kept: int, at_hand: int) -> None:
    monkeypatch.setattr(coverage, "AT_HAND", at_hand)  # of one hardly any stays, so all is searched anew
    rng = np.random.default_rng(kept)
    points, made = rng.normal(size=(400, 3)), rng.normal(size=(300, 3)) * [1, 1, 0.3]
    stay = points[:kept]
    found, rounds = Coverage(points, made.copy(), stay), 0
    for _ in range(4):
        rows, places = found.approach()
        expected = plainly(points, made, stay)
        assert rows.tolist() == expected[0].tolist()
        np.testing.assert_allclose(places, expected[1], atol=1e-12)
        rounds += len(rows) > 0
        made[rows] = places + 0.02 * rng.normal(size=places.shape)  # projected, they lie a little aside
        found.move(rows, made[rows])
    assert rounds == 4
