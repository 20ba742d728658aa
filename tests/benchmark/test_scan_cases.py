"""Simulated scans as kinds of input of an evaluation."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pnu.benchmark import SCANS, case_source, evaluate, mesh_cases, of_kinds, open3d_chain
from pnu.benchmark.result_tables import columns
from pnu.commands.evaluate import main
from pnu.data import shapes
from pnu.metrics import Pair
from pnu.metrics.scan_scores import P2F95, Completeness, Gap, Stray
from tests.refusals import ran, refused

MUG = {"mug": lambda: shapes.make("mug")}


@pytest.mark.slow
def test_scans_are_compared_with_what_they_have_seen() -> None:
    cases = {case.kind: case for case in mesh_cases(MUG, ("random", *SCANS), points=500, truth_points=2000)}
    assert len(cases["random"].truth.samples) == 2000
    assert 300 < len(cases["oneview"].truth.samples) < 1500  # one side, and not the inside of the mug
    assert len(cases["flipped"].truth.samples) == 2000
    assert {kind for kind in SCANS if cases[kind].normals is not None} == {"flipped"}
    near = torch.cdist(
        torch.from_numpy(cases["oneview"].truth.samples[:, :3]), torch.from_numpy(cases["oneview"].points)
    )
    assert near.amin(1).max() < 0.2
    (bare,) = mesh_cases(MUG, ("flipped",), truth_points=500, normals=False)
    assert bare.normals is None


def test_scores_of_scans_by_hand() -> None:
    from pnu.io import Mesh

    square = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    cloud = np.array([[0.5, 0.5, 0.01], [0.25, 0.5, 0.02], [0.75, 0.5, 0.04], [0.5, 0.25, 0.0]])
    pair = Pair(cloud, np.array([[0.5, 0.5, 0], [0.5, 0.25, 0.3]]), square)
    assert float(Stray()(pair)) == 0.25
    assert float(P2F95()(pair)) == pytest.approx(np.quantile([0.01, 0.02, 0.04, 0], 0.95))
    assert float(Completeness()(pair)) == pytest.approx(0.155)
    assert float(Gap()(pair)) == pytest.approx(0.3)


@pytest.mark.slow
def test_columns_are_those_of_the_kind() -> None:
    def double(points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
        return np.tile(np.hstack([points, np.eye(3)[:1].repeat(len(points), 0)]), (2, 1))

    cases = mesh_cases(MUG, ("random", "oneview"), points=64, truth_points=300)
    rows = list(evaluate({"double": double}, cases, ratio=2, metrics=of_kinds(["random", "oneview"])))
    names = {
        kind: {shown.name for shown in columns([r for r in rows if r["kind"] == kind], of_kinds([kind]))}
        for kind in ("random", "oneview")
    }
    assert {"p2f", "p2f_95", "stray", "completeness", "gap", "flipped"} < names["oneview"]
    assert "chamfer_sq" not in names["oneview"]
    assert "chamfer_sq" in names["random"]
    assert "gap" not in names["random"]
    assert {row["method"] for row in rows if row["kind"] == "oneview"} == {"double", "input"}


@pytest.mark.slow
def test_open3ds_chain_makes_as_many_points_with_normals() -> None:
    sphere = np.random.default_rng(0).normal(size=(600, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    dense = open3d_chain(2)(np.vstack([sphere, [[3.0, 3, 3]]]), None)
    assert dense.shape == (1202, 6)
    assert np.abs(np.linalg.norm(dense[:, :3], axis=1) - 1).max() < 0.2


@pytest.mark.slow
def test_the_command_takes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ("data=synthetic", "shapes=[mug]", "part=all")
    done = ran(main, tmp_path, "method=midpoint", *data, "kinds=[oneview]", "truth_points=300")
    assert done.returncode == 0, done.stderr
    assert "stray" in done.stdout
    assert "gap" in done.stdout
    line = refused(capsys, main, ["method=midpoint", *data, "kinds=[twoview]"])
    assert line.endswith("flipped")


def test_unknown_kinds_name_the_known() -> None:
    with pytest.raises(ValueError, match=r"kinds=scan: expected some of uniform, .*, orbit, oneview"):
        case_source({"kinds": None}, ["scan"])
