"""The command compare on real files: tables, surfaces, figures, page."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pnu.benchmark import Case, Truth
from pnu.commands.compare import main, runs_of_sweep, with_runs_of_sweeps
from pnu.geometry.mesh_sampling import sample_poisson_disk
from pnu.io import Mesh, read_json, write_json, write_mesh
from pnu.networks import checkpoints
from pnu.networks.pnu import PNU
from pnu.reconstruction import SurfaceErrors
from pnu.rendering import ColorBar
from pnu.report import comparison_page
from pnu.report.comparison_tables import print_surfaces, tables
from pnu.report.shape_views import Look, Rebuilt, error_limit, points_for, rebuild, surface_panels, view
from tests.chromium import CHROMIUM
from tests.reconstruction.test_surfaces import icosphere
from tests.report.test_page import browse

SMALL = ["points=300", "truth_points=1200", "ratio=2", "size=100", "quiet=true"]
NETWORK = {"_target_": "pnu.networks.pnu.PNU", "ratio": 2, "local_features": False}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two shapes, and a run of a small network, untrained, for a ratio of 2."""
    place = tmp_path_factory.mktemp("compare")
    (place / "meshes").mkdir()
    ball = icosphere(3)
    write_mesh(place / "meshes" / "ball.ply", ball)
    write_mesh(place / "meshes" / "egg.off", ball._replace(vertices=3 * ball.vertices * [1, 1.5, 1]))
    torch.manual_seed(0)
    checkpoints.save(place / "runs" / "first", PNU(ratio=2, local_features=False), NETWORK, {})
    return place


@pytest.fixture(scope="module")
def made(place: Path) -> Path:
    """The comparison of two classical methods, one under another name."""
    methods = "methods=[apss,plain:midpoint]"
    data = ["data=meshes", f"data.root={place}/meshes", "kinds=[uniform,sparse]", "shown=1"]
    main([methods, *data, *SMALL, f"output={place}/out", f"picture={place}/all.webp"])
    return place / "out"


def views(page: Path) -> list[dict]:
    found = re.search(r'id="views">(.*?)</script>', page.read_text(), re.S)
    assert found is not None
    return json.loads(found.group(1))


def test_tables_show_what_was_measured(made: Path) -> None:
    found = read_json(made / "metrics.json")
    assert {row["method"] for row in found["rows"]} == {"apss", "plain", "floor", "input"}
    assert len(found["rows"]) == 4 * 2 * 2
    page = (made / "index.html").read_text()
    assert page.count('<section class="kind"') == 2
    uniform = page.split('<section class="kind"')[1]
    mean = np.mean([row["chamfer_sq"] for row in found["rows"] if (row["method"], row["kind"]) == ("apss", "uniform")])
    cells = re.search(r"<td>apss</td><td[^>]*>([^<]*)<", uniform)
    assert cells is not None
    assert cells.group(1) == f"{1e3 * mean:.4f}"
    assert re.search(r'<tr class="reference"><td>floor</td>', uniform)
    for shape in ("ball", "egg"):
        assert uniform.count(f">{shape}</th>") == 2  # CD and HD of each, as Table 1
    assert "methods=[apss,plain:midpoint]" in page


def test_surfaces_of_the_first_kind_are_measured(made: Path) -> None:
    found = read_json(made / "metrics.json")["surfaces"]
    assert {(row["shape"], row["kind"]) for row in found} == {("ball", "uniform")}
    by_method = {row["method"]: row for row in found}
    assert {"input", "apss", "plain"} == by_method.keys()
    assert by_method["apss"]["to_truth_mean"] < 0.02
    page = (made / "index.html").read_text()
    assert page.count("Surfaces reconstructed from the clouds") == 1
    picture = np.asarray(Image.open(made / "figures" / "ball_uniform.png"))
    assert picture.shape[1] > 400
    assert not (made / "figures" / "ball_sparse.png").exists()


def test_one_picture_of_surfaces_and_below_them_their_errors(made: Path) -> None:
    picture = np.asarray(Image.open(made.parent / "all.webp").convert("RGB")).astype(int)
    colored = np.ptp(picture, axis=2) > 100
    methods = colored[:, :300]  # input, apss, plain; not the scale
    assert methods[: len(methods) // 3].sum() == 0
    assert methods[len(methods) // 2 :].sum() > 1000


def test_views_hold_every_method_and_the_truth(made: Path) -> None:
    uniform, sparse = views(made / "index.html")
    assert (uniform["shape"], uniform["kind"], sparse["kind"]) == ("ball", "uniform", "sparse")
    assert [item["name"] for item in sparse["items"]] == ["input", "apss", "plain", "truth"]
    counts = {item["name"]: item["cloud"]["position"][1] // 3 for item in uniform["items"]}
    assert counts == {"input": 300, "apss": 600, "plain": 600, "truth": 1200}
    assert "surface" in uniform["items"][-1]
    assert not any("surface" in item for item in sparse["items"])


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_page_is_drawn_in_a_browser(made: Path, tmp_path: Path) -> None:
    fragment = "form=surfaces&mode=errors&item=apss"
    dom = browse(made / "index.html", fragment, tmp_path / "one")
    assert int(re.search(r'data-drawn="(\d+)"', dom).group(1)) > 0  # type: ignore[union-attr]
    assert 'data-value="apss" aria-pressed="true"' in dom
    page = np.asarray(Image.open(browse(made / "index.html", fragment, tmp_path / "two", picture=True)).convert("RGB"))
    colored = np.ptp(page.astype(int), axis=2) > 60
    assert colored[len(page) // 2 :].sum() > 5000


def test_same_seed_same_numbers(made: Path, place: Path) -> None:
    data = ["data=meshes", f"data.root={place}/meshes", "kinds=[sparse]", "surfaces=[]", "shapes=[egg]"]
    main(["methods=[apss]", *data, *SMALL, f"output={place}/again", f"picture={place}/normals.webp"])
    names = ("chamfer_sq", "hausdorff_sq", "p2f", "normal_deg")
    first, second = (
        [[row[name] for name in names] for row in read_json(folder / "metrics.json")["rows"]
         if (row["shape"], row["kind"], row["method"]) == ("egg", "sparse", "apss")]
        for folder in (made, place / "again")
    )  # fmt: skip
    assert first == second
    assert (place / "again" / "figures" / "egg_sparse.png").is_file()  # clouds only
    normals = np.asarray(Image.open(place / "normals.webp").convert("RGB")).astype(int)
    assert (np.ptp(normals, axis=2) > 60).mean() > 0.1


def test_columns_of_pairs_as_text(place: Path, tmp_path: Path) -> None:
    ball = icosphere(3)
    cloud = sample_poisson_disk(ball, 300, np.random.default_rng(0))
    for folder in ("clouds", "truth"):
        (tmp_path / folder).mkdir()
    write_mesh(tmp_path / "truth" / "ball.ply", ball)
    np.savetxt(tmp_path / "clouds" / "ball.csv", cloud[:, [3, 4, 5, 2, 1, 0]], delimiter=",")
    data = ["data=meshes", f"data.root={tmp_path}", "columns=nx,ny,nz,z,y,x"]
    main(["methods=[midpoint]", *data, *SMALL, "surfaces=[]", f"output={tmp_path}/out"])
    rows = read_json(tmp_path / "out" / "metrics.json")["rows"]
    assert [row["p2f"] < 0.01 for row in rows if row["method"] == "midpoint"] == [True]


@pytest.mark.slow
def test_a_network_of_a_run_folder(place: Path) -> None:
    data = ["data=meshes", f"data.root={place}/meshes", "kinds=[uniform]", "surfaces=[]", "shapes=[ball]"]
    main([f"methods=[{place}/runs/first,ours:{place}/runs/first]", *data, *SMALL, f"output={place}/network"])
    rows = {row["method"]: row for row in read_json(place / "network" / "metrics.json")["rows"]}
    assert rows["first"]["points_out"] == 600
    assert rows["first"]["chamfer_sq"] == rows["ours"]["chamfer_sq"] > rows["floor"]["chamfer_sq"]


@pytest.mark.slow
def test_the_finished_runs_of_a_sweep(place: Path) -> None:
    (place / "sweep").mkdir()
    for name in ("wide_0123abcd", "no_cd_4567abcd", "broken_89ab"):
        shutil.copytree(place / "runs" / "first", place / "sweep" / name)
    write_json(place / "sweep" / "broken_89ab" / "run.json", {"status": "failed"})
    assert runs_of_sweep(str(place / "sweep")) == [
        f"no_cd:{place}/sweep/no_cd_4567abcd",
        f"wide:{place}/sweep/wide_0123abcd",
    ]
    assert runs_of_sweep("apss") == runs_of_sweep(f"{place}/runs/first") == []
    data = ["data=meshes", f"data.root={place}/meshes", "kinds=[sparse]", "surfaces=[]", "shapes=[ball]"]
    main([f"methods=[{place}/sweep,apss]", *data, *SMALL, f"output={place}/swept"])
    rows = read_json(place / "swept" / "metrics.json")["rows"]
    assert [row["method"] for row in rows] == ["no_cd", "wide", "apss", "floor", "input"]


def test_runs_of_several_sweeps_are_told_apart_by_their_seeds(tmp_path: Path) -> None:
    """A seed that alone was asked for is not in the names of its sweep."""
    two, one = tmp_path / "two", tmp_path / "one"
    runs = {two / "wide_seed-0_01": 0, two / "wide_seed-1_02": 1, one / "wide_03": 2, one / "slim_04": 2}
    for folder, seed in runs.items():
        folder.mkdir(parents=True)
        write_json(folder / "run.json", {"status": "finished"})
        (folder / "config.yaml").write_text(f"model: {{}}\nseed: {seed}\n")
    assert with_runs_of_sweeps([str(two), "apss", str(one)]) == [
        f"wide_seed-0:{two}/wide_seed-0_01",
        f"wide_seed-1:{two}/wide_seed-1_02",
        "apss",
        f"slim:{one}/slim_04",
        f"wide_seed-2:{one}/wide_03",
    ]
    assert with_runs_of_sweeps([str(one)]) == [f"slim:{one}/slim_04", f"wide:{one}/wide_03"]


def case() -> Case:
    mesh = icosphere(3)
    samples = sample_poisson_disk(mesh, 800, np.random.default_rng(0))
    truth = Truth("ball", mesh, samples, "as given")
    return Case("uniform", samples[::4, :3], samples[::4, 3:], truth)


def test_a_surface_that_fails_is_left_out_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = comparison_page.ShownCase.of(case())
    shown.clouds["bare"] = shown.clouds["input"][:, :3]

    def fail(*args: object, **kwargs: object) -> None:
        raise ValueError("Poisson reconstruction at depth=6 was killed by SIGSEGV")

    monkeypatch.setattr("pnu.reconstruction.reconstruct", fail)
    made, notes = rebuild(shown)
    assert made == {}
    assert notes == ["input, ball, uniform: Poisson reconstruction at depth=6 was killed by SIGSEGV"]


def test_pictures_have_room_for_surfaces_larger_than_the_truth() -> None:
    shown = comparison_page.ShownCase.of(case())
    truth = shown.case.truth.mesh
    assert truth is not None
    for size, most in ((1.15, 0), (2.0, np.inf)):  # the second is cut off: it would make all others small
        error = np.full(len(truth.vertices), size - 1)
        made = {"input": Rebuilt(Mesh(size * truth.vertices, truth.faces), SurfaceErrors(error, error, error, 1))}
        panels = surface_panels(shown, made, ["input", "truth", "none"], Look(size=80), ColorBar((0, 200)))
        assert len(panels) == 6
        borders = np.concatenate([np.concatenate([p[0], p[-1], p[:, 0], p[:, -1]]) for p in panels])
        assert (borders < 255).sum() <= most
        assert 50 < (panels[1] < 255).any((0, 2)).sum() < 80


def test_clouds_are_thinned_to_the_size_of_the_page() -> None:
    shown = comparison_page.ShownCase.of(case())
    drawings = view(shown, {}, 90).drawings
    assert [len(drawing.cloud) for drawing in drawings if drawing.cloud is not None] == [67, 89]
    assert points_for(40, 100, 0) == 33333
    assert points_for(40, 100, 1_000_000) < 20000
    with pytest.raises(ValueError, match="page_mb=1: too small for 100 clouds"):
        points_for(1, 100, 0)
    assert error_limit([np.linspace(0, 1, 101), np.linspace(0, 3, 101), np.linspace(0, 100, 101)]) == pytest.approx(
        2.94
    )


def test_a_method_that_lacks_a_surface_has_no_mean(capsys: pytest.CaptureFixture[str]) -> None:
    row = {"shape": "a", "kind": "k", "points_in": 1, "points_out": 4, "chamfer_sq": 1e-3, "hausdorff_sq": 2e-3}
    rows = [row | {"method": m, "shape": s} for s in "ab" for m in ("x", "y")]
    errors = dict.fromkeys(
        ("to_truth_mean", "to_truth_rms", "to_truth_max", "from_truth_mean", "from_truth_max", "normal_deg_mean"), 1e-3
    )
    surfaces = [errors | {"shape": s, "kind": "k", "method": m} for s, m in ("ax", "bx", "ay")]
    means, each, surface = tables(rows, surfaces)["k"]
    assert [row.values[:2] for row in means.rows] == [[1.0, 2.0], [1.0, 2.0]]
    assert [(column.group, column.head) for column in each.columns] == [
        ("CD", "a"),
        ("CD", "b"),
        ("HD", "a"),
        ("HD", "b"),
    ]
    assert {row.name: row.values[0] for row in surface.rows} == {"x": 1.0, "y": None}
    print_surfaces(surfaces)
    assert "| x | 1.00 | 1.00 | 1.00 | 1.00 | 1.00 | 0.00 |\n| y | - | - |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["methods=[aps]"], "methods=aps: expected a run folder, or one of apss, .*, l0, .*ecnet"),
        (["methods=[]"], r"methods=\[\]: expected run folders or classical methods"),
        (["methods=[apss,apss]"], r"methods=apss: the name apss is taken; give another one, 'methods=\[.NAME:apss.\]'"),
        (["methods=[truth:apss]"], "the name truth is taken"),
        (["methods=[{place}/runs/first]", "ratio=4"], "was trained for 2; give ratio=2, or passes=true"),
        (["methods=[{place}/meshes]"], "expected a run folder with config.yaml"),
        (["methods=[apss]", "kinds=[even]"], "kinds=even: expected some of uniform"),
        (["methods=[apss]", "surfaces=[sparse]", "kinds=[uniform]"], "surfaces=sparse: expected some of the kinds"),
        (["methods=[apss]", "shapes=[cow]"], "shapes=cow: expected some of"),
        (["methods=[apss]", "output=/proc/none/x"], "output=/proc/none/x: cannot be made a folder"),
        (["methods=[apss]", "normals=none"], "normals=none: expected given or estimate"),
        (["methods=[apss]", "colormap=jet"], "colormap=jet: expected error or perceptual"),
        (["methods=[apss]", "picture=all.png"], "picture=all.png: expected a name that ends in .webp"),
        (["methods=[apss]", "picture=none/all.webp"], "the folder none does not exist"),
        (["methods=[apss]", "page_mb=0"], "page_mb=0: expected a number from 1 to 1000"),
        (["methods=[apss]", "surface=[]"], "did you mean 'surfaces'"),
        ([], "methods=... is required"),
    ],
)
def test_compare_refuses(
    place: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    with pytest.raises(SystemExit) as stop:
        main([*SMALL, *(argument.format(place=place) for argument in arguments)])
    assert stop.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert re.search(message, lines[0])
    assert not (place / "outputs").exists()
