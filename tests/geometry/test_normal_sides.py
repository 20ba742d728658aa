"""The side of normals: by what saw them, by their neighbors, by most of them; axes stay as they are."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import pnu
from bench.scenes import box, corridor, land, room
from pnu.geometry.cloud_normals import is_height_map, settled_normals
from pnu.geometry.normal_sides import repaired_signs, seen_signs
from pnu.io.sensor import Sight, asked_sight

Array = np.ndarray
UP = np.array([0.0, 0, 1])


def sphere(n: int, seed: int = 0) -> Array:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def shuffled(normals: Array) -> Array:
    """The axes, each with a sign that says nothing."""
    return normals * np.random.default_rng(1).choice([-1.0, 1.0], len(normals))[:, None]


def wrong(normals: Array, true: Array) -> float:
    return float(((normals * true).sum(1) < 0).mean())


HALF = sphere(3000)[sphere(3000)[:, 2] > 0]
SEEN = {
    "half sphere from outside": (HALF, HALF, {"viewpoint": np.array([0.3, 0, 4])}),
    "half sphere from inside": (HALF, -HALF, {"viewpoint": np.array([0.1, 0, 0.3])}),
    "sphere, whose back is not seen": (sphere(3000), sphere(3000), {"viewpoint": np.array([0, 0, 1.5])}),
    "box, of which three faces are seen": (*box(3000, (1, 1, 1)), {"viewpoint": np.array([3.0, 2, 1])}),
    "room from inside": (*room(), {"viewpoint": np.array([0, -1, 1.5])}),
    "corridor round a corner": (*corridor(), {"viewpoint": np.array([-3, 0, 0.2])}),
    "land from the air": (*land(), {"up": UP}),
    "noisy land from the air": (*land(0.15), {"up": UP}),
    "land from a hill": (*land(), {"viewpoint": np.array([0, 3.0, 20])}),
}


@pytest.mark.parametrize("case", SEEN)
def test_normals_look_to_where_they_were_seen_from(case: str) -> None:
    points, true, sight = SEEN[case]
    axes = shuffled(true)
    found = axes * seen_signs(points, axes, **sight)[:, None]
    assert wrong(found, true) < 5e-4
    if "back" not in case and "whose" not in case:
        assert 0.4 < wrong(axes, true) < 0.6


def test_the_way_to_the_sensor_alone_would_tear_walls_and_what_is_hidden() -> None:
    """What the test above asks for is more than the sign of a cosine."""
    for case, least in (("land from the air", 0.02), ("room from inside", 0.1), ("corridor round a corner", 0.05)):
        points, true, sight = SEEN[case]
        way = sight["viewpoint"] - points if "viewpoint" in sight else np.broadcast_to(UP, points.shape)
        tilted = true + 0.1 * np.random.default_rng(0).normal(size=true.shape)
        assert (np.sign((tilted * way).sum(1)) != np.sign((tilted * true).sum(1))).mean() > least, case


def test_what_is_clear_from_above_looks_up_whatever_its_neighbors_do() -> None:
    points, true = land()
    true[:4000:10] = [0.0, 0.6, 0.8]
    found = true * seen_signs(points, true, up=UP)[:, None]
    assert (found[np.abs(found[:, 2]) > 0.5, 2] > 0).all()


def test_each_point_may_have_its_own_sensor() -> None:
    points, true = box(3000, (1, 1, 1))
    places = 2 * true + points
    places[::3] = np.nan
    axes = shuffled(true)
    assert wrong(axes * seen_signs(points, axes, viewpoint=places)[:, None], true) == 0
    inside = seen_signs(points, axes, viewpoint=np.where(points[:, :1] > 2, np.nan, points - true))
    assert wrong(axes * inside[:, None], -true) == 0


def test_order_motion_and_unit_do_not_matter() -> None:
    points, true = land(0.1)
    axes, rng = shuffled(true), np.random.default_rng(2)
    expected = pnu.normals(points, axes, up="z")
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    order = rng.permutation(len(points))
    np.testing.assert_array_equal(pnu.normals(points[order], axes[order], up="z"), expected[order])
    for scale, shift in ((1e-5, 0.0), (1.0, 1e6), (1e5, -3e7)):
        moved = pnu.normals(scale * points @ turn.T + shift, axes @ turn.T, up=turn @ UP)
        assert wrong(moved @ turn, expected) < 2e-3
    viewpoint = np.array([3.0, 4, 60])
    expected = pnu.normals(points, axes, viewpoint=viewpoint)
    moved = pnu.normals(20 * points @ turn.T + 1e5, axes @ turn.T, viewpoint=20 * turn @ viewpoint + 1e5)
    assert wrong(moved @ turn, expected) < 2e-3


def in_patches(points: Array, share: float) -> Array:
    """Signs, of which a share is negative in patches."""
    rng = np.random.default_rng(3)
    near = cKDTree(points[rng.choice(len(points), 40, replace=False)]).query(points)[1]
    return np.where(np.isin(near, rng.choice(40, round(40 * share), replace=False)), -1.0, 1.0)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("kind", ["patches", "single points"])
def test_turned_normals_of_a_closed_shape_are_repaired(share: float, kind: str) -> None:
    points, true = box(4000, (1, 0.7, 0.4))
    rng = np.random.default_rng(4)
    sign = in_patches(points, share) if kind == "patches" else np.where(rng.random(len(points)) < share, -1.0, 1.0)
    noisy = points + 0.004 * rng.normal(size=points.shape)
    found = repaired_signs(noisy, true * sign[:, None])
    assert (found.signs != sign).mean() < 1e-3
    assert found.side == "outward"


def test_most_decide_on_open_shapes_piece_by_piece_and_on_closed_ones_where_they_are_many() -> None:
    sheet = np.hstack([np.random.default_rng(5).uniform(-1, 1, (1500, 2)), np.zeros((1500, 1))])
    two = np.vstack([sheet, sheet + [0, 0, 5]])
    true = np.repeat([[0, 0, 1.0], [0, 0, -1.0]], 1500, 0)
    sign = in_patches(two, 0.2)
    assert [(sign[half] < 0).mean() < 0.5 for half in (slice(1500), slice(1500, None))] == [True, True]
    found = repaired_signs(two, true * sign[:, None])
    np.testing.assert_array_equal(found.signs, sign)
    assert found.side == "most"
    points, true = room()
    sign = in_patches(points, 0.2)
    found = repaired_signs(points, true * sign[:, None])
    assert (found.signs != sign).mean() < 0.01
    assert found.side == "most"


def test_what_is_done_is_said() -> None:
    points = sphere(1000)
    sign = np.where(np.random.default_rng(6).random(1000) < 0.3, -1.0, 1.0)
    given = points * sign[:, None]
    turned = int((sign < 0).sum())
    repaired = settled_normals(points, given)
    assert f"1000 given, {turned} of them turned over (4" in repaired.words
    assert repaired.words.endswith("of neighbors contradicted each other); side: outward, by the winding field")
    np.testing.assert_array_equal(repaired.normals, points)
    assert settled_normals(points, points).words == "1000 given, none of them turned over"
    np.testing.assert_array_equal(settled_normals(points, given, choice="keep").normals, given)
    estimated = settled_normals(points, given, choice="estimate")
    assert estimated.words == "1000 estimated; side: outward, by the winding field"
    assert 0.9 < (estimated.normals * points).sum(1).min() < 1
    oriented = settled_normals(points, -points, choice="orient")
    assert oriented.words == "1000 given, 1000 of them turned over; side: outward, by the winding field"
    inside = Sight("towards the sensor", viewpoint=np.zeros(3))
    assert settled_normals(points, points, found=inside).words.endswith("none of them turned over")
    assert settled_normals(points, given, found=inside).words.endswith("; side: towards the sensor")
    np.testing.assert_array_equal(settled_normals(points, points, asked=inside).normals, -points)
    np.testing.assert_array_equal(settled_normals(points, points, asked=asked_sight(side="in")).normals, -points)
    given[::2] = np.nan
    some = settled_normals(points, np.where(np.isnan(given), np.nan, points))
    assert some.words == "500 given, none of them turned over, 500 estimated; side: as the nearest given"
    assert (some.normals * points).sum(1).min() > 0.9
    np.testing.assert_array_equal(some.normals[1::2], points[1::2])
    sheet = np.hstack([np.random.default_rng(7).uniform(-1, 1, (500, 2)), np.zeros((500, 1))])
    assert settled_normals(sheet, None).words == "500 estimated; side: up, as land that was seen from above"


def test_a_part_that_looks_to_the_other_side_is_found_and_turned() -> None:
    points = sphere(3000)
    sign = np.where(points[:, 0] > 0.4, -1.0, 1.0)
    found = settled_normals(points, points * sign[:, None])
    assert f"{(sign < 0).sum()} of them turned over (at least 3" in found.words
    assert "looked to the other side than those beside them); side: outward" in found.words
    np.testing.assert_array_equal(found.normals, points)


def test_a_map_of_heights_is_seen_from_above() -> None:
    x, y = np.meshgrid(np.arange(20) * 60 + 440750, np.arange(20) * 60 + 3751290)
    heights = np.stack([x.ravel(), y.ravel(), 30 * np.sin(x / 300).ravel()], 1).astype(float)
    some = heights[np.random.default_rng(8).random(400) < 0.8]
    assert is_height_map(heights)
    assert is_height_map(some)
    assert settled_normals(some, None).words == f"{len(some)} estimated; side: up, as a map of heights"
    assert (pnu.normals(heights)[:, 2] > 0).all()
    assert not is_height_map(np.vstack([heights, heights + [0, 0, 5]]))  # two heights at a place
    assert not is_height_map(sphere(400))
    assert not is_height_map(heights[:, [0, 2, 1]])


def test_from_python() -> None:
    points = sphere(1000)
    given = shuffled(points)
    np.testing.assert_allclose(pnu.normals(points, 3 * given), points, atol=1e-12)
    np.testing.assert_allclose(pnu.normals(points, given, viewpoint=[0, 0, 0]), -points, atol=1e-12)
    np.testing.assert_allclose(pnu.normals(points, given, viewpoint=3 * points), points, atol=1e-12)
    np.testing.assert_allclose(pnu.normals(points, given, side="in"), -points, atol=1e-12)
    twice = np.vstack([points, points[:300], np.full((2, 3), np.nan)])
    found = pnu.normals(twice, np.vstack([given, given[:302]]), viewpoint=np.vstack([3 * points, np.ones((302, 3))]))
    np.testing.assert_allclose(found[:1300], twice[:1300], atol=1e-12)
    assert np.isnan(found[1300:]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"viewpoint": [1, 2]},
            r"^viewpoint=\[1, 2\]: expected the place of the sensor, viewpoint=x,y,z, or a file of places$",
        ),
        ({"viewpoint": [1, 2, np.nan]}, "^viewpoint=.*: expected three numbers, found NaN$"),
        ({"viewpoint": np.ones((5, 3))}, r"^viewpoint: expected \(3,\) or \(100, 3\), found shape \(5, 3\)$"),
        ({"viewpoint": "here"}, "^viewpoint=here: expected the place of the sensor"),
        ({"up": "w"}, "^up=w: expected x, y, z, -x, -y or -z, the axis that points up$"),
        ({"up": [0, 0, 0]}, "^up="),
        ({"side": "left"}, "^side=left: expected out or in"),
        ({"up": "z", "side": "in"}, "^up= and side=: both decide the side of normals; give one of them$"),
        ({"normals": np.ones((5, 3))}, r"^points: expected normals of shape \(100, 3\), found \(5, 3\)$"),
    ],
)
def test_wrong_arguments_are_one_line(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pnu.normals(sphere(100), **arguments)  # type: ignore[arg-type]
