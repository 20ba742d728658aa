"""`pnu app`: in a real browser, a scan dropped, looked at, made dense, downloaded; two users; a damaged file."""

import contextlib
import io
import itertools
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area
from pnu.io import write_cloud
from tests.chromium import Page, chromium, needs_browser

DOCS = Path(__file__).resolve().parents[2] / "docs"
PHASE = "document.body.dataset.phase"
DRAWN = "Number(document.querySelector('#canvas').dataset.drawn)"


def write_scan(path: Path, n: int = 1500) -> None:
    """A colored mug with a hole, some noise, and twenty strays; the normals of one half are turned over."""
    rng = np.random.default_rng(0)
    cloud = sample_area(shapes.make("mug"), n, rng)
    points, normals = cloud[:, :3] + rng.normal(scale=0.002, size=(n, 3)), cloud[:, 3:].copy()
    normals[points[:, 0] > 0.1] *= -1
    strays = rng.uniform(-1, 1, (20, 3))
    colors = np.rint(255 * (0.5 + 0.3 * np.vstack([points, strays]))).clip(0, 255).astype(np.uint8)
    write_cloud(path, np.vstack([points, strays]), np.vstack([normals, rng.normal(size=(20, 3))]), {"colors": colors})


@contextlib.contextmanager
def served(*keys: str) -> Iterator[tuple[str, Path]]:
    """The address of a `pnu app`, and its folder; it is ended by Ctrl+C and must leave nothing behind."""
    command = [sys.executable, "-m", "pnu", "app", "open=false", "port=0", *keys]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        address = re.search(r"http://\S+", process.stdout.readline())
        folder = re.search(r"/\S+(?=,)", process.stdout.readline())
        assert address is not None
        assert folder is not None
        assert Path(folder[0]).is_dir()
        yield address[0], Path(folder[0])
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert not Path(folder[0]).exists()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def opened(page: Page, scan: Path) -> None:
    """Drop a scan and wait until it is shown."""
    page.wait("sessionStorage.getItem('token')")
    page.drop(scan)
    page.wait(f"{PHASE} === 'ready' && {DRAWN} > 0")


def downloaded(page: Page, folder: Path, name: str, kind: str) -> Path:
    """A result as the page gives it."""
    row = f"document.querySelector('#downloads [data-kind={kind}]')"
    page.run(f"{row}.querySelector('select').value = {name!r}")
    page.run(f"{row}.querySelector('button').click()")
    end = time.monotonic() + 60
    while not (folder / name).is_file():
        assert time.monotonic() < end, list(folder.iterdir())
        time.sleep(0.1)
    return folder / name


@needs_browser
@pytest.mark.slow
@pytest.mark.usefixtures("compiled")  # compiled or not, results are the same to rounding, not to the bit
def test_the_browser_gets_what_the_command_writes(tmp_path: Path) -> None:
    scan = tmp_path / "a scan.ply"
    write_scan(scan)
    (tmp_path / "got").mkdir()
    with served() as (address, _), chromium(tmp_path / "profile") as browser:
        page = browser.page(address)
        page.downloads(tmp_path / "got")
        opened(page, scan)
        said = page.run("document.querySelector('#about').innerText")
        assert "1 520 points, with normals, colored" in said.replace("\u202f", " ")
        assert re.search(r"\d\d stray points, off the surface", said)
        assert re.search(r"\d+ normals contradict those beside them", said)
        page.run("document.querySelector('[name=ratio]').value = 2; document.querySelector('#go').click()")
        page.wait(f"{PHASE} === 'done'", 120)
        made = [
            downloaded(page, tmp_path / "got", "a scan_dense.ply", "cloud"),
            downloaded(page, tmp_path / "got", "a scan_dense.xyz", "cloud"),
            downloaded(page, tmp_path / "got", "a scan_surface.ply", "mesh"),
        ]
        page.run("document.querySelector('#downloads .page button').click()")
        lines = page.run("document.querySelector('#command').textContent").splitlines()
        end = time.monotonic() + 60
        while not (view := tmp_path / "got" / "a scan_view.html").is_file():
            assert time.monotonic() < end
            time.sleep(0.1)
    assert [line.split()[:2] for line in lines] == [["pnu", "upsample"], ["pnu", "reconstruct"]]
    for line in lines:
        line = f"{sys.executable} -m {line}"
        subprocess.run(line, shell=True, cwd=tmp_path, check=True, capture_output=True)
    dense, text, surface = made
    assert dense.read_bytes() == (tmp_path / dense.name).read_bytes()
    assert surface.read_bytes() == (tmp_path / surface.name).read_bytes()
    assert np.loadtxt(text).shape == (2 * 1520, 9)
    assert "a scan_surface.ply" in view.read_text()


@needs_browser
@pytest.mark.slow
def test_a_damaged_file_gives_its_line_and_a_stop_stops(tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.ply")
    cut = tmp_path / "cut.ply"
    cut.write_bytes((tmp_path / "scan.ply").read_bytes()[:2000])
    with served() as (address, folder), chromium(tmp_path / "profile") as browser:
        page = browser.page(address)
        page.wait("sessionStorage.getItem('token')")
        page.drop(cut)
        said = page.wait("!document.querySelector('#error').hidden && document.querySelector('#error').textContent")
        assert re.match(r"cut\.ply: .*cut off", said)
        assert "\n" not in said
        opened(page, tmp_path / "scan.ply")
        assert page.run("document.querySelector('#error').hidden")
        page.run("document.querySelector('[name=ratio]').value = 400; document.querySelector('#go').click()")
        page.wait(f"{PHASE} === 'working' && document.querySelector('#left').textContent.includes('left')")
        page.run("document.querySelector('#stop').click()")
        page.wait(f"{PHASE} === 'ready' && document.querySelector('#error').hidden", 20)
        assert sorted(path.name for path in folder.rglob("*.ply")) == ["scan.ply"]


@needs_browser
@pytest.mark.slow
def test_two_users_see_their_own(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_scan(tmp_path / f"{name}.ply", 400)
    with served() as (address, folder), chromium(tmp_path / "profile") as browser:
        pages = [browser.page(address), browser.page(address)]
        for page, name in zip(pages, ("one", "two"), strict=True):
            opened(page, tmp_path / f"{name}.ply")
        assert [page.run("document.querySelector('#name').textContent") for page in pages] == ["one.ply", "two.ply"]
        first, second = (page.run("sessionStorage.getItem('token')") for page in pages)
        assert first != second
        assert len(list(folder.iterdir())) == 2
        pages[0].run("document.querySelector('#over').click()")
        pages[0].wait(f"{PHASE} === 'empty'")
        assert [path.name for path in folder.rglob("*.ply")] == ["two.ply"]
        assert pages[1].run(f"fetch('/s/{first}/state').then((answer) => answer.status)") == 404


@needs_browser
@pytest.mark.slow
def test_pictures_of_the_page(tmp_path: Path) -> None:
    """Six, which docs/app.md shows: PNU_WRITE=1 writes them there. None is blank, and no two are alike."""
    write_scan(tmp_path / "mug.ply", 3000)
    (tmp_path / "damaged.ply").write_bytes((tmp_path / "mug.ply").read_bytes()[:20000])
    folder = DOCS / "app" if os.environ.get("PNU_WRITE") else tmp_path
    taken: dict[str, np.ndarray] = {}

    def take(name: str) -> None:
        time.sleep(1)  # until what moves has come to rest
        picture = Image.open(io.BytesIO(page.picture())).convert("RGB")
        picture.save(folder / f"{name}.webp", quality=80, method=6)
        taken[name] = np.asarray(picture.resize((64, 40)), float)

    with served() as (address, _), chromium(tmp_path / "profile") as browser:
        page = browser.page(address, 1360, 900)
        page.wait("sessionStorage.getItem('token')")
        take("drop")
        opened(page, tmp_path / "mug.ply")
        take("look")
        page.run("document.querySelector('#go').click()")
        page.wait(f"{PHASE} === 'working' && document.querySelector('#left').textContent.includes('left')")
        take("working")
        page.wait(f"{PHASE} === 'done'", 300)
        take("result")
        page.run("document.querySelector('#items [data-value=surface]').click()")
        take("surface")
        page.drop(tmp_path / "damaged.ply")
        page.wait("!document.querySelector('#error').hidden")
        take("error")
    for name, picture in taken.items():
        assert picture.std() > 2, name
    differences = [np.abs(a - b).mean() for a, b in itertools.combinations(taken.values(), 2)]
    assert min(differences) > 0.05
