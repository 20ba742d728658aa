"""bench/cases.py: what is read of each file of a folder, and what is said of it, as a table."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bench import cases
from pnu.io import write_cloud
from tests.reconstruction.test_surfaces import sphere_points

COUNT = 400
SPHERE = sphere_points(COUNT)[:, 3:]  # points, and their own normals
FLIPPED = SPHERE * np.where(np.arange(COUNT) % 3, 1, -1)[:, None]


def text(path: Path, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), "%.6g")


def lost(path: Path) -> None:
    points = SPHERE.copy()
    points[5:8] = np.nan
    text(path, points)


def scanned(path: Path) -> None:
    extra = {"colors": np.full((COUNT, 3), 7, np.uint8), "quality": np.zeros(COUNT, np.float32)}
    write_cloud(path, SPHERE, SPHERE, extra)


FILES: dict[str, tuple[Callable[[Path], None], str]] = {
    "a.ply": (scanned, "400 points, normals, colors, quality | "),
    "b.xyz": (lost, "397 points | 3 of 400 points left out: NaN, infinite or beyond 1e+30"),
    "c.ply": (
        lambda path: write_cloud(path, SPHERE, FLIPPED),
        r"400 points, normals | 4\d% of neighboring normals contradict each other; normals=estimate makes others",
    ),
    "d.txt": (lambda path: text(path, SPHERE[:, :2]), "refused | has 2 columns; expected x y z, and .*"),
    "e.csv": (lambda path: path.write_text("x|y,b,c\n" + "1,2,3\n" * 20), r"refused | .*found x/y b c; say .*"),
    "f.ply": (lambda path: path.write_bytes(b""), "refused | .*empty.*"),
    "inner/g.npy": (lambda path: np.save(path, SPHERE), "400 points | "),
}


def run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["cases", str(folder)])
    cases.main()


def test_a_row_for_each_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "notes.md").write_text("no cloud")
    for name, (write, _) in FILES.items():
        write(tmp_path / name)
    run(tmp_path, monkeypatch)
    head, line, *rows = capsys.readouterr().out.splitlines()
    assert (head, line) == ("| file | read | said |", "|---|---|---|")
    assert len(rows) == len(FILES)
    for row, (name, (_, expected)) in zip(rows, FILES.items(), strict=True):
        pattern = f"| {name} | {expected} |".replace("|", r"\|").replace("+", r"\+")
        assert re.fullmatch(pattern, row), row


def test_a_folder_without_clouds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "notes.md").write_text("no cloud")
    with pytest.raises(SystemExit, match="error: no point clouds there"):
        run(tmp_path, monkeypatch)
