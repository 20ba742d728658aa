"""Where a scanner was, from the files that programs for mobile mapping write."""

from pathlib import Path

import numpy as np
import pytest

from pnu.io import write_cloud
from pnu.io.sensor import asked_sight
from pnu.io.trajectory import read_trajectory

TIMES = 1e9 + np.array([0.5, 1.0, 2.0, 4.0])
PLACES = np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [1, 2, 4]]) + [447321.25, 5411934.5, 313]


def rows(*columns: np.ndarray, separator: str = " ") -> str:
    return "".join(separator.join(f"{value:.6f}" for value in row) + "\n" for row in np.hstack(columns))


TURNED = np.tile([0.0, 0, 0, 1], (4, 1))
CASES = {
    "tum.txt": "# timestamp tx ty tz qx qy qz qw\n" + rows(TIMES[:, None], PLACES, TURNED),
    "bare.txt": rows(TIMES[:, None], PLACES, TURNED),
    "shuffled.csv": "x,y,z,gps_time\n" + rows(PLACES[::-1], TIMES[::-1, None], separator=","),
    "words.csv": "Time,Roll,Pitch,Easting,Northing,Height\n"
    + rows(TIMES[:, None], TURNED[:, :2], PLACES, separator=","),
}


@pytest.mark.parametrize("name", CASES)
def test_text_with_times(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(CASES[name])
    found = read_trajectory(tmp_path / name)
    assert found.times is not None
    np.testing.assert_allclose(found.times, TIMES)
    np.testing.assert_allclose(found.places, PLACES)


def test_places_alone(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text(rows(PLACES))
    found = read_trajectory(tmp_path / "a.xyz")
    assert found.times is None
    np.testing.assert_allclose(found.places, PLACES)
    (tmp_path / "b.txt").write_text(rows(PLACES, np.array([[2.0], [1], [4], [3]])))  # what follows is no time
    np.testing.assert_allclose(read_trajectory(tmp_path / "b.txt").places, PLACES)


def test_a_cloud_of_places(tmp_path: Path) -> None:
    write_cloud(tmp_path / "way.ply", PLACES, None, {"time": TIMES})
    found = read_trajectory(tmp_path / "way.ply")
    assert found.times is not None
    np.testing.assert_allclose(found.places, PLACES)
    np.testing.assert_allclose(found.times, TIMES)


def test_places_between_times_and_none_beyond(tmp_path: Path) -> None:
    (tmp_path / "way.txt").write_text(CASES["tum.txt"])
    way = read_trajectory(tmp_path / "way.txt")
    found = way.at(1e9 + np.array([3.0, 0.75, 0.2, 1.0, 4.5]))
    assert found is not None
    expected = [PLACES[0] + [1, 2, 2], PLACES[0] + [0.5, 0, 0], [np.nan] * 3, PLACES[1], [np.nan] * 3]
    np.testing.assert_allclose(found, expected)
    assert way.at(np.array([1.0, 2.0])) is None  # seconds of the week


def test_the_clock_decides_what_a_file_says_of_a_cloud(tmp_path: Path) -> None:
    (tmp_path / "way.txt").write_text(CASES["tum.txt"])
    name = str(tmp_path / "way.txt")
    timed = asked_sight(name, attributes={"gps_time": TIMES})
    assert timed is not None
    np.testing.assert_allclose(timed.viewpoint, PLACES)
    for attributes in ({}, {"gps_time": TIMES - 1e9}):
        untimed = asked_sight(name, attributes=attributes)
        assert untimed is not None
        assert untimed.viewpoint is None
        np.testing.assert_allclose(untimed.places, PLACES)
        assert untimed.words == f"towards the 4 places of {name} that see the points"


def test_files_without_places(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,speed,course\n1,2,3\n2,3,4\n")
    with pytest.raises(ValueError, match=r"a\.csv: expected places x y z, or time x y z; found time speed course"):
        read_trajectory(tmp_path / "a.csv")
    (tmp_path / "b.txt").write_text("nan nan nan\n")
    with pytest.raises(ValueError, match=r"b\.txt: expected places x y z, or time x y z; holds none"):
        read_trajectory(tmp_path / "b.txt")
