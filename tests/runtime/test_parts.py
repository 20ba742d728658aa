"""Long computations go on from finished parts, and give what they would have given without the interruption."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pnu.networks.checkpoints import load
from pnu.networks.pnu import PNU
from pnu.networks.surface import Surface
from pnu.runtime.parts import Parts
from pnu.upsamplers import patches as procedure
from pnu.upsamplers import surface_projection
from pnu.upsamplers.whole_clouds import upsample


class Stop(Exception):
    pass


def sphere(n: int) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def patches(size: int = 128) -> PNU:
    torch.manual_seed(0)
    network = PNU(local_features=False)
    network.patch_size = size
    return network


@pytest.mark.parametrize("model", ["surface", "patches"])
def test_an_interrupted_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    monkeypatch.setattr(surface_projection, "KEPT", 1000)
    monkeypatch.setattr(procedure, "KEPT", 3)
    points = sphere(800)
    network = "surface" if model == "surface" else patches()
    stage = "refinement" if model == "surface" else "farthest"
    expected = upsample(points, points, model=network)

    def stop(name: str, done: int, total: int) -> None:
        if name.startswith(stage) and done >= (total / 2 if model == "surface" else 0):
            raise Stop

    with pytest.raises(Stop):
        upsample(points, points, model=network, progress=stop, parts=tmp_path)
    (folder,) = tmp_path.iterdir()
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert len(before) > 3
    assert not list(folder.glob(".*"))  # nothing half-written
    seen = set()
    found = upsample(
        points, points, model=network, progress=lambda name, done, total: seen.add((name, done)), parts=tmp_path
    )
    np.testing.assert_array_equal(found, expected)
    assert before == {path: path.stat().st_mtime_ns for path in before}  # taken, not made again
    assert ("projection", 512) not in seen


def test_parts_that_another_version_cut_otherwise_do_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = sphere(300)
    expected = upsample(points, points, parts=tmp_path, model="surface")
    monkeypatch.setattr(surface_projection, "KEPT", 500)
    np.testing.assert_array_equal(upsample(points, points, parts=tmp_path, model="surface"), expected)


def test_parts_of_another_task_are_not_taken(tmp_path: Path) -> None:
    points = sphere(300)
    upsample(points, points, parts=tmp_path, model="surface")
    for changed in (
        {"points": points * [1, 1, 1.1]},
        {"ratio": 3},
        {"model": "surface_estimated"},
        {"model": patches(), "patch_size": 100},
    ):
        options = {"points": points, "normals": points, "model": "surface", **changed}
        found = upsample(**options, parts=tmp_path)
        np.testing.assert_array_equal(found, upsample(**options))
    assert len(list(tmp_path.iterdir())) == 5


def test_parts_of_a_network_with_other_options_are_not_taken(tmp_path: Path) -> None:
    points = sphere(300)
    for sphere_first in (True, False):
        network = Surface(sphere=sphere_first, coarse=32)
        network.load_state_dict(load("surface").state_dict())
        found = upsample(points, points, model=network, parts=tmp_path)
        np.testing.assert_array_equal(found, upsample(points, points, model=network))


def test_threads_do_not_matter() -> None:
    points = sphere(600)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = upsample(points, points, model="surface")
        torch.set_num_threads(3)
        np.testing.assert_array_equal(upsample(points, points, model="surface"), one)
    finally:
        torch.set_num_threads(before)


def test_a_failed_part_leaves_no_file(tmp_path: Path) -> None:
    def fail() -> np.ndarray:
        raise Stop

    with pytest.raises(Stop):
        Parts(tmp_path).get("x", fail)
    assert not list(tmp_path.iterdir())
