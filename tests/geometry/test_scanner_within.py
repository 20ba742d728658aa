"""Where a scanner stood amid what it saw is known by how the points thin out, and normals look there."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import pnu
from bench.scenes import rescanned_room, scanned_room, yard
from pnu.data import shapes
from pnu.data.scanner import KINDS, Scanner
from pnu.geometry.cloud_normals import GROUND, groups_alike, settled_normals
from pnu.geometry.normal_estimation import complete_normals
from pnu.geometry.scanner_within import scanner_within
from pnu.geometry.sphere_directions import sphere_directions
from pnu.io.sensor import Sight

Array = NDArray[np.float64]
SIZE = np.array([6.0, 4.0, 3.0])  # of the scanned room
PLACE = np.array([2.0, 2.4, 1.5])


def even_room(n: int = 6000) -> Array:
    """As many points of the same walls, the same everywhere."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, SIZE, (4 * n, 3))
    axis = rng.choice(3, 4 * n, p=(1 / SIZE) / (1 / SIZE).sum())
    points[np.arange(4 * n), axis] = np.where(rng.random(4 * n) < 0.5, 0, SIZE[axis])
    return points[:n]


@pytest.mark.parametrize("seed", range(3))
def test_the_place_is_found_however_the_room_lies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, shift, scale = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3), 10 ** rng.uniform(-3, 3)
    points, normals = scanned_room(PLACE + rng.uniform(-0.5, 0.5, 3) * seed)
    place = PLACE if seed == 0 else None
    order = rng.permutation(len(points))
    signs = rng.choice([-1.0, 1.0], (len(points), 1))  # lines have no side
    found = scanner_within(scale * (points @ turn.T + shift)[order], (signs * normals @ turn.T)[order])
    assert found is not None
    found = (found / scale - shift) @ turn
    if place is not None:
        assert np.linalg.norm(found - place) < 0.15
    assert (found > 0).all()
    assert (found < SIZE).all()


def test_walls_look_into_the_room_and_the_ball_looks_out() -> None:
    points, normals = scanned_room(PLACE)
    assert ((pnu.normals(points) * normals).sum(1) > 0).mean() > 0.98
    settled = settled_normals(points, None)
    assert ((settled.normals * normals).sum(1) > 0).mean() > 0.98
    assert "scanner within, at about" in settled.side


def test_the_same_room_sampled_evenly_is_a_box_that_looks_outward() -> None:
    points = even_room()
    assert scanner_within(points, complete_normals(points, None, 16)) is None
    outward = (pnu.normals(points) * (points - SIZE / 2)).sum(1)
    assert (outward > 0).mean() > 0.98


@pytest.mark.slow
def test_of_several_scanners_each_is_found_where_the_scans_are_told_apart() -> None:
    points, normals, _, scans = rescanned_room()
    assert ((pnu.normals(points) * normals).sum(1) > 0).mean() < 0.1
    assert ((pnu.normals(points, scans=scans) * normals).sum(1) > 0).mean() > 0.98
    settled = settled_normals(points, None, scans=scans)
    assert settled.side == "towards the scanners of 2 scans, found by their points"
    with pytest.raises(ValueError, match=r"scans: expected a number for each of \d+ points, found shape \(3,\)"):
        pnu.normals(points, scans=[1, 2, 3])


def test_groups_of_the_same_number() -> None:
    groups = groups_alike(np.array([3, 1, 3, 2, 1, 3]), 2)
    assert [group.tolist() for group in groups] == [[1, 4], [0, 2, 5]]
    assert groups_alike(np.empty(0), 1) == []


def test_of_many_scans_some_are_looked_for_and_what_sees_a_point_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a lidar that turns while it moves."""
    monkeypatch.setattr("pnu.geometry.cloud_normals.MOST_SCANS", 1)
    points, normals, places, scans = rescanned_room()
    settled = settled_normals(points, None, scans=scans)
    assert settled.side == "towards the scanners of 1 scan, found by their points"
    assert ((settled.normals * normals).sum(1) > 0).mean() > 0.98
    few = np.arange(len(points)) % 100  # scans of too few points to tell
    assert ((settled_normals(points, None, scans=few).normals * normals).sum(1) > 0).mean() < 0.1
    own = places + 1e-6 * np.random.default_rng(0).normal(size=places.shape)  # each point has a place of its own
    settled = settled_normals(points, None, found=Sight("on the way", viewpoint=own))
    assert ((settled.normals * normals).sum(1) > 0).mean() > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("more", [0, 200])
def test_of_several_places_what_sees_a_point_decides(more: int) -> None:
    """The way of a scanner, of which it is not known where it saw what."""
    points, normals, places, _ = rescanned_room()
    way = np.unique(places, axis=0)
    way = way[0] + np.linspace(0, 1, 2 + more)[:, None] * (way[1] - way[0])
    settled = settled_normals(points, None, asked=Sight("on its way", places=way))
    assert ((settled.normals * normals).sum(1) > 0).mean() > 0.98
    assert settled.side == "on its way"
    order = np.random.default_rng(0).permutation(len(points))
    again = settled_normals(points[order], None, asked=Sight("on its way", places=way[::-1]))
    np.testing.assert_allclose(again.normals, settled.normals[order], atol=1e-9)
    with pytest.raises(ValueError, match="viewpoint: its places lie .* expected places in the frame and the unit of"):
        settled_normals(points, None, asked=Sight("on its way", places=way + [447321.0, 5411934, 313]))


@pytest.mark.slow
def test_sensors_that_cannot_have_seen_the_points_are_not_believed() -> None:
    """As files name them that put all scans at one place, or the origin of a map for a scanner."""
    points, normals, true, scans = rescanned_room()
    for wrong in (true + [30, 0, 0], np.broadcast_to([1000.0, 1000, 0], points.shape)):
        settled = settled_normals(points, None, found=Sight("as the file says", viewpoint=wrong), scans=scans)
        assert ((settled.normals * normals).sum(1) > 0).mean() > 0.98
        assert "what the file says of the sensors of" in settled.words
        assert "found by their points" in settled.side
    half = np.where((scans == 0)[:, None], true, true + [30, 0, 0])
    for viewpoint, doubt in ((true, False), (half, True)):
        settled = settled_normals(points, None, found=Sight("as the file says", viewpoint=viewpoint))
        assert ((settled.normals * normals).sum(1) > 0).mean() > 0.98
        assert settled.side == "as the file says"
        assert ("can't be" in settled.words) == doubt


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["mug", "teddy", "nut"])
def test_none_is_found_in_what_was_scanned_from_outside(name: str, kind: str) -> None:
    points = KINDS[kind](Scanner(shapes.make(name)), np.random.default_rng(1)).points
    place = scanner_within(points, complete_normals(points, None, 16))
    if kind not in ("oneview", "depth"):  # whose camera is outside of the points
        assert place is None


def test_a_star_made_along_rays_from_its_middle_looks_outward() -> None:
    ways = sphere_directions(5000)
    points = (1 + 0.6 * ways[:, :1] * ways[:, 1:2] * ways[:, 2:] * 3**1.5) * ways
    assert scanner_within(points, complete_normals(points, None, 16)) is None
    assert ((pnu.normals(points) * points).sum(1) > 0).mean() > 0.99


@pytest.mark.slow
def test_of_flat_ground_alone_the_scanner_may_be_above_or_below() -> None:
    ways = sphere_directions(8000)
    ways = ways[(ways[:, 2] < -0.1) & (ways[:, 2] > -0.9)]
    ground = -1.7 * ways / ways[:, 2:]
    assert scanner_within(ground + [3.0, 0, 0], np.tile([0.0, 0, 1], (len(ground), 1))) is None
    assert (pnu.normals(ground + [3.0, 0, 0])[:, 2] > 0).all()


def test_few_points_and_equal_ones_tell_nothing() -> None:
    points, normals = scanned_room(PLACE, rays=900)
    assert scanner_within(points, normals) is None
    assert scanner_within(np.zeros((2000, 3)), np.tile([0.0, 0.0, 1.0], (2000, 1))) is None


@pytest.mark.slow
def test_ground_and_what_stands_on_it_look_up_and_out() -> None:
    points, normals = yard()
    settled = settled_normals(points, None)
    assert ((settled.normals * normals).sum(1) > 0).mean() > 0.98
    assert settled.side == GROUND
