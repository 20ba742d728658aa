"""Evaluation of whole clouds: the inputs drawn, the numbers, the references, the files, and the command itself."""

import csv
import importlib.util
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from pnu import benchmark, metrics
from pnu.benchmark import cases, cost, result_tables
from pnu.commands.evaluate import main
from pnu.data import shapes
from pnu.geometry.mesh_sampling import closest_points, sample_area, sample_poisson_disk
from pnu.io import Mesh, read_cloud, read_json, write_cloud, write_json, write_mesh
from pnu.networks.pnu import PNU
from pnu.upsamplers import classical


@pytest.fixture(scope="module")
def box() -> Mesh:
    return shapes.make("heat_sink")


@pytest.fixture(scope="module")
def truth(box: Mesh) -> benchmark.Truth:
    return benchmark.truth_of_mesh("heat_sink", box, 4000, seed=0)


def silent(text: str) -> None:
    pytest.fail(f"unexpected warning: {text}")


# Inputs


@pytest.mark.parametrize("kind", benchmark.KINDS)
def test_inputs_lie_on_the_surface_and_come_from_the_seed(truth: benchmark.Truth, kind: str) -> None:
    assert truth.mesh is not None
    cloud = cases.draw_input(truth, kind, 2000, cases.generator(0, "a", kind))
    assert len(cloud) == (500 if kind == "sparse" else 2000)
    distance = closest_points(truth.mesh, cloud[:, :3])[1]
    sigma = float(kind.removeprefix("noise_")) / 100 if kind.startswith("noise") else 0
    # Noise in three coordinates, of which the distance to the surface sees about one.
    assert 0.5 * sigma <= distance.mean() <= sigma + 1e-12
    np.testing.assert_allclose(np.linalg.norm(cloud[:, 3:], axis=1), 1)
    np.testing.assert_array_equal(cloud, cases.draw_input(truth, kind, 2000, cases.generator(0, "a", kind)))
    for seed, shape in ((1, "a"), (0, "b")):
        other = cases.draw_input(truth, kind, 2000, cases.generator(seed, shape, kind))
        assert not np.array_equal(cloud, other)


def test_kinds_differ_as_they_should(truth: benchmark.Truth) -> None:
    clouds = {k: cases.draw_input(truth, k, 2000, cases.generator(0, "a", k)) for k in benchmark.KINDS}
    spacing = {kind: float(metrics.spacing_cv(cloud)) for kind, cloud in clouds.items()}
    density = {kind: float(metrics.uniformity(cloud, truth.samples)) for kind, cloud in clouds.items()}
    assert max(spacing["uniform"], spacing["sparse"]) < 0.2 < 0.45 < min(spacing["random"], spacing["nonuniform"])
    assert density["uniform"] < 0.15 < density["random"] < 0.3 < density["nonuniform"]


def test_truth_is_brought_to_its_unit_sphere(box: Mesh) -> None:
    far = Mesh(40 * box.vertices + 1e4, box.faces)
    moved = benchmark.truth_of_mesh("heat_sink", far, 4000, seed=0, warn=silent)
    assert moved.mesh is not None
    assert moved.frame == "unit sphere of the truth"
    assert np.linalg.norm(moved.mesh.vertices, axis=1).max() == pytest.approx(1)
    np.testing.assert_allclose(moved.samples[:, :3].mean(0), 0, atol=0.01)
    np.testing.assert_allclose(closest_points(moved.mesh, moved.samples[:, :3])[1], 0, atol=1e-9)
    assert benchmark.truth_of_mesh("heat_sink", box, 4000, seed=0).frame == "as given, a unit sphere"


def test_a_small_shape_beside_the_origin_is_in_no_unit_sphere(box: Mesh) -> None:
    """Its farthest vertex is at 1 as well: taken as it is, CD would be 100 times too small."""
    aside = box.vertices * 0.1 + [0.9, 0, 0]
    aside /= np.linalg.norm(aside, axis=1).max()
    made = benchmark.truth_of_mesh("aside", Mesh(aside, box.faces), 2000, seed=0, warn=silent)
    assert made.frame == "unit sphere of the truth"
    assert made.mesh is not None
    assert np.linalg.norm(made.mesh.vertices, axis=1).max() == pytest.approx(1)
    # the same of samples alone, where each usual center counts
    even = sample_poisson_disk(box, 2000, np.random.default_rng(0))[:, :3]
    even /= np.linalg.norm(even, axis=1).max()
    for cloud, name in ((even, "as given, a unit sphere"), (0.5 * even + [0.5, 0, 0], "unit sphere of the truth")):
        frame, found = cases.frame_of(cloud / np.linalg.norm(cloud, axis=1).max(), None)
        assert found == name
        assert cases.radius(cases.moved(cloud / np.linalg.norm(cloud, axis=1).max(), frame)) == pytest.approx(1)


@pytest.mark.parametrize("center", ["centroid", "vertices", "box"])
def test_a_unit_sphere_about_any_usual_center_stays(center: str) -> None:
    wedge = shapes.make("wedge")
    v = wedge.vertices
    c = {"centroid": cases.centroid(wedge), "vertices": v.mean(0), "box": (v.min(0) + v.max(0)) / 2}[center]
    frame, name = cases.frame_of(np.zeros((1, 3)), Mesh((v - c) / cases.radius(v - c), wedge.faces))
    assert (name, float(frame.scale)) == ("as given, a unit sphere", 1.0)


def test_a_mesh_that_is_not_watertight_warns_and_works(box: Mesh) -> None:
    warnings: list[str] = []
    opened = benchmark.truth_of_mesh("open", Mesh(box.vertices, box.faces[1:]), 500, 0, warn=warnings.append)
    assert warnings == ["open: is not watertight (3 open edges); taken as an open surface"]
    assert len(opened.samples) == 500


# Numbers


def test_measure_is_the_metrics_with_the_normals_of_the_mesh(truth: benchmark.Truth) -> None:
    assert truth.mesh is not None
    cloud = cases.draw_input(truth, "noise_1", 800, np.random.default_rng(0))
    found = benchmark.measure(cloud, truth)
    error = metrics.normal_error(cloud, truth.mesh)
    assert found["chamfer_sq"] == float(metrics.chamfer_sq(cloud, truth.samples))
    assert found["p2f"] == float(metrics.point_to_mesh(cloud, truth.mesh))
    assert (found["normal_deg"], found["flipped"]) == (float(error.signed_deg), float(error.flipped))
    assert list(found) == [metric.shown.name for metric in metrics.METRICS]
    without = benchmark.measure(cloud, truth._replace(mesh=None, samples=truth.samples[:, :3]))
    assert set(without) == {"chamfer_sq", "hausdorff_sq", "spacing_cv", "uniformity"}


def test_rows_of_methods_and_references(box: Mesh) -> None:
    """An upsampler that knows the surface scores like the floor, and its input's row scores what the input scores."""
    meshes = {"heat_sink": lambda: box}
    drawn = list(benchmark.mesh_cases(meshes, ["random", "sparse"], points=600, truth_points=4000, seed=3, warn=silent))

    def perfect(points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
        return sample_poisson_disk(drawn[0].truth.mesh, 4 * len(points), np.random.default_rng(7))  # type: ignore[arg-type]

    kept: dict[tuple[str, str], np.ndarray] = {}
    steps: list[str] = []

    def keep(case: benchmark.Case, name: str, cloud: np.ndarray) -> None:
        kept[case.kind, name] = cloud

    rows = list(benchmark.evaluate({"perfect": perfect}, drawn, ratio=4, step=steps.append, keep=keep))
    assert [(row["kind"], row["method"]) for row in rows] == [
        (kind, method) for kind in ("random", "sparse") for method in ("perfect", "floor", "input")
    ]
    made, floor, given = rows[:3]
    assert (made["points_in"], made["points_out"], floor["points_out"], given["points_out"]) == (600, 2400, 2400, 600)
    assert rows[4]["points_out"] == 600
    for name in ("chamfer_sq", "spacing_cv"):
        assert made[name] == pytest.approx(floor[name], rel=0.05)
    assert made["p2f"] == pytest.approx(0, abs=1e-12)
    assert (
        given["chamfer_sq"] == float(metrics.chamfer_sq(drawn[0].points, drawn[0].truth.samples)) > made["chamfer_sq"]
    )
    assert made["seconds"] > 0
    assert made["peak_memory_mb"] > 50
    assert "seconds" not in floor
    assert kept["sparse", "perfect"].shape == (600, 6)
    assert steps[:2] == ["heat_sink, random: perfect", "heat_sink, random: references"]


def test_a_wrong_number_of_points_is_an_error(box: Mesh) -> None:
    drawn = benchmark.mesh_cases({"heat_sink": lambda: box}, ["random"], points=100, truth_points=400)
    with pytest.raises(ValueError, match="copy: gave 100 points for heat_sink, expected 200"):
        list(benchmark.evaluate({"copy": lambda points, normals: points}, drawn, ratio=2))


def test_inputs_without_normals() -> None:
    meshes = {"pear": lambda: shapes.make("pear")}
    drawn = list(benchmark.mesh_cases(meshes, ["uniform"], points=500, truth_points=2000, normals=False))
    assert drawn[0].normals is None
    upsampler = benchmark.network_upsampler(classical("midpoint"), 2)
    made, _, given = benchmark.evaluate({"midpoint": upsampler}, drawn, ratio=2)
    assert 0 < given["normal_unsigned_deg"] < 20  # estimated
    assert made["normal_unsigned_deg"] < 20


def test_a_network_of_another_ratio_needs_leave() -> None:
    network = PNU(ratio=2, local_features=False).eval()
    with pytest.raises(ValueError, match="ratio=4: the-run was trained for 2; give ratio=2, or passes=true"):
        benchmark.network_upsampler(network, 4, name="the-run")
    points = np.random.default_rng(0).normal(size=(100, 3))
    assert len(benchmark.network_upsampler(network, 3, passes=True)(points, points)) == 300
    assert len(benchmark.network_upsampler(network, 2)(points, points)) == 200


def test_rows_with_the_points_given_in_them() -> None:
    points = np.random.default_rng(0).normal(size=(300, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    kept, new = (benchmark.network_upsampler("surface", 2, keep=keep)(points, points) for keep in ("true", False))
    assert len(kept) == len(new) == 600
    np.testing.assert_array_equal(kept[:300, :3], points)
    assert not np.isin(points[:, 0], new[:, 0]).any()
    with pytest.raises(ValueError, match="keep=true: midpoint spreads all points anew; leave it out"):
        benchmark.network_upsampler(classical("midpoint"), 2, keep="true", name="midpoint")
    with pytest.raises(ValueError, match="keep=maybe: expected true, false or auto"):
        benchmark.network_upsampler("surface", 2, keep="maybe")(points, points)


def test_summary_by_hand() -> None:
    rows = [
        {"shape": s, "kind": "random", "method": "m", "chamfer_sq": v, **more}
        for s, v, more in (("a", 1.0, {"p2f": 2.0}), ("b", 3.0, {}), ("c", 8.0, {"p2f": 4.0}))
    ]
    (summary,) = benchmark.summarize(rows)
    assert (summary["shapes"], summary["chamfer_sq"]) == (3, 4.0)
    assert summary["chamfer_sq_std"] == pytest.approx(math.sqrt((9 + 1 + 16) / 2))
    assert math.isnan(summary["p2f"])  # a shape without a value must not vanish from the mean
    assert math.isnan(benchmark.summarize(rows[:1])[0]["chamfer_sq_std"])
    chamfer, p2f = benchmark.columns(rows)
    assert result_tables.row_cell(summary, p2f) == "-"
    assert result_tables.row_cell(summary, chamfer) == "4000.0000"


def test_spread_over_seeds_by_hand(capsys: pytest.CaptureFixture[str]) -> None:
    """Means over two shapes are 2, 4 and 9: mean 5, variance (9 + 1 + 16) / 2. One seed has no spread."""
    values = {
        "wide_seed-0": (1, 3),
        "wide_seed-1": (3, 5),
        "wide_seed-2": (8, 10),
        "slim_seed-0": (1, 1),
        "apss": (1, 1),
    }
    rows = [
        {"shape": shape, "kind": "random", "method": method, "chamfer_sq": 1e-3 * value}
        for method, pair in values.items()
        for shape, value in zip("ab", pair, strict=True)
    ]
    (found,) = benchmark.over_seeds(rows)
    assert (found["method"], found["seeds"], found["kind"]) == ("wide", 3, "random")
    assert found["chamfer_sq"] == pytest.approx(5e-3)
    assert found["chamfer_sq_std"] == pytest.approx(1e-3 * math.sqrt(13))
    benchmark.print_over_seeds(rows)
    assert "5.0000 ± 3.6056" in capsys.readouterr().out


def test_names_are_not_cut_in_tables_of_many_columns(capsys: pytest.CaptureFixture[str]) -> None:
    names = ["loss_terms_no_normal", "loss_terms_no_normal_knn", "loss_terms_no_normal_orth"]
    values = {metric.shown.name: 0.123 for metric in metrics.METRICS} | {"seconds": 1.5, "peak_memory_mb": 600.0}
    rows = [
        {"shape": "a_shape_with_a_name", "kind": "random", "method": f"{name}_seed-{seed}"} | values
        for name in names
        for seed in range(2)
    ]
    benchmark.print_over_seeds(rows)
    shown = capsys.readouterr().out
    assert all(f" {name} " in shown for name in names)
    points = {"points_in": 1, "points_out": 4, "frame": "truth"}
    benchmark.print_tables([row | points for row in rows], "what was measured, and by which revision.")
    shown = capsys.readouterr().out
    assert "\nwhat was measured, and by which revision. CD: " in shown
    assert all(f" {row['shape']} " in shown and row["method"] in shown for row in rows)


def test_cost_sees_memory_and_children() -> None:
    with cost.Cost() as small:
        pass
    with cost.Cost() as large:
        np.ones(300 * 2**17).sum()  # 300 MiB
    with cost.Cost() as child:
        subprocess.run([sys.executable, "-c", "x = bytearray(200 * 2**20)"], check=True)
    assert 0 <= small.values["seconds"] < 1
    assert large.values["peak_memory_mb"] > 250
    assert child.values["peak_memory_mb"] > small.values["peak_memory_mb"] + 190
    if os.access(cost.RESET, os.W_OK):
        assert small.values["peak_memory_mb"] + 250 < large.values["peak_memory_mb"]


# Where cases come from


def test_source_of_procedural_shapes() -> None:
    data = {"kinds": ["cad"], "val_share": 0.1, "test_share": 0.2}
    parts = {part: benchmark.case_source(data, part=part).shapes for part in benchmark.PARTS}
    assert sorted(parts["train"] + parts["val"] + parts["test"]) == parts["all"] == shapes.names("cad")
    found = benchmark.case_source(data)
    assert (found.name, found.shapes, found.kinds) == ("synthetic", parts["test"], list(benchmark.KINDS))
    some = benchmark.case_source(data, ["random"], only=["wedge", "cup"], points=100, truth_points=200)
    assert [(case.truth.shape, len(case.points)) for case in some.cases] == [("wedge", 100), ("cup", 100)]


def test_source_of_a_folder_of_meshes(tmp_path: Path, box: Mesh) -> None:
    (tmp_path / "more").mkdir()
    write_mesh(tmp_path / "a.off", box)
    write_mesh(tmp_path / "more" / "b.stl", Mesh(box.vertices * 7, box.faces))
    found = benchmark.case_source({"root": str(tmp_path)}, ["uniform"], points=64, truth_points=150)
    assert (found.name, found.shapes) == (tmp_path.name, ["a", "more_b"])
    assert [case.truth.frame for case in found.cases] == ["as given, a unit sphere", "unit sphere of the truth"]


@pytest.mark.parametrize(
    ("data", "options", "text"),
    [
        ({"kinds": ["cad"]}, {"kinds": ["even"]}, "kinds=even: expected some of uniform, random, nonuniform"),
        ({"kinds": ["cad"]}, {"part": "all of them"}, "part=all of them: expected one of train, val, test, all"),
        ({"kinds": ["cad"]}, {"only": ["duck"]}, "shapes=duck: expected some of "),
        ({"kinds": ["cad"]}, {"points": 10}, "points=10: expected at least 64"),
        ({"path": "patches.h5"}, {}, "data: evaluation takes whole shapes: data=synthetic, or data=meshes"),
        ({"root": None}, {}, "data: evaluation takes whole shapes"),
        ({"root": "nowhere"}, {}, "data.root=nowhere: no such folder"),
        ({"kinds": ["cad"]}, {"columns": "x,y,z"}, "columns=x,y,z: is for prepared pairs, data=meshes"),
    ],
)
def test_sources_refuse_at_once(data: dict, options: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        benchmark.case_source(data, **options)


# Prepared pairs


@pytest.fixture
def pairs(tmp_path: Path, box: Mesh) -> Path:
    """One pair in a frame of its own, radius about 40 around (1e4, 1e4, 1e4)."""
    root = tmp_path / "pairs"
    (root / "clouds").mkdir(parents=True)
    (root / "truth").mkdir()
    cloud = sample_area(box, 500, np.random.default_rng(0))
    write_cloud(root / "clouds" / "sink.xyz", 40 * cloud[:, :3] + 1e4, cloud[:, 3:])
    write_mesh(root / "truth" / "sink.ply", Mesh(40 * box.vertices + 1e4, box.faces))
    return root


def test_pairs_are_compared_in_the_unit_sphere_of_the_truth(pairs: Path) -> None:
    found = benchmark.case_source({"root": str(pairs)}, truth_points=2000, warn=silent)
    (case,) = found.cases
    assert (found.name, found.shapes, found.kinds, case.kind) == ("pairs", ["sink"], ["given"], "given")
    assert case.truth.mesh is not None
    assert len(case.truth.samples) == 2000
    assert np.linalg.norm(case.truth.mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(closest_points(case.truth.mesh, case.points)[1], 0, atol=1e-6)


def test_pairs_with_samples_only_have_no_floor_and_no_p2f(pairs: Path, box: Mesh) -> None:
    even = sample_poisson_disk(box, 1000, np.random.default_rng(1))
    np.save(pairs / "truth" / "sink_1000.npy", np.hstack([40 * even[:, :3] + 1e4, even[:, 3:]]))
    (case,) = benchmark.case_source({"root": str(pairs)}, truth_points=1000, warn=silent).cases
    assert len(case.truth.samples) == 1000
    (pairs / "truth" / "sink.ply").unlink()
    (case,) = benchmark.case_source({"root": str(pairs)}).cases
    rows = list(benchmark.evaluate({}, [case], ratio=4))
    assert [row["method"] for row in rows] == ["input"]
    assert "p2f" not in rows[0]
    assert rows[0]["normal_unsigned_deg"] < 30


def test_columns_of_pairs_as_text(pairs: Path, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, normals, _, _ = read_cloud(pairs / "clouds" / "sink.xyz")
    assert normals is not None
    (pairs / "clouds" / "sink.xyz").unlink()
    np.savetxt(pairs / "clouds" / "sink.txt", np.hstack([normals, np.ones((len(points), 1)), points]))
    columns = "nx,ny,nz,_,x,y,z"
    found = benchmark.case_source({"root": str(pairs)}, truth_points=500, columns=columns, warn=silent)
    (case,) = found.cases
    assert case.normals is not None
    np.testing.assert_allclose(case.normals, normals, atol=1e-9)
    np.testing.assert_allclose(closest_points(case.truth.mesh, case.points)[1], 0, atol=1e-6)
    main(["method=midpoint", "data=meshes", f"data.root={pairs}", "truth_points=500", f"columns={columns}"])
    assert capsys.readouterr().out.endswith(f"""data.root={pairs} 'columns="{columns}"'\n""")
    for wrong, text in {"x,y": "columns=x,y: expected x, y and z", "3": "columns=3: expected x, y and z"}.items():
        with pytest.raises(ValueError, match=text):
            benchmark.case_source({"root": str(pairs)}, columns=wrong)
    (pairs / "clouds" / "sink.txt").unlink()
    write_cloud(pairs / "clouds" / "sink.ply", points)
    with pytest.raises(ValueError, match=r"columns=x,y,z: is for text and arrays without .*/clouds has none"):
        benchmark.case_source({"root": str(pairs)}, columns="x,y,z")


def save_samples(pairs: Path, box: Mesh, *counts: int) -> None:
    for count in counts:
        np.save(
            pairs / "truth" / f"sink_{count}.npy", 40 * sample_area(box, count, np.random.default_rng(0))[:, :3] + 1e4
        )


def test_of_several_samples_those_asked_for_are_taken(pairs: Path, box: Mesh) -> None:
    save_samples(pairs, box, 500, 2000, 900)  # by their names, 900 is the last
    np.save(pairs / "truth" / "sink_more.npy", np.zeros((5, 3)))  # no count
    for count in (500, 2000, 900):
        (case,) = benchmark.case_source({"root": str(pairs)}, truth_points=count, warn=silent).cases
        assert len(case.truth.samples) == count
    said: list[str] = []
    (case,) = benchmark.case_source({"root": str(pairs)}, truth_points=1000, warn=said.append).cases
    assert len(case.truth.samples) == 2000
    name = pairs / "truth" / "sink_2000.npy"
    assert said == [f"{name}: is compared with, since there is no sink_1000.npy (truth_points=1000)"]


def test_what_is_recorded_is_what_was_used(pairs: Path, box: Mesh, tmp_path: Path) -> None:
    save_samples(pairs, box, 700)
    arguments = ["method=midpoint", "data=meshes", f"data.root={pairs}", f"output={tmp_path / 'out'}", "quiet=true"]
    main([*arguments, "truth_points=1500"])
    found = read_json(tmp_path / "out" / "metrics.json")
    assert (found["points"], found["truth_points"]) == (500, 700)
    assert {row["truth_points"] for row in found["rows"]} == {700}


def test_pairs_of_which_it_is_unclear_what_is_meant_are_refused(pairs: Path, box: Mesh) -> None:
    def refused(text: str) -> None:
        with pytest.raises(ValueError, match=text):
            list(benchmark.case_source({"root": str(pairs)}, truth_points=500).cases)

    np.save(pairs / "truth" / "sink_500.npy", sample_area(box, 499, np.random.default_rng(0))[:, :3])
    refused("sink_500.npy: holds 499 points, its name says another number; rename it")
    np.save(pairs / "truth" / "sink_500.npy", sample_area(box, 500, np.random.default_rng(0))[:, :3])
    refused(r"sink.ply: is not in the frame of .*sink_500.npy")
    (pairs / "truth" / "sink_500.npy").unlink()
    write_mesh(pairs / "truth" / "sink.off", box)
    refused(r"sink.off and .*sink.ply: expected one true mesh of sink")
    (pairs / "truth" / "sink.off").unlink()
    write_cloud(pairs / "clouds" / "sink.ply", box.vertices)
    refused(r"sink.ply and .*sink.xyz: are both named sink")


def test_vertices_without_a_face_decide_no_frame(pairs: Path, box: Mesh) -> None:
    """One of them far away made the allowance so large that any cloud was in the frame."""
    mesh = Mesh(np.vstack([box.vertices, [[1e4, 0, 0]]]), box.faces)
    write_mesh(pairs / "truth" / "sink.ply", mesh)
    write_cloud(pairs / "clouds" / "sink.xyz", sample_area(box, 500, np.random.default_rng(0))[:, :3] + 40)
    with pytest.raises(ValueError, match="is not in the frame of"):
        list(benchmark.case_source({"root": str(pairs)}, truth_points=500, warn=silent).cases)


@pytest.mark.slow
def test_pairs_in_different_frames_are_refused(pairs: Path, box: Mesh) -> None:
    write_mesh(pairs / "truth" / "sink.ply", box)
    with pytest.raises(ValueError, match=r"the truth of sink: is not in the frame of .*sink.xyz"):
        list(benchmark.case_source({"root": str(pairs)}).cases)
    (pairs / "truth" / "sink.ply").unlink()
    np.save(pairs / "truth" / "sink_900.npy", sample_area(box, 900, np.random.default_rng(0)))
    with pytest.raises(ValueError, match="is not in the frame of"):
        list(benchmark.case_source({"root": str(pairs)}).cases)
    (pairs / "truth" / "sink_900.npy").unlink()
    with pytest.raises(
        ValueError, match=r"truth: expected sink.ply, the true mesh of clouds/sink, or sink_<count>.npy"
    ):
        list(benchmark.case_source({"root": str(pairs)}).cases)


# The command


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a run of a small network, untrained, for a ratio of 2."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "outputs" / "small"
    (run / "checkpoints").mkdir(parents=True)
    torch.manual_seed(0)
    state = {f"model.{name}": value for name, value in PNU(ratio=2, local_features=False).state_dict().items()}
    torch.save({"state_dict": state}, run / "checkpoints" / "best.ckpt")
    model = {"_target_": "pnu.networks.pnu.PNU", "ratio": 2, "local_features": False}
    (run / "config.yaml").write_text(yaml.safe_dump({"model": model}))
    write_json(run / "run.json", {"status": "finished"})
    return tmp_path


SMALL = ["points=256", "truth_points=500", "shapes=[heat_sink,cup]", "part=all", "kinds=[random,noise_1]"]


@pytest.mark.slow
def test_command_with_a_run(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([*SMALL, "run=newest", "ratio=2", "save=true", "normals=estimate"])
    out = capsys.readouterr().out
    folder = place / "outputs" / "small" / "evaluation" / "synthetic"
    assert "random: 256 -> 512 points" in out
    words = " ".join(out.split())  # lines are as wide as the terminal
    assert "outputs/small, normals of the input estimated. " in words
    assert "CD: mean squared distances" in words
    assert "output: outputs/small/evaluation/synthetic/metrics.json" in out
    assert out.endswith("next:   pnu compare 'methods=[outputs/small,apss]'\n")
    found = read_json(folder / "metrics.json")
    assert (found["subject"], found["ratio"], found["normals"], found["points"]) == (
        "outputs/small",
        2,
        "estimate",
        256,
    )
    with (folder / "metrics.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(found["rows"]) == 2 * 2 * 3
    for line, row in zip(table, found["rows"], strict=True):
        assert line["method"] == row["method"]
        assert float(line["chamfer_sq"]) == row["chamfer_sq"]
    assert [(s["kind"], s["method"], s["shapes"]) for s in found["summary"]][:2] == [
        ("random", "small", 2),
        ("random", "floor", 2),
    ]
    cloud = read_cloud(folder / "clouds" / "cup_noise_1.ply")
    assert len(cloud.points) == 512
    assert sorted(path.name for path in folder.iterdir()) == ["clouds", "metrics.csv", "metrics.json"]


@pytest.mark.slow
def test_command_with_a_method_twice_is_the_same(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = []
    for folder in ("one", "two"):
        main(
            [
                *SMALL[:2],
                "shapes=[cup]",
                "part=all",
                "kinds=[random]",
                "method=apss",
                f"output={folder}/deep",
                "quiet=true",
            ]
        )
        results.append(read_json(Path(folder, "deep", "metrics.json"))["rows"])
    assert capsys.readouterr().out == ""
    for one, two in zip(*results, strict=True):
        same = {name for name in one if name not in ("seconds", "peak_memory_mb")}
        assert {name: one[name] for name in same} == {name: two[name] for name in same}


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["method=aps"], "method=aps: expected one of apss, poisson, midpoint"),
        (["method=apss", "run=outputs/small"], "expected one of them; `pnu compare` takes several"),
        (["run=outputs/small", *SMALL], "ratio=4: outputs/small was trained for 2; give ratio=2, or passes=true"),
        (["run=nowhere"], "run=nowhere: expected a run folder"),
        (["method=apss", "output=file/deep"], "output=file/deep: cannot be made a folder (Not a directory)"),
        (["method=apss", "output=file"], "output=file: cannot be made a folder (File exists)"),
        (["method=apss", "ratio=0.5"], "ratio=0.5: expected a number >= 1"),
        (["method=apss", "normals=none"], "normals=none: expected given or estimate"),
        (["method=apss", "search=fast"], "search=fast: expected exact or open3d"),
        (["method=apss", "data=patches"], "data: evaluation takes whole shapes"),
        (["method=apss", "metod=apss"], "unknown key 'metod': did you mean 'method'?"),
    ],
)
def test_command_refuses(place: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], text: str) -> None:
    (place / "file").touch()
    before = sorted(place.rglob("*"))
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert text in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert sorted(place.rglob("*")) == before


@pytest.mark.slow
def test_command_warns_of_open_meshes_and_stops_at_other_frames(
    place: Path, pairs: Path, box: Mesh, capsys: pytest.CaptureFixture[str]
) -> None:
    write_mesh(pairs / "truth" / "sink.ply", Mesh(40 * box.vertices + 1e4, box.faces[2:]))
    arguments = ["method=midpoint", "data=meshes", f"data.root={pairs}", "truth_points=500", "output=found"]
    main(arguments)
    assert "sink.ply: is not watertight (6 open edges); taken as an open surface\n" in capsys.readouterr().err
    assert json.loads(Path("found/metrics.json").read_text())["rows"][0]["kind"] == "given"
    write_mesh(pairs / "truth" / "sink.ply", box)
    with pytest.raises(SystemExit):
        main([*arguments, "quiet=true"])
    error = capsys.readouterr().err
    assert error.startswith("error: the truth of sink: is not in the frame of")
    assert error.count("\n") == 1


@pytest.mark.slow
def test_command_as_users_start_it(place: Path) -> None:
    command = [sys.executable, "-m", "pnu", "evaluate", "method=nearest"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"error: method=nearest: expected one of apss, poisson, midpoint, .* or open3d\n", done.stderr)


@pytest.mark.slow
def test_equal_to_the_public_score_script(shared: Path, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("open3d")
    spec = importlib.util.spec_from_file_location("score", shared / "bench" / "score.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    data = ["data=meshes", f"data.root={shared / 'bench'}", "shapes=[camel,fandisk]"]
    main(["method=midpoint", *data, "search=open3d", "save=true", "output=found", "quiet=true"])
    rows = [row for row in read_json("found/metrics.json")["rows"] if row["method"] == "midpoint"]
    names = {"chamfer_sq": "CD", "hausdorff_sq": "HD", "p2f": "P2F", "spacing_cv": "spacing_cv", "normal_deg": "normal",
             "normal_unsigned_deg": "normal_unsigned", "flipped": "flipped_%"}  # fmt: skip
    factors = {metric.shown.name: metric.shown.factor for metric in metrics.METRICS}
    for row in rows:
        cloud = read_cloud(f"found/clouds/{row['shape']}_given.ply")
        expected = script.score(row["shape"], np.hstack([cloud.points, cloud.normals]))  # type: ignore[list-item]
        for ours, theirs in names.items():
            # The script's arc cosine in single precision makes 0.02 degrees of 0, on flat faces.
            near = pytest.approx(expected[theirs], rel=5e-5, abs=1e-3 if "normal" in ours else 0)
            assert factors[ours] * row[ours] == near, ours
