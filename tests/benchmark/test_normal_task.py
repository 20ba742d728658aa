"""Normals as a task: scores by hand, jets where they are exact, clouds of each kind, the command."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pnu.benchmark import normal_task
from pnu.commands.evaluate import main
from pnu.data.normal_patches import NORMAL_KINDS
from pnu.geometry.jet_normals import jet_normals
from pnu.geometry.mesh_sampling import closest_points
from pnu.geometry.normal_estimation import estimate_normals
from pnu.io import read_json, write_mesh
from pnu.metrics.normal_scores import angles_deg, normal_scores
from pnu.networks.pcpnet import PCPNet
from pnu.upsamplers import upsampler_of
from tests.reconstruction.test_surfaces import icosphere


def turned(*degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)], 1)


def test_scores_by_hand() -> None:
    true = turned(0, 0, 0, 0)
    found = normal_scores(turned(0, 3, 8, 177), true)
    assert found == pytest.approx(
        {
            "unoriented_rms_deg": np.sqrt((0 + 9 + 64 + 9) / 4), "unoriented_pgp5": 0.75, "unoriented_pgp10": 1.0,
            "oriented_rms_deg": np.sqrt((0 + 9 + 64 + 177**2) / 4), "oriented_pgp5": 0.5, "oriented_pgp10": 0.75,
            "flipped": 0.25,
        }
    )  # fmt: skip
    none = np.array([[0.0, 0, 0], [np.nan, 0, 0]])
    np.testing.assert_array_equal(angles_deg(none, true[:2], oriented=True), [90, 90])


def test_jets_are_exact_on_their_own_surfaces() -> None:
    """A paraboloid is a jet of degree 2: exact also where neighbors lie all on one side, where planes are not."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 1, (400, 2))
    points = torch.from_numpy(np.column_stack([xy, 0.3 * (xy**2).sum(1)]))[None]
    true = np.column_stack([-0.6 * xy, np.ones(400)])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    jets = normal_scores(jet_normals(points, 24)[0].numpy(), true)
    planes = normal_scores(estimate_normals(points[0].numpy(), 24, orient=False), true)
    assert jets["unoriented_rms_deg"] < 0.2 * planes["unoriented_rms_deg"]
    plane = torch.from_numpy(np.column_stack([xy, xy @ [0.5, -1]]))[None]
    normal = torch.nn.functional.normalize(torch.tensor([-0.5, 1, 1], dtype=torch.float64), dim=0)
    torch.testing.assert_close((jet_normals(plane, 12) @ normal).abs(), torch.ones(1, 400, dtype=torch.float64))
    moved = jet_normals(1e3 * points + 1e4, 24)
    torch.testing.assert_close((moved * jet_normals(points, 24)).sum(-1).abs(), torch.ones(1, 400, dtype=torch.float64))
    with pytest.raises(ValueError, match="k: expected 6 .*to 400 neighbors .*found 5"):
        jet_normals(points, 5)


@pytest.mark.parametrize("kind", NORMAL_KINDS)
def test_clouds_of_each_kind(kind: str) -> None:
    ball = icosphere(3)
    ball = ball._replace(vertices=ball.vertices * [2, 1, 1])
    (case,) = normal_task.normal_cases({"ball": lambda: ball}, [kind], points=3000)
    (same,) = normal_task.normal_cases({"ball": lambda: ball}, [kind], points=3000)
    np.testing.assert_array_equal(case.points, same.points)
    assert case.points.shape == case.normals.shape == (3000, 3)
    distance = closest_points(ball, case.points)[1]
    diagonal = np.linalg.norm(np.ptp(ball.vertices, axis=0))
    sigma = float(kind.removeprefix("noise_")) / 100 * diagonal if kind.startswith("noise") else 0
    assert 0.6 * sigma <= distance.mean() <= sigma + 1e-9
    stripes = np.histogram(case.points[:, 0], 12)[0]
    if kind == "striped":
        assert stripes[0::2].sum() > 8 * stripes[1::2].sum()
    if kind == "gradient":
        assert stripes[:4].sum() > 4 * stripes[8:].sum()


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "meshes").mkdir()
    write_mesh(tmp_path / "meshes" / "ball.ply", icosphere(3))
    data = ["task=normals", "data=meshes", f"data.root={tmp_path}/meshes", "points=200", f"output={tmp_path}/out"]
    main([*data, "kinds=[clean,gradient]"])
    text = capsys.readouterr().out
    measured, _, published = text.partition("not measured here")
    assert "Nesti-Net" in published
    assert "Nesti-Net" not in measured
    rows = read_json(tmp_path / "out" / "metrics.json")["rows"]
    assert {(row["kind"], row["method"]) for row in rows} == {
        (kind, method) for kind in ("clean", "gradient") for method in ("pca", "jets", "planes", "pnu")
    }
    assert all(row["flipped"] == 0 and row["oriented_rms_deg"] < 15 for row in rows if row["kind"] == "clean")
    for arguments, message in (
        (["method=apss"], "method=apss: expected pca, jets, planes, pnu with task=normals"),
        (["kinds=[uniform]"], "kinds=uniform: expected some of clean, noise_0.12"),
        (["run=pnu"], "run=pnu: is no network of normals, which task=normals trains"),
    ):
        with pytest.raises(SystemExit):
            main([*data, *arguments])
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["task=normal"])
    assert "task=normal: expected upsampling or normals" in capsys.readouterr().err


def test_a_network_of_neighborhoods() -> None:
    torch.manual_seed(0)
    network = PCPNet((8, 16), 0.05).eval()
    points = icosphere(3).vertices
    found = normal_task.network_estimator(network, "tiny", at_once=100)(points)
    assert found.shape == points.shape
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-6)
    with pytest.raises(ValueError, match="points=10: tiny sees 16 neighbors"):
        normal_task.network_estimator(network, "tiny")(points[:10])
    with pytest.raises(ValueError, match="PCPNet estimates normals and makes no points"):
        upsampler_of(network)
