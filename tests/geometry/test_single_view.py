"""A cloud seen from one side is known by that nothing lies behind anything, and its normals look there."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import pnu
from pnu.data import shapes
from pnu.data.scanner import KINDS, DepthCamera, Scanner
from pnu.geometry.cloud_normals import FROM_ABOVE, ONE_SIDE, settled_normals, sight_by_places
from pnu.geometry.mesh_sampling import sample_poisson_disk
from pnu.geometry.single_view import camera_place, is_camera, seen_from_one_side, single_view
from pnu.geometry.sphere_directions import sphere_directions
from pnu.io.sensor import Sight

Array = NDArray[np.float64]
BALLS = np.array(
    [[0, 0, 0, 0.5], [0.45, 0.1, 0.8, 0.25], [-0.3, 0.4, 0.6, 0.3], [-0.1, -0.5, -0.7, 0.6], [0.6, -0.5, 0.4, 0.2]]
)


def view_of_balls(across: int = 70) -> tuple[Array, Array]:
    """Points and outward normals of five balls as a camera far up the z axis sees them, one a pixel."""
    x, y = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1.2, 1.2, across)] * 2))
    rise = BALLS[:, 3, None] ** 2 - (x - BALLS[:, :1]) ** 2 - (y - BALLS[:, 1:2]) ** 2
    top = np.where(rise > 0, BALLS[:, 2:3] + np.sqrt(np.maximum(rise, 0)), -np.inf)
    ball = top.argmax(0)
    points = np.stack([x, y, top.max(0)], 1)
    normals = (points - BALLS[ball, :3]) / BALLS[ball, 3:]
    seen = np.isfinite(points[:, 2]) & (normals[:, 2] > 0.1)
    return points[seen], normals[seen]


def around_balls(n: int) -> Array:
    """Points all around the same balls."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(len(BALLS), n, 3))
    return np.concatenate(BALLS[:, None, :3] + BALLS[:, None, 3:] * unit / np.linalg.norm(unit, axis=2, keepdims=True))


@pytest.mark.parametrize("seed", range(3))
def test_the_direction_is_found_wherever_the_cloud_lies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    points = view_of_balls()[0]
    moved = 40 * points[rng.permutation(len(points))] @ turn.T + rng.normal(size=3)
    found = single_view(moved)
    assert found is not None
    assert abs(found @ turn[:, 2]) > np.cos(np.radians(15))


def test_there_is_none_where_the_back_is_seen_too_or_points_are_few() -> None:
    assert single_view(around_balls(600)) is None
    points = view_of_balls()[0]
    assert single_view(np.vstack([points, around_balls(150)])) is None
    assert single_view(points[:: len(points) // 150]) is None
    assert seen_from_one_side(around_balls(600), np.ones((3000, 3))) is None


def test_all_pieces_look_to_the_camera() -> None:
    points, true = view_of_balls()
    sign = np.where(points[:, 0] > 0.25, -1.0, 1.0)
    found = seen_from_one_side(points, true * sign[:, None])
    assert found is not None
    assert ((found.normals * true).sum(1) < 0).mean() < 1e-3
    assert not found.above
    turn = Rotation.from_euler("xyz", [0.4, 1.1, 2.0]).as_matrix()
    settled = settled_normals(points @ turn.T, None)
    assert ((settled.normals @ turn * true).sum(1) < 0).mean() < 0.005
    assert settled.words == f"{len(points)} estimated; side: {ONE_SIDE}"
    dense = pnu.upsample(points @ turn.T, ratio=2)
    assert ((dense[:, 3:] @ turn)[:, 2] > 0).mean() > 0.98


def test_dishes_and_cups_of_one_view_look_to_one_side() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1.1, 1.1, 60)] * 2))
    height = np.full_like(x, np.nan)
    for number, (center_x, center_y) in enumerate(((0.5, 0.5), (-0.5, 0.5), (0.5, -0.5), (-0.5, -0.5))):
        aside = np.hypot(x - center_x, y - center_y)
        bulge = (-1.0) ** (number + 1) * np.sqrt(np.maximum(0.2 - aside**2, 0))
        height = np.where(aside < 0.4, bulge + 0.7 * number, height)
    points = np.stack([x, y, height], 1)[np.isfinite(height)]
    turn = Rotation.from_euler("xyz", [0.4, 1.1, 2.0]).as_matrix()
    up = (settled_normals(points @ turn.T, None).normals @ turn)[:, 2] > 0
    assert up.mean() < 0.01 or up.mean() > 0.99


@pytest.mark.parametrize("thickness", [0.06, 0.12])
def test_thin_plates_have_two_sides(thickness: float) -> None:
    rng = np.random.default_rng(2)
    face = rng.uniform(-1, 1, (2000, 2))
    around = rng.uniform(-1, 1, (300, 2)) * [1, thickness / 2]
    sides = [np.stack([around[:, 0], np.sign(rng.normal(size=300)), around[:, 1]], 1)]
    sides.append(sides[0][:, [1, 0, 2]])
    points = np.vstack([np.c_[face, np.where(rng.random(2000) < 0.5, 1, -1) * thickness / 2], *sides])
    settled = settled_normals(points @ Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix().T, None)
    up = (settled.normals @ Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix())[:2000, 2]
    assert (up * points[:2000, 2] > 0).mean() > 0.98
    assert settled.words.endswith("outward, by the winding field")


def room_from_a_camera(across: int = 60) -> tuple[Array, Array]:
    """Floor, wall and a ball before it as a camera at the origin that looks along z sees them, and true normals."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.5, 0.5, across)] * 2))
    rays = np.stack([u, v, np.ones_like(u)], 1)
    planes = np.array([[0, 0, -1.0, 3.0], [0, -1.0, 0, 1.0]])  # inward normals, and the distance of each
    with np.errstate(divide="ignore"):
        depths = np.where(rays @ -planes[:, :3].T > 0, planes[:, 3] / (rays @ -planes[:, :3].T), np.inf)
    depth, normals = depths.min(1), planes[depths.argmin(1), :3]
    center, radius = np.array([0.1, 0.2, 2.2]), 0.4
    b, c = rays @ center, center @ center - radius**2
    hit = b * b > (rays**2).sum(1) * c
    near = (b - np.sqrt(np.maximum(b * b - (rays**2).sum(1) * c, 0))) / (rays**2).sum(1)
    depth = np.where(hit, near, depth)
    points = depth[:, None] * rays
    return points, np.where(hit[:, None], (points - center) / radius, normals)


@pytest.mark.slow
def test_the_pixels_of_a_camera_at_the_origin_look_to_it() -> None:
    points, true = room_from_a_camera()
    assert is_camera(np.zeros(3), points)
    settled = settled_normals(points, None)
    assert ((settled.normals * true).sum(1) < 0).mean() < 0.005
    assert settled.words == f"{len(points)} estimated; side: towards a camera at the origin, whose pixels they are"
    dense = pnu.upsample(points, ratio=2)
    assert ((dense[:, :3] * dense[:, 3:]).sum(1) < 0).mean() > 0.99
    random = points[np.random.default_rng(0).random(len(points)) < 0.7]
    for other in (points - [0, 0, 4], points + [0, 0, 100], random, points[:150]):
        assert not is_camera(np.zeros(3), other)


@pytest.mark.slow
def test_land_looks_up() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 100, (2, 3000))
    land = np.stack([x, y, 4 * np.sin(x / 9) * np.cos(y / 7) + 250], 1)
    for flipped in (1, -1):
        settled = settled_normals(land * [1, 1, flipped], None)
        assert (settled.normals[:, 2] > 0.3).mean() > 0.98
        assert settled.words == f"3000 estimated; side: {FROM_ABOVE}"


@pytest.mark.parametrize(
    ("name", "seed"), [("head", 0), ("nut", 1), ("dancer", 2), ("figure_eight", 3), ("figure_eight", 0)]
)
def test_the_place_of_a_camera_is_found(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scan = KINDS["oneview"](Scanner(shapes.make(name)), rng)
    turn, scale, shift = Rotation.random(rng=rng).as_matrix(), 10 ** rng.uniform(-2, 3), 100 * rng.normal(size=3)
    moved, sensor = (scale * values @ turn.T + shift for values in (scan.points, scan.sensor[0]))
    place = camera_place(moved)
    assert place is not None
    way, found = sensor - moved.mean(0), place - moved.mean(0)
    assert found @ way > np.cos(np.radians(10)) * np.linalg.norm(found) * np.linalg.norm(way)
    assert 0.8 < np.linalg.norm(found) / np.linalg.norm(way) < 1.25
    np.testing.assert_array_equal(camera_place(moved[rng.permutation(len(moved))]), place)
    sight = sight_by_places(moved)
    assert sight is not None
    assert sight.words.startswith("towards a camera at ")


@pytest.mark.parametrize("name", ["teapot", "dice", "walnut"])
def test_the_camera_of_many_noisy_pixels_is_found(name: str) -> None:
    camera = DepthCamera(half=0.42, across=330, down=330, noise=0.01, slant=0.1, step=0.004, torn=0.25)
    sensor = 2.6 * sphere_directions(7, 0.3)[3]
    scan = Scanner(shapes.make(name)).views(sensor[None], camera, np.random.default_rng(0))
    place = camera_place(scan.points)
    assert place is not None
    assert np.linalg.norm(place - sensor) < 0.1 * np.linalg.norm(sensor)


def test_a_camera_is_not_found_where_there_was_none() -> None:
    rng = np.random.default_rng(0)
    turn = Rotation.random(rng=rng).as_matrix()
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1, 1, 50)] * 2))
    bent = np.stack([u, v, 0.4 * np.sin(3 * u) * np.cos(2 * v)], 1)
    random = rng.uniform(-1, 1, (3000, 2))
    even = sample_poisson_disk(shapes.make("head"), 3000, rng)
    clouds = {
        "seen from afar, in even rows": bent @ turn.T,
        "as it fell": np.column_stack([random, np.sin(3 * random[:, 0])]) @ turn.T,
        "evenly spread over one side": even[even[:, 5] > 0.1, :3],
        "evenly spread all around": even[:, :3],
        "at random all around": around_balls(600),
        "from ten sides": KINDS["orbit"](Scanner(shapes.make("head")), rng).points,
        "too few": view_of_balls(14)[0],
        "all at one place": np.ones((300, 3)),
    }
    assert {name: camera_place(points) for name, points in clouds.items()} == dict.fromkeys(clouds)


@pytest.mark.slow
def test_normals_of_a_flat_thing_look_to_the_camera_that_saw_it() -> None:
    scan = KINDS["oneview"](Scanner(shapes.make("washer")), np.random.default_rng(4))
    points, true = scan.points[~scan.stray], scan.clean[~scan.stray, 3:]
    assert ((settled_normals(points, None).normals * true).sum(1) < 0).mean() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("told", [False, True])
def test_what_a_camera_saw_looks_to_it_even_where_it_bends_away(told: bool) -> None:
    for name, seed in (("impeller", 2), ("caltrop", 3), ("nut", 5)):
        scan = KINDS["oneview"](Scanner(shapes.make(name)), np.random.default_rng(seed))
        points, sensor = scan.points[~scan.stray], scan.sensor[0]
        sight = Sight("told", viewpoint=sensor) if told else None
        normals = settled_normals(points, None, asked=sight).normals
        way = sensor - points
        cosine = (normals * way).sum(1) / np.linalg.norm(way, axis=1)
        assert (cosine < -0.5).sum() == 0
