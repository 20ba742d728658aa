"""The page of comparisons: what is in its tables, what the viewer gets, and the page in a real browser."""

import base64
import gzip
import html
import io
import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnu.io import Mesh
from pnu.report.offline_page import Column, Drawing, Row, ShapeView, Table, write_page
from pnu.report.viewer_data import RANGE, encode
from tests.chromium import CHROMIUM, needs_browser
from tests.reconstruction.test_surfaces import icosphere, sphere_points


def view(shape: str = "ball", kind: str = "uniform") -> ShapeView:
    center = np.array([10.0, 20, 30])
    cloud = sphere_points(2000)
    cloud[:, :3] = 5 * cloud[:, :3] + center
    ball = icosphere(3)
    surface = Mesh(5 * ball.vertices + center, ball.faces)
    error = np.linspace(0, 0.2, 2000)
    drawings = [
        Drawing("input", cloud[:300]),
        Drawing("ours", cloud, error, surface, np.full(len(surface.vertices), 0.05)),
        Drawing("bare", cloud[:, :3], error),
        Drawing("truth", cloud, None, surface),
    ]
    return ShapeView(shape, kind, drawings, center, 5.0, 0.1)


def table(*values: float | None) -> Table:
    rows = [Row(name, [value, 1.0]) for name, value in zip("abcd", values, strict=False)]
    return Table(
        "Means", [Column("CD"), Column("seconds", ".1f", best=False)], [*rows, Row("floor", [0.0, None], True)]
    )


def bold(page: str) -> list[str]:
    return re.findall(r'<td class="best"[^>]*>([^<]*)<', page)


def test_best_is_bold_as_printed_and_references_do_not_compete(tmp_path: Path) -> None:
    write_page(tmp_path / "a.html", "t", {"uniform": [table(0.30001, 0.2, 0.20001)]})
    assert bold((tmp_path / "a.html").read_text()) == ["0.200", "0.200"]
    write_page(tmp_path / "a.html", "t", {"uniform": [table(None, float("nan"), 0.5)]})
    page = (tmp_path / "a.html").read_text()
    assert bold(page) == ["0.500"]
    assert page.count('data-value="">-<') == 3


def test_best_is_the_highest_where_higher_is_better(tmp_path: Path) -> None:
    rows = [Row("a", [1.0, 1.0]), Row("b", [2.0, 2.0])]
    heads = [Column("up", ".0f", better="higher"), Column("down", ".0f")]
    write_page(tmp_path / "a.html", "t", {"uniform": [Table("Means", heads, rows)]})
    assert bold((tmp_path / "a.html").read_text()) == ["1", "2"]


def test_words_are_escaped_and_scripts_cannot_be_ended(tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script>&\"'"
    named = view()._replace(shape=evil, kind="{{ogl}}")
    tables = {evil: [Table(evil, [Column(evil, group=evil)], [Row(evil, [1.0])])]}
    size = write_page(tmp_path / "a.html", evil, tables, [named], head=[evil], foot=[evil], figures={evil: b"png"})
    page = (tmp_path / "a.html").read_text()
    assert "<script>alert" not in page
    assert page.count("<script") == page.count("</script>") == 5
    assert size == len(page.encode())
    stored = json.loads(re.search(r'id="views">(.*?)</script>', page, re.S).group(1))  # type: ignore[union-attr]
    assert stored[0]["shape"] == evil
    assert stored[0]["kind"] == "{{ogl}}"


def test_page_loads_nothing(tmp_path: Path) -> None:
    write_page(tmp_path / "a.html", "t", {"uniform": [table(1)]}, [view()], figures={"f": b"png"})
    page = (tmp_path / "a.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert "default-src 'none'" in page
    assert "import(" not in page
    assert [p.name for p in tmp_path.iterdir()] == ["a.html"]


def test_viewer_gets_what_was_given() -> None:
    given = view()
    stored = json.loads(json.dumps(encode(given)))
    data = gzip.decompress(base64.b64decode(stored["data"]))

    def array(place: list[int], dtype: str) -> np.ndarray:
        assert place[0] % 4 == 0
        return np.frombuffer(data, dtype, place[1], place[0])

    names = [item["name"] for item in stored["items"]]
    assert names == ["input", "ours", "bare", "truth"]
    ours, bare, truth = stored["items"][1:]
    cloud = given.drawings[1].cloud
    assert cloud is not None
    position = (array(ours["cloud"]["position"], "<u2").reshape(-1, 3) / 65535 * 2 - 1) * RANGE * 5 + given.center
    np.testing.assert_allclose(position, cloud[:, :3], atol=5e-4)
    np.testing.assert_allclose(array(ours["cloud"]["normal"], "i1").reshape(-1, 3) / 127, cloud[:, 3:], atol=5e-3)
    np.testing.assert_allclose(array(ours["cloud"]["error"], "u1") / 255, np.linspace(0, 2, 2000).clip(0, 1), atol=3e-3)
    assert "normal" not in bare["cloud"]
    assert "error" not in truth["surface"]
    assert stored["limit"] == "20"
    surface = given.drawings[1].surface
    assert surface is not None
    index = np.cumsum(array(ours["surface"]["index"], "<i4")).reshape(-1, 3)
    position = (array(ours["surface"]["position"], "<u2").reshape(-1, 3) / 65535 * 2 - 1) * RANGE * 5 + given.center
    np.testing.assert_allclose(position[index], surface.vertices[surface.faces], atol=5e-4)
    np.testing.assert_array_equal(array(ours["surface"]["error"], "u1"), 128)
    assert ours["cloud"]["spacing"] == pytest.approx(np.sqrt(4 * np.pi / 2000), rel=0.2)


def browse(page: Path, fragment: str, profile: Path, *, picture: bool = False) -> str:
    """The page's HTML after its scripts have run, or with `picture` the path of a screenshot."""
    shot = profile.with_suffix(".png")
    flags = "--headless --no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic "
    flags += "--no-first-run --disable-background-networking --disable-component-update --disable-sync "
    flags += f"--window-size=1200,1500 --virtual-time-budget=8000 --user-data-dir={profile} "
    action = f"--screenshot={shot}" if picture else "--dump-dom"
    command = [str(CHROMIUM), *flags.split(), action, f"{page.as_uri()}#{fragment}"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return str(shot) if picture else run.stdout


@pytest.mark.slow
@needs_browser
def test_page_in_a_browser(tmp_path: Path) -> None:
    tables = {"uniform": [table(0.3, 0.1, 0.2)], "noisy": [table(5, 4, 6)]}
    write_page(tmp_path / "a.html", "Comparison", tables, [view(), view("second"), view(kind="noisy")])
    click = """<script>
      document.querySelector("section:not([hidden]) thead th:nth-child(2)").click();
      const rows = [...document.querySelectorAll("section:not([hidden]) tbody tr")];
      const order = rows.map((row) => row.cells[0].textContent).join("");
      document.querySelectorAll("#tabs button")[1].click();
      const shown = [...document.querySelectorAll("section:not([hidden])")].map((s) => s.dataset.kind).join();
      document.title = `${order} ${shown}`;
    </script></body>"""
    page = tmp_path / "b.html"
    page.write_text((tmp_path / "a.html").read_text().replace("</body>", click))
    dom = browse(page, "shape=second&mode=errors", tmp_path / "profile")
    assert "<title>floorbca noisy</title>" in dom
    pressed = re.findall(r'data-value="([^"]*)" aria-pressed="true"', dom)
    assert pressed == ["second", "uniform", "points", "errors", "y"]  # the second shape has no noisy view
    assert int(re.search(r'data-drawn="(\d+)"', dom).group(1)) > 0  # type: ignore[union-attr]
    assert html.unescape(dom).count("<span>truth</span>") == 1


@needs_browser
@pytest.mark.parametrize(
    ("fragment", "red", "gray"),
    [("item=ours&form=points&mode=errors", True, False), ("item=truth&form=surfaces&mode=errors", False, True)],
)
def test_viewer_draws(tmp_path: Path, fragment: str, red: bool, gray: bool) -> None:
    """A ball in the middle of the view: red and blue errors of points; the truth, which has none, gray."""
    write_page(tmp_path / "a.html", "Comparison", {}, [view()])
    page = np.asarray(
        Image.open(browse(tmp_path / "a.html", fragment, tmp_path / "profile", picture=True)).convert("RGB")
    )
    ink = (page.min(2) < 245).sum(1)
    assert ink.max() > 0
    middle = page[int(0.55 * len(page)) :, 450:750].reshape(-1, 3).astype(int)
    drawn = middle[middle.min(1) < 230]
    assert len(drawn) > 2000
    assert bool((drawn[:, 0] > drawn[:, 2] + 90).mean() > 0.05) == red
    assert bool((np.ptp(drawn, axis=1) < 30).mean() > 0.9) == gray


def test_figures_are_embedded(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (3, 2), "red").save(buffer, "PNG")
    write_page(tmp_path / "a.html", "t", {}, figures={"ball": buffer.getvalue()})
    data = re.search(r"data:image/png;base64,([^\"]+)", (tmp_path / "a.html").read_text())
    assert data is not None
    assert Image.open(io.BytesIO(base64.b64decode(data.group(1)))).size == (3, 2)
