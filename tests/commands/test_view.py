"""`pnu view`: files on one page, and in the browser of this machine."""

import gzip
import json
import re
import threading
import urllib.request
from base64 import b64decode
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnu.app import local_server
from pnu.commands import view
from pnu.io import Mesh, write_cloud, write_mesh
from tests.reconstruction.test_surfaces import icosphere, sphere_points
from tests.refusals import ran, refused


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A colored cloud, a mesh of the same sphere, and a cloud elsewhere."""
    cloud = sphere_points(400)
    colors = np.tile(np.array([200, 100, 50], np.uint8), (400, 1))
    write_cloud(tmp_path / "scan.ply", cloud[:, :3], cloud[:, 3:], {"colors": colors})
    write_mesh(tmp_path / "ball.obj", icosphere(2))
    write_cloud(tmp_path / "far away.xyz", cloud[:, :3] + 100)
    return tmp_path


def stored(page: str, name: str) -> Any:
    """What a page keeps for its scripts."""
    found = re.search(rf'id="{name}">(.*?)</script>', page, re.S)
    assert found is not None
    return json.loads(found[1])


def array(shown: dict[str, Any], place: list[int], dtype: str) -> np.ndarray:
    return np.frombuffer(gzip.decompress(b64decode(shown["data"])), dtype, place[1], place[0])


def test_files_side_by_side_on_one_page(folder: Path) -> None:
    done = ran(view.main, folder, "scan.ply", "ball.obj", "page=view.html")
    assert (done.returncode, done.stderr) == (0, "")
    assert "scan.ply, 400 points\n" in done.stdout
    assert "ball.obj, 66 points, 128 faces\n" in done.stdout
    page = (folder / "view.html").read_text()
    (shown,) = stored(page, "views")
    cloud, mesh = shown["items"]
    assert [cloud["name"], mesh["name"]] == ["scan.ply", "ball.obj"]
    assert (array(shown, cloud["cloud"]["stored"], "u1").reshape(-1, 3) == [200, 100, 50]).all()
    assert mesh["surface"]["index"][1] == 3 * 128
    assert stored(page, "pick") == {"up": "y", "mode": "colors"}


def test_files_that_lie_apart_have_a_view_each(folder: Path) -> None:
    ran(view.main, folder, "inputs=[scan.ply,far away.xyz]", "page=view.html", "up=z")
    page = (folder / "view.html").read_text()
    assert [shown["shape"] for shown in stored(page, "views")] == ["scan.ply", "far away.xyz"]
    assert "the files differ in size or place" in page
    assert stored(page, "pick")["up"] == "z"


def test_a_large_cloud_is_thinned_and_it_is_said(folder: Path) -> None:
    done = ran(view.main, folder, "scan.ply", "page=view.html", "points=150")
    assert "scan.ply: 134 of its 400 points are shown, every k-th" in done.stdout
    page = (folder / "view.html").read_text()
    assert "scan.ply: 134 of its 400 points are shown" in page
    (shown,) = stored(page, "views")
    assert shown["items"][0]["cloud"]["position"][1] == 3 * 134


def test_the_page_holds_what_page_mb_allows() -> None:
    from pnu.rendering.file_panels import Shape
    from pnu.report.view_page import points_that_fit

    cloud = Shape("a", np.zeros((10, 3)), None, None, {})
    mesh = Shape("b", np.zeros((1000, 3)), None, Mesh(np.zeros((1000, 3)), np.zeros((1, 3), np.int64)), {})
    assert points_that_fit([cloud], 16) == 1_000_000
    assert points_that_fit([cloud, cloud], 16) == 500_000
    assert points_that_fit([cloud, mesh], 16) == 998_500


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.ply", "page=a.html"], "error: none.ply: no such file"),
        (["page=a.html"], "error: inputs=... is required"),
        (["inputs=[]", "page=a.html"], "error: inputs=[]: expected one file or more"),
        (["scan.ply", "page=a.png"], "error: page=a.png: expected a name that ends in .html"),
        (["scan.ply", "page=a.html", "points=0"], "error: points=0: expected a number of 1 or more"),
        (["scan.ply", "page=a.html", "up=w"], "error: up=w: expected x, y, z or auto"),
        (["scan.ply", "open=false", "port=99999"], "error: port=99999: expected a number from 0 to 65535"),
        (["few.xyz", "page=a.html"], "error: few.xyz: has 5 points, at least 8 can be shown"),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    folder: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    np.savetxt("few.xyz", np.random.default_rng(0).normal(size=(5, 3)))
    assert refused(capsys, view.main, arguments).startswith(said)
    assert not Path("a.html").exists()


def test_the_browser_gets_the_page_from_this_machine(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = []

    def serve(server: local_server.LocalServer, *, browse: bool) -> None:
        assert not browse
        threading.Thread(target=server.handle_request, daemon=True).start()
        answers.append(urllib.request.urlopen(server.address, timeout=10).read())
        server.server_close()

    monkeypatch.setattr(local_server, "serve", serve)
    done = ran(view.main, folder, "scan.ply", "open=false", "port=0")
    assert re.search(r"^open:   http://127\.0\.0\.1:\d+/", done.stdout, re.M)
    assert stored(answers[0].decode(), "views")[0]["shape"] == "scan.ply"


def test_files_of_awkward_names_stand_alone(folder: Path) -> None:
    name = "a, [b] {'c'}.ply"
    (folder / "scan.ply").rename(folder / name)
    done = ran(view.main, folder, name, "page=view.html", "ball.obj")
    assert (done.returncode, done.stderr) == (0, "")
    (shown,) = stored((folder / "view.html").read_text(), "views")
    assert [item["name"] for item in shown["items"]] == [name, "ball.obj"]
