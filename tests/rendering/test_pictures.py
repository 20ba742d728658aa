"""Pictures: what is visible, where, in which color; and figures put together from them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from pnu.commands.picture import main as picture
from pnu.geometry.mesh_topology import corner_normals, split_creases
from pnu.geometry.spacing import spacing
from pnu.io import Mesh, write_cloud
from pnu.rendering import (
    Camera,
    ColorBar,
    figure,
    in_one_place,
    look_at,
    raster,
    render_cloud,
    render_mesh,
    save_png,
    turntable,
)  # fmt: skip
from pnu.rendering.colors import LMS, RGB, linear_light, normal_colors, srgb, value_colors
from pnu.rendering.figure import colorbar_figure, draw_colorbar, extent
from pnu.rendering.render import in_front

FRONT = Camera(np.eye(3), np.zeros(3), 1.0)


def sphere(n: int) -> np.ndarray:
    """Spiral points on the unit sphere, with normals, (n, 6)."""
    z = 1 - (2 * np.arange(n) + 1) / n
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    ring = np.sqrt(1 - z**2)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)
    return np.hstack([points, points])


def octahedron() -> Mesh:
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    return Mesh(vertices, faces)


def slow_visible(corners: np.ndarray, height: int, width: int) -> np.ndarray:
    """Front-most triangle of each pixel, -1 for none: every pixel against every triangle."""
    y, x = np.mgrid[:height, :width] + 0.5
    best, depth = np.full((height, width), -1), np.full((height, width), -np.inf)
    for face, corner in enumerate(corners):
        m = np.linalg.inv(np.vstack([corner[:, :2].T, np.ones(3)]))
        weight = m @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        z = (corner[:, 2] @ weight).reshape(height, width)
        front = (weight >= 0).all(0).reshape(height, width) & (z > depth)
        best[front], depth[front] = face, z[front]
    return best


def test_triangles_agree_with_every_pixel_against_every_triangle(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(-10, 50, (60, 3, 3))
    expected = slow_visible(corners, 40, 45)
    for chunk in (1 << 21, 50):  # in one go and in many small parts
        monkeypatch.setattr("pnu.geometry.ragged.CHUNK", chunk)
        found = raster.triangles(corners, 40, 45)
        picture = np.full(40 * 45, -1)
        picture[found.pixel] = found.primitive
        np.testing.assert_array_equal(picture.reshape(40, 45), expected)
    assert (expected >= 0).any()


def test_triangles_that_share_edges_cover_each_pixel_once() -> None:
    turn = np.linspace(0, 2 * np.pi, 64)
    rim = 20 + 30 * np.stack([np.cos(turn), np.sin(turn)], 1)
    fan = np.stack([np.full((63, 2), 20.0), rim[:-1], rim[1:]], 1)
    corners = np.concatenate([fan, np.zeros((63, 3, 1))], 2)
    assert len(raster.triangles(corners, 40, 40).pixel) == 1600
    single = [raster.triangles(corner[None], 40, 40).pixel for corner in corners]
    assert sum(map(len, single)) == 1600


def test_balls_show_the_nearest() -> None:
    found = raster.balls(np.array([[10.0, 10, 0], [12, 10, 5], [30, 30, 0]]), 3.0, 40, 40)
    owner = dict(zip(found.pixel.tolist(), found.primitive.tolist(), strict=True))
    assert owner[10 * 40 + 8] == 0
    assert owner[10 * 40 + 11] == 1
    assert owner[30 * 40 + 30] == 2
    assert 20 * 40 + 20 not in owner
    assert sum(v == 2 for v in owner.values()) == pytest.approx(np.pi * 9, abs=4)


def test_camera_sees_everything_and_mirrors_nothing() -> None:
    points = np.random.default_rng(1).normal(size=(100, 3)) * [1, 2, 3] + 50
    for up in "xyz":
        camera = look_at(points, azimuth=70, elevation=-20, up=up)
        view = camera.view(points)
        assert np.abs(view[:, :2]).max() == pytest.approx(1 / 1.04)
        assert np.linalg.det(camera.rotation) == pytest.approx(1)
        straight = look_at(points, azimuth=0, elevation=0, up=up)
        np.testing.assert_allclose(straight.rotation[1], np.eye(3)["xyz".index(up)], atol=1e-12)


def test_a_turntable_keeps_scale_and_center_and_sees_everything() -> None:
    points = np.random.default_rng(2).normal(size=(300, 3)) * [3, 1, 0.2] + [50, 0, 0]
    cameras = turntable(points, frames=8, azimuth=20, up="z")
    for number, camera in enumerate(cameras):
        np.testing.assert_allclose(camera.rotation, look_at(points, azimuth=20 + 45 * number, up="z").rotation)
        assert np.abs(camera.view(points)[:, :2]).max() < 1
    assert len({(camera.half_size, *camera.center) for camera in cameras}) == 1
    assert max(np.abs(camera.view(points)[:, :2]).max() for camera in cameras) > 0.9


def test_mesh_covers_its_projection_and_shades_with_light_from_above() -> None:
    picture = render_mesh(octahedron(), camera=FRONT, size=100)
    drawn = (picture < 255).any(2)
    assert drawn.sum() == pytest.approx(100 * 100 / 2, rel=0.03)  # the square |x| + |y| < 1
    assert picture[35, 50].mean() > picture[65, 50].mean()
    np.testing.assert_array_equal(picture[2, 2], 255)


def test_inside_is_drawn_in_another_color() -> None:
    mesh = octahedron()
    outside = render_mesh(mesh, camera=FRONT, size=60)[30, 25].astype(int)
    inside = render_mesh(Mesh(mesh.vertices, mesh.faces[:, ::-1]), camera=FRONT, size=60)[30, 25].astype(int)
    assert outside.max() - outside.min() < 12
    assert inside[0] - inside[2] > 20


def test_vertex_colors_are_interpolated() -> None:
    mesh = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]]), np.array([[0, 1, 2], [1, 3, 2]]))
    colors = np.array([[255, 0, 0], [0, 0, 255], [255, 0, 0], [0, 0, 255]], np.uint8)
    row = render_mesh(mesh, colors, camera=FRONT, size=64)[32].astype(int)
    assert row[2, 0] > row[2, 2] + 100
    assert row[61, 2] > row[61, 0] + 100
    assert abs(row[32, 0] - row[32, 2]) < 25


def test_sharp_edges_stay_sharp_and_gentle_ones_are_smoothed() -> None:
    def roof(slope: float) -> np.ndarray:
        vertices = np.array([[-1.0, 0, -slope], [0, 0, 0], [0, 1, 0], [1, 0, -slope]])
        return corner_normals(Mesh(vertices, np.array([[0, 1, 2], [1, 3, 2]])))

    gentle, sharp = roof(0.1), roof(2.0)
    np.testing.assert_allclose(gentle[:, 1:3].reshape(-1, 3)[0], gentle[1, 0], atol=1e-12)
    assert (sharp[0, 1] * sharp[1, 0]).sum() == pytest.approx(-0.6)  # (-2, 0, 1) . (2, 0, 1) / 5


def test_creases_are_split() -> None:
    x, y, z = (c.ravel() for c in np.meshgrid([0.0, 1], [0.0, 1], [0.0, 1]))
    hull = trimesh.PointCloud(np.stack([x, y, z], 1)).convex_hull
    vertices, normals, faces = split_creases(Mesh(np.asarray(hull.vertices), np.asarray(hull.faces)))
    assert len(vertices) == 24  # eight corners of a cube, three sides each
    np.testing.assert_allclose(np.abs(normals).max(1), 1)
    np.testing.assert_allclose(vertices[faces], hull.vertices[hull.faces])


def test_cloud_shows_normals_as_colors_and_hides_the_far_side() -> None:
    cloud = sphere(3000)
    seen = render_cloud(cloud, camera=FRONT, size=200)
    middle = seen[90:110, 90:110].reshape(-1, 3).astype(int)
    ink = middle[(middle < 250).any(1)]
    assert (ink[:, 2] > ink[:, :2].max(1)).mean() > 0.95  # normals towards the viewer: blue
    y, x = np.mgrid[20:81:2, 20:81:2].astype(float)
    sheet = np.stack([x.ravel(), y.ravel(), 0.5 * x.ravel()], 1)
    behind = np.array([[51.0, 51, 25], [51, 51, 5], [90, 51, 5]])
    assert in_front(np.concatenate([behind, sheet]), 8, 100).tolist() == [True, False, True] + [True] * len(sheet)
    open_picture = render_cloud(cloud, camera=FRONT, size=200, hide=False)
    assert (open_picture < 255).any(2).sum() > (seen < 255).any(2).sum()


def test_a_small_object_at_map_coordinates_looks_the_same() -> None:
    """Ten centimetres, in metres, thousands of kilometres from the origin."""
    near = sphere(300) * [0.05, 0.05, 0.05, 1, 1, 1]
    far = near + [4_123_456.789, 5_312_345.678, 123.4, 0, 0, 0]
    pictures = [render_cloud(cloud, camera=look_at(cloud), size=60).astype(int) for cloud in (near, far)]
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.5
    mesh = octahedron()
    for cloud, scale in ((near, 0.05), (far, 0.05)):
        place = mesh._replace(vertices=mesh.vertices * scale + cloud[:, :3].mean(0))
        pictures.append(render_mesh(place, camera=look_at(place.vertices), size=60).astype(int))
    assert np.abs(pictures[2] - pictures[3]).mean() < 0.5


def test_spacing_knows_density_not_randomness() -> None:
    rng = np.random.default_rng(2)
    random = rng.normal(size=(4000, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    exact = np.sqrt(4 * np.pi / 4000)
    assert spacing(sphere(4000)[:, :3]) == pytest.approx(exact, rel=0.15)
    assert spacing(random) == pytest.approx(exact, rel=0.15)


def test_pictures_repeat_exactly() -> None:
    cloud = sphere(500)
    np.testing.assert_array_equal(
        render_cloud(cloud, camera=FRONT, size=80), render_cloud(cloud, camera=FRONT, size=80)
    )


def test_nothing_is_drawn_blank() -> None:
    away = Camera(np.eye(3), np.full(3, 100.0), 1.0)
    with pytest.raises(ValueError, match="nothing to see"):
        render_cloud(sphere(100), camera=away)
    with pytest.raises(ValueError, match="nothing to see"):
        render_mesh(octahedron(), camera=away)
    with pytest.raises(ValueError, match="finite"):
        render_cloud(np.full((20, 3), np.nan), camera=FRONT)
    with pytest.raises(ValueError, match="0 faces"):
        render_mesh(Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int64)), camera=FRONT)
    with pytest.raises(ValueError, match=r"panel 2 of 2 .*blank"):
        figure([octahedron_picture(), np.full((60, 60, 3), 255, np.uint8)], ["a", "b"])


def octahedron_picture(size: int = 60) -> np.ndarray:
    return render_mesh(octahedron(), camera=FRONT, size=size)


def test_figure_puts_panels_side_by_side() -> None:
    panel = octahedron_picture()
    wide = figure([panel, panel, panel], ["one", "two\nlines", "three"])
    tall = figure([panel, panel, panel], ["one", "two\nlines", "three"], columns=1)
    assert wide.shape[1] > 2.5 * tall.shape[1]
    assert tall.shape[0] > 2.5 * wide.shape[0]
    column = (wide < 255).any((0, 2)).astype(int)
    assert (np.diff(column) == 1).sum() >= 3  # three separate blocks of ink
    bar = figure([panel], [""], colorbar=ColorBar((0, 2), "error"))
    assert bar.shape[1] > figure([panel], [""]).shape[1]
    reds = (bar[..., 0] > 180) & (bar[..., 2] < 40)
    blues = (bar[..., 2] > 180) & (bar[..., 0] < 40)
    assert np.flatnonzero(reds.any(1)).mean() > np.flatnonzero(blues.any(1)).mean()  # red = low, at the bottom


def test_different_objects_are_each_seen_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A larger one beside the first, through the first's camera, was a few balls that fill the panel, or nothing."""
    small, large = sphere(2000), sphere(2000)
    large[:, :3] = 30 * large[:, :3] + [5, 0, 0]
    noisy = np.vstack([small, small[:1] + [200.0, 0, 0, 0, 0, 0]])  # one point far away: the same place still
    for name, cloud in (("small", small), ("large", large), ("noisy", noisy)):
        np.save(tmp_path / f"{name}.npy", cloud)

    def ink(*names: str, **keys: int) -> tuple[list[float], str]:
        """Share of each panel that is drawn, and what was said."""
        inputs = ",".join(str(tmp_path / f"{name}.npy") for name in names)
        more = [f"{key}={value}" for key, value in keys.items()]
        picture([f"inputs=[{inputs}]", f"output={tmp_path / 'a.png'}", "size=120", *more])
        drawn = (np.asarray(Image.open(tmp_path / "a.png")) < 250).any(2)
        width = drawn.shape[1] // len(names)
        return [float(drawn[:, i * width : (i + 1) * width].mean()) for i in range(len(names))], capsys.readouterr().out

    (first, second), said = ink("small", "large")
    assert first == pytest.approx(second, rel=0.1)
    assert "scale:  each panel its own" in said
    (first, second), said = ink("small", "noisy")
    assert first == pytest.approx(second, rel=0.1)
    assert "scale:" not in said
    (first, second), said = ink("small", "large", fit=0)  # all together
    assert first < 0.1 < second
    assert "scale:" not in said
    assert in_one_place(small, small, noisy)
    assert not in_one_place(small, small + 3)


@pytest.mark.slow
def test_columns_of_text_and_panels_in_a_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = sphere(300)
    np.savetxt(tmp_path / "c.txt", np.hstack([cloud[:, 3:], cloud[:, :3]]))
    write_cloud(tmp_path / "d.ply", cloud[:, :3])

    def draw(*more: str, inputs: str = "c.txt,d.ply") -> str:
        files = ",".join(f"{tmp_path}/{name}" for name in inputs.split(","))
        picture([f"inputs=[{files}]", f"output={tmp_path}/a.png", "size=60", *more])
        return capsys.readouterr().out

    assert "(cloud, color=normal)" in draw("columns=nx,ny,nz,x,y,z")
    assert "c.txt (cloud, color=plain)" in draw("columns=_,_,_,x,y,z", "panels=1")
    one = np.asarray(Image.open(tmp_path / "a.png")).shape
    draw("columns=_,_,_,x,y,z", "panels=2")
    two = np.asarray(Image.open(tmp_path / "a.png")).shape
    assert one[0] > two[0]
    assert one[1] < two[1]
    for wrong, message in {
        "columns=2": "columns=2: expected names such as x,y,z,_,r,g,b; panels=2 puts as many in a row",
        "columns=x,y": "columns=x,y: expected x, y and z among the names",
        "panels=0": "panels=0: expected a number above 0",
    }.items():
        with pytest.raises(SystemExit):
            draw(wrong)
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        draw("columns=x,y,z", inputs="d.ply,d.ply")
    assert "columns=x,y,z: is for text and arrays without names, and inputs has none of them" in capsys.readouterr().err


def test_crop_keeps_all_ink() -> None:
    panel = np.full((50, 50, 3), 255, np.uint8)
    panel[20:30, 10:40] = 0
    assert extent([panel], 0, 2) == (18, 32)
    assert extent([panel], 1, 2) == (8, 42)


def test_figure_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="different sizes"):
        figure([octahedron_picture(60), octahedron_picture(40)])
    with pytest.raises(ValueError, match="2 panels and 1 captions"):
        figure([octahedron_picture(), octahedron_picture()], ["one"])


def test_save_png(tmp_path) -> None:  # type: ignore[no-untyped-def]
    picture = octahedron_picture()
    save_png(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), picture)
    with pytest.raises(ValueError, match="blank"):
        save_png(tmp_path / "b.png", np.full((9, 9, 3), 255, np.uint8))
    with pytest.raises(ValueError, match=r"\.png"):
        save_png(tmp_path / "c.jpg", picture)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 2.3), (-0.02, 0.07), (100, 1e5), (3.1, 3.2)])
def test_ticks_are_few_and_round(low: float, high: float) -> None:
    axes = colorbar_figure(ColorBar((low, high), "error"), 400, 18).axes[0]
    found = [place for place in axes.get_yticks() if low - 1e-9 <= place <= high * (1 + 1e-9)]
    assert 4 <= len(found) <= 11
    assert axes.get_ylabel() == "error"
    assert low - 1e-9 <= found[0]
    assert found[-1] <= high + 1e-9 * high
    np.testing.assert_allclose(np.diff(found), found[1] - found[0])


def test_a_color_bar_is_as_high_as_asked_and_cut_to_its_ink() -> None:
    bar = ColorBar((0, 2), "a label that is far too long for a bar of this height, whatever it says")
    for height in (80, 331):
        picture = draw_colorbar(bar, height, 18)
        assert picture.shape[0] == height
        ink = np.flatnonzero((picture < 255).any((1, 2)))
        assert 0 < ink[0] < ink[-1] < height - 1
        assert 0 < picture.shape[1] < 150
        np.testing.assert_array_equal(picture, draw_colorbar(bar, height, 18))


def test_error_colors_run_from_red_to_blue() -> None:
    red, green, blue = value_colors(np.array([-1.0, 0.6, 9.0]), (0, 1)).astype(int)
    assert red.argmax() == 0
    assert green.argmax() == 1
    assert blue.argmax() == 2
    np.testing.assert_array_equal(value_colors(np.array([np.nan]), (0, 1)), [[153, 153, 153]])
    with pytest.raises(ValueError, match="error, perceptual"):
        value_colors(np.zeros(1), (0, 1), "jet")
    with pytest.raises(ValueError, match="limits"):
        value_colors(np.zeros(1), (1, 1))


def test_perceptual_colors_grow_evenly_lighter() -> None:
    rgb = linear_light(value_colors(np.linspace(0, 1, 100), (0, 1), "perceptual") / 255)
    lightness = (np.cbrt(rgb @ np.linalg.inv(RGB).T) @ np.linalg.inv(LMS).T)[:, 0]
    steps = np.diff(lightness)
    assert steps.min() > 0
    assert steps.max() < 3 * steps.mean()


def test_srgb_and_back() -> None:
    values = np.linspace(0, 1, 50)
    np.testing.assert_allclose(linear_light(srgb(values)), values, atol=1e-6)
    assert srgb(np.array(0.2140)) == pytest.approx(0.5, abs=1e-3)


def test_normal_colors() -> None:
    np.testing.assert_array_equal(normal_colors(np.array([[1.0, 0, -1]])), [[255, 128, 0]])


def test_parts_smaller_than_their_shadows_are_drawn() -> None:
    small = Mesh(0.01 * octahedron().vertices + [0.5, 0.5, 0], octahedron().faces)
    drawn = (render_mesh(small, camera=FRONT, size=600) < 255).any(2)
    assert drawn.sum() == pytest.approx(2 * 3**2, abs=8)
