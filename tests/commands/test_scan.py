"""`pnu scan`: from a scan to its surface in one command; and surfaces that end where their points end."""

from pathlib import Path

import numpy as np
import pytest

from pnu import reconstruction
from pnu.commands.scan import main
from pnu.io import read_cloud, read_mesh, write_cloud
from tests.refusals import refused


def bowl(n: int, seed: int = 0) -> np.ndarray:
    """Half a unit sphere, z < 0."""
    points = np.random.default_rng(seed).standard_normal((n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] = -np.abs(points[:, 2])
    return points


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a bowl of 1500 colored points and 30 strays around it."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    stray = rng.uniform(-1.5, 1.5, (60, 3))
    stray = stray[np.abs(np.linalg.norm(stray, axis=1) - 1) > 0.2][:30]
    colors = np.full((1500 + len(stray), 3), [10, 200, 30], np.uint8)
    write_cloud("scan.ply", np.vstack([bowl(1500), stray]), None, {"colors": colors})
    return tmp_path


def test_a_bowl_with_strays_becomes_a_clean_sheet(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["input=scan.ply", "output=mesh.ply", "cloud=dense.ply", "removed=removed.ply", "page=page.html", "ratio=3"])
    said = capsys.readouterr().out
    mesh, dense = read_mesh("mesh.ply"), read_cloud("dense.ply")
    assert len(dense.points) == 3 * 1530
    for points in (mesh.vertices, dense.points):
        assert np.abs(np.linalg.norm(points, axis=1) - 1).max() < 0.2
        assert points[:, 2].max() < 0.35  # no lid over the bowl
    assert mesh.vertices[:, 2].min() < -0.97
    removed = read_cloud("removed.ply", minimum=1)
    assert 20 < len(removed.points) < 40
    assert removed.attributes["colors"].shape == (len(removed.points), 3)
    assert "points left out: stray" in said
    assert "far from all points" in said
    page = Path("page.html").read_text(encoding="utf-8")
    assert all(name in page for name in ("taken out", "dense cloud", "surface", "left out: stray"))
    colored = read_cloud("mesh.ply", normals=False).attributes["colors"]
    assert (colored[:, :3] == [10, 200, 30]).all()


@pytest.mark.slow
def test_what_is_wrong_is_said_before_the_work(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = {
        "output=mesh.xyz": "output=mesh.xyz: expected a mesh",
        "output=scan.ply": "output=scan.ply: is the input; give another name",
        "output=mesh.ply cloud=mesh.ply": "cloud=mesh.ply: is the output; give another name",
        "output=mesh.ply page=page.txt": "page=page.txt: expected a name that ends in .html",
        "output=mesh.ply quality=good": "quality=good: expected best or fast",
        "output=mesh.ply holes=0": "holes=0: expected a radius above 0",
        "output=mesh.ply reach=-1": "reach=-1: expected a number of spacings above 0",
        "output=mesh.ply ratio=0.5": "ratio=0.5: expected a number >= 1",
    }
    for line, message in wrong.items():
        assert message in refused(capsys, main, ["input=scan.ply", *line.split()])
    assert sorted(path.name for path in place.iterdir()) == ["scan.ply"]


@pytest.mark.slow
def test_quiet_prints_nothing(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["input=scan.ply", "output=mesh.stl", "quiet=true", "ratio=1"])
    assert capsys.readouterr() == ("", "")


@pytest.mark.slow
def test_a_surface_is_cut_off_where_its_points_end() -> None:
    points = bowl(2000)
    surface = reconstruction.reconstruct(points, points)
    beyond = surface.mesh.vertices[:, 2].max()
    assert beyond > 0.4  # Poisson reconstruction goes on past the rim
    cut = reconstruction.cut_off(surface, points, 4)
    assert cut.mesh.vertices[:, 2].max() < 0.35
    assert cut.mesh.faces.max() == len(cut.mesh.vertices) - 1 == len(cut.density) - 1
    assert len(reconstruction.cut_off(surface, points, 1e9).mesh.faces) == len(surface.mesh.faces)
    with pytest.raises(ValueError, match="leaves no face of"):
        reconstruction.cut_off(surface, points + 100, 1)
    with pytest.raises(ValueError, match="reach=0: expected"):
        reconstruction.cut_off(surface, points, 0)


@pytest.mark.slow
def test_fast_finds_the_same_surface(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clouds = []
    for quality in ("best", "fast"):
        main(["input=scan.ply", "output=mesh.ply", "cloud=dense.ply", f"quality={quality}", "quiet=true"])
        clouds.append(read_cloud("dense.ply").points)
        assert np.abs(np.linalg.norm(read_mesh("mesh.ply").vertices, axis=1) - 1).mean() < 0.03
    assert len(clouds[0]) == len(clouds[1])
    assert not (clouds[0] == clouds[1]).all()
    assert np.abs(np.linalg.norm(clouds[1], axis=1) - 1).mean() < 0.01
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_a_hole_is_closed_on_request(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = bowl(2000)
    write_cloud("scan.ply", points[np.linalg.norm(points - [0, 0, -1], axis=1) > 0.4])
    nearest = []  # vertex to the middle of the hole
    for holes in ("null", "0.6"):
        main(
            [
                "input=scan.ply",
                "output=mesh.ply",
                "ratio=2",
                "quality=fast",
                "reach=2",
                f"holes={holes}",
                "cloud=dense.ply",
            ]
        )
        nearest.append(np.linalg.norm(read_mesh("mesh.ply").vertices - [0, 0, -1], axis=1).min())
    assert nearest[0] > 0.1
    assert nearest[1] < 0.05
    dense = read_cloud("dense.ply")
    assert dense.points[dense.attributes["filled"] == 1, 2].max() < -0.75
    assert "points fill them, flagged by filled" in capsys.readouterr().out
