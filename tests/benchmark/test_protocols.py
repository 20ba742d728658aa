"""Protocols: definitions by hand, inputs as they are drawn, public pairs, published rows apart from measured ones."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pnu import benchmark, metrics
from pnu.benchmark import cases, pair_folders, protocols
from pnu.commands import compare, evaluate
from pnu.config.compose import compose_config
from pnu.config.instantiate import instantiate
from pnu.io import Mesh, read_json, write_mesh
from pnu.metrics import Pair, measured
from tests.reconstruction.test_surfaces import icosphere

# On a line, both centered: the prediction's farthest point is at 2, the truth's at 4. In unit spheres of their own
# -1, 0, 1 against -1, 0.5, 0.5: nearest squared 0, .25, .25 there and 0, .25, .25 back.
LINE = Pair([[-2.0, 0, 0], [0, 0, 0], [2, 0, 0]], [[-4.0, 0, 0], [2, 0, 0], [2, 0, 0]])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        # as given: forth 4, 4, 0, back 4, 0, 0
        ({}, {"chamfer_sq": 8 / 3 + 4 / 3, "hausdorff_sq": 4.0}),
        ({"chamfer": "half"}, {"chamfer_sq_half": 2.0, "hausdorff_sq": 4.0}),
        ({"hausdorff": "sum"}, {"chamfer_sq": 4.0, "hausdorff_sq_sum": 8.0}),
        ({"frame": "each"}, {"chamfer_sq_each": 1 / 3, "hausdorff_sq_each": 0.25}),
        ({"frame": "each", "hausdorff": "sum", "chamfer": "half"},
         {"chamfer_sq_half_each": 1 / 6, "hausdorff_sq_sum_each": 0.5}),
    ],
)  # fmt: skip
def test_cd_and_hd_by_hand(options: dict[str, Any], expected: dict[str, float]) -> None:
    chosen = benchmark.Protocol(**options).metrics()
    both = [metric for metric in chosen if metric.shown.head in ("CD", "HD")]
    found = {name: float(value) for name, value in measured(LINE, both).items()}
    assert found == pytest.approx(expected)


def test_p2f_of_each_frame_is_in_the_unit_of_the_mesh() -> None:
    triangle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    pair = Pair([[0.25, 0.25, 0.5], [0.25, 0.25, -1.5]], mesh=triangle, unit=40)
    found = measured(pair, benchmark.Protocol(frame="each").metrics())
    assert float(found["p2f_mesh_unit"]) == 40
    assert "p2f" not in found
    assert float(measured(pair, benchmark.Protocol().metrics())["p2f"]) == 1


def chosen(name: str, *more: str) -> benchmark.Protocol:
    cfg = compose_config(compare.Compare, [f"protocol={name}", "methods=[apss]", *more], name="compare")
    found: benchmark.Protocol = instantiate(cfg.protocol, "pnu.benchmark")
    return found


def test_the_choices_of_conf() -> None:
    own, pugan, pu1k, paper = (chosen(name) for name in ("own", "pugan", "pu1k", "paper"))
    assert own.metrics() == metrics.METRICS
    assert (own.points, own.truth_points(5000, 16), len(own.kinds)) == (5000, 20000, 6)
    assert pugan.definition == pu1k.definition == ("poisson", "each", "sum", "sum")
    assert (pugan.points, pugan.truth_points(2048, 4), pugan.truth_points(2048, 16)) == (2048, 8192, 32768)
    assert (paper.inputs, paper.points, paper.truth_points(5000, 4)) == ("subset", 5000, 20000)
    assert chosen("pugan", "protocol.hausdorff=max").published_rows(4) == []  # another definition than the rows'


def test_inputs_are_drawn_as_the_protocol_says() -> None:
    truth = benchmark.truth_of_mesh("ball", icosphere(3), 800, seed=0)

    def drawn(kind: str, inputs: str, limit: float | None = None) -> np.ndarray:
        return cases.draw_input(truth, kind, 200, np.random.default_rng(0), inputs, limit)

    def shared(cloud: np.ndarray) -> int:
        return len({tuple(point) for point in cloud[:, :3]} & {tuple(point) for point in truth.samples[:, :3]})

    spacing = {name: float(metrics.spacing_cv(drawn("uniform", name))) for name in ("poisson", "random", "subset")}
    assert spacing["poisson"] < 0.2 < 0.3 < min(spacing["random"], spacing["subset"])
    assert [shared(drawn("uniform", name)) for name in ("poisson", "random", "subset")] == [0, 0, 200]
    clean, noisy = drawn("uniform", "poisson"), drawn("noise_2", "poisson", 0.03)
    offset = noisy[:, :3] - clean[:, :3]
    assert np.abs(offset).max() == pytest.approx(0.03)
    assert 0.012 < offset.std() < 0.02
    with pytest.raises(ValueError, match="points=900: a subset of the truth has at most its 800 points"):
        cases.draw_input(truth, "uniform", 900, np.random.default_rng(0), "subset")


@pytest.fixture
def public(tmp_path: Path) -> Path:
    """A pair as PU-GAN's and PU1K's lie: a ball of radius 40, a truth eight times as dense, the mesh beside."""
    ball = icosphere(3)
    ball = ball._replace(vertices=40 * ball.vertices)
    truth = benchmark.truth_of_mesh("ball", ball, 1600, seed=0)
    root = tmp_path / "test"
    for name in ("input_200", "gt_1600", "meshes"):
        (root / name).mkdir(parents=True)
    np.savetxt(root / "gt_1600" / "ball.xyz", truth.unit * truth.samples[:, :3])
    inputs = cases.draw_input(truth, "uniform", 200, np.random.default_rng(1))
    np.savetxt(root / "input_200" / "ball.xyz", truth.unit * inputs[:, :3])
    write_mesh(root / "meshes" / "ball.off", ball)
    return root


def test_public_pairs(public: Path) -> None:
    (case,) = benchmark.case_source({"root": str(public)}).cases
    assert case.truth.mesh is not None
    assert (len(case.points), len(case.truth.samples)) == (200, 1600)
    assert case.truth.unit == pytest.approx(40, rel=1e-3)
    (row,) = (
        row
        for row in benchmark.evaluate({}, [case], ratio=4, metrics=chosen("pugan").metrics())
        if row["method"] == "input"
    )
    assert row["p2f_mesh_unit"] < 1e-3  # of 40
    assert 0 < row["chamfer_sq_each"] < row["hausdorff_sq_sum_each"] < 0.2


def test_public_pairs_without_meshes_have_no_p2f(public: Path) -> None:
    (public / "meshes" / "ball.off").unlink()
    said: list[str] = []
    (case,) = benchmark.case_source({"root": str(public)}, warn=said.append).cases
    assert case.truth.mesh is None
    assert said == [f"ball: has no mesh, so no P2F; expected it in {public}/meshes"]
    (public / "gt_900").mkdir()
    with pytest.raises(ValueError, match="expected one folder gt_<points>, found gt_1600, gt_900"):
        pair_folders.pair_files(public)
    (public / "gt_900").rmdir()
    (public / "gt_1600" / "ball.xyz").unlink()
    with pytest.raises(ValueError, match=r"gt_1600: expected ball\.xyz, the truth of .*input_200/ball"):
        list(benchmark.case_source({"root": str(public)}, warn=said.append).cases)


def test_published_rows_stand_apart(public: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = protocols.published_rows()
    assert all(row.source and 0 < row.cd < row.hd and row.p2f > 0 for row in rows)
    assert [row.method for row in chosen("pugan").published_rows(16)] == ["PU-Gaussian", "APU-LDI", "RepKPU", "Grad-PU"]
    evaluate.main(["method=midpoint", "protocol=pugan", "data=meshes", f"data.root={public}", f"output={public}/out"])
    text = capsys.readouterr().out
    measured_part, _, published = text.partition("Published on PU-GAN's 27 test shapes, x4; not measured here")
    assert "both maxima of the squared distances added, each cloud in a unit sphere" in " ".join(measured_part.split())
    assert "Grad-PU" in published
    assert "Grad-PU" not in measured_part
    found = read_json(public / "out" / "metrics.json")
    assert found["protocol"] == {"inputs": "poisson", "frame": "each", "chamfer": "sum", "hausdorff": "sum"}
    assert "Grad-PU" not in str(found)
