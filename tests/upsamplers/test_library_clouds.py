"""Clouds of other libraries go in, and come back as the same kind."""

import inspect
import os
import re
import subprocess
import sys
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pnu import PointCloudUpsampler, upsample, weights
from pnu.io.library_clouds import KINDS, kind_of
from pnu.upsamplers import whole_clouds
from pnu.upsamplers.poor_axes import poor_axes
from pnu.upsamplers.whole_clouds import normals
from tests.upsamplers.test_inference import Spread, sphere

ROOT = Path(__file__).resolve().parents[2]
POINTS = sphere(200)
COLORS = np.round(255 * (POINTS + 1) / 2).astype(np.uint8)


class Library(typing.NamedTuple):
    """How a library's clouds are made, and read, in its own words."""

    make: Callable[[np.ndarray, np.ndarray | None, np.ndarray | None], Any]  # points, normals, colors from 0 to 255
    read: Callable[[Any], tuple[np.ndarray, np.ndarray | None, np.ndarray | None]]
    single: bool = False  # it keeps points in float32


def legacy_open3d() -> Library:
    o3d = pytest.importorskip("open3d")

    def make(points: np.ndarray, normals: np.ndarray | None, colors: np.ndarray | None) -> Any:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        if normals is not None:
            cloud.normals = o3d.utility.Vector3dVector(normals)
        if colors is not None:
            cloud.colors = o3d.utility.Vector3dVector(colors / 255)
        return cloud

    def read(cloud: Any) -> Any:
        colors = np.round(255 * np.asarray(cloud.colors)) if cloud.has_colors() else None
        return np.asarray(cloud.points), np.asarray(cloud.normals) if cloud.has_normals() else None, colors

    return Library(make, read)


def tensor_open3d() -> Library:
    o3d = pytest.importorskip("open3d")

    def make(points: np.ndarray, normals: np.ndarray | None, colors: np.ndarray | None) -> Any:
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points.astype(np.float32)))
        for name, values in (("normals", normals), ("colors", colors)):
            if values is not None:
                cloud.point[name] = o3d.core.Tensor(values)
        return cloud

    def read(cloud: Any) -> Any:
        found = {name: value.numpy() for name, value in cloud.point.items()}
        assert found["positions"].dtype == np.float32
        return found["positions"], found.get("normals"), found.get("colors")

    return Library(make, read, single=True)


def of_trimesh() -> Library:
    trimesh = pytest.importorskip("trimesh")

    def make(points: np.ndarray, normals: np.ndarray | None, colors: np.ndarray | None) -> Any:
        cloud = trimesh.PointCloud(points, colors, metadata={"scanner": "A"})
        if normals is not None:
            cloud.vertex_normals = normals
        return cloud

    def read(cloud: Any) -> Any:
        assert cloud.metadata == {"scanner": "A"}
        colors = np.asarray(cloud.colors)[:, :3] if len(cloud.colors) else None
        return np.asarray(cloud.vertices), getattr(cloud, "vertex_normals", None), colors

    return Library(make, read)


def of_pyvista() -> Library:
    pyvista = pytest.importorskip("pyvista")

    def make(points: np.ndarray, normals: np.ndarray | None, colors: np.ndarray | None) -> Any:
        cloud = pyvista.PolyData(points.astype(np.float32))
        for name, values in (("Normals", normals), ("colors", colors)):
            if values is not None:
                cloud[name] = values
        return cloud

    def read(cloud: Any) -> Any:
        found = {name: np.asarray(values) for name, values in cloud.point_data.items()}
        assert cloud.points.dtype == np.float32
        assert cloud.n_verts == cloud.n_points
        return np.asarray(cloud.points), found.get("Normals"), found.get("colors")

    return Library(make, read, single=True)


def of_pyg() -> Library:
    data = pytest.importorskip("torch_geometric.data")

    def make(points: np.ndarray, normals: np.ndarray | None, colors: np.ndarray | None) -> Any:
        values = {"normal": normals, "colors": colors}
        given = {name: torch.from_numpy(value) for name, value in values.items() if value is not None}
        edges = torch.zeros(2, 7, dtype=torch.int64)
        return data.Data(pos=torch.from_numpy(points).float(), edge_index=edges, category="mug", **given)

    def read(cloud: Any) -> Any:
        assert cloud.category == "mug"
        assert cloud.pos.dtype == torch.float32
        values = [None if cloud.get(name) is None else cloud[name].numpy() for name in ("pos", "normal", "colors")]
        assert cloud.num_nodes == len(cloud.pos)
        return tuple(values)

    return Library(make, read, single=True)


LIBRARIES = [legacy_open3d, tensor_open3d, of_trimesh, of_pyvista]
SLOW = pytest.param(of_pyg, marks=pytest.mark.slow)  # takes seconds to import


@pytest.fixture(params=[*LIBRARIES, SLOW], ids=lambda make: make.__name__)
def library(request: pytest.FixtureRequest) -> Library:
    found: Library = request.param()
    return found


def test_a_cloud_becomes_a_denser_one_of_its_kind(library: Library) -> None:
    """Points and normals are those of the arrays, colors those of the surroundings, and the given cloud stays."""
    cloud = library.make(POINTS, POINTS, COLORS)
    dense = upsample(cloud, model=Spread())
    assert type(dense) is type(cloud)
    points, found, colors = library.read(dense)
    given = POINTS.astype(np.float32) if library.single else POINTS
    expected = upsample(given, POINTS, model=Spread())
    np.testing.assert_allclose(points, expected[:, :3], atol=1e-6 if library.single else 0)
    assert found is not None
    np.testing.assert_allclose(found, expected[:, 3:], atol=1e-6)
    assert colors is not None
    assert np.abs(colors - 255 * (expected[:, 3:] + 1) / 2).max() < 40
    before, same, _ = library.read(cloud)
    np.testing.assert_array_equal(before, given)
    np.testing.assert_allclose(typing.cast(np.ndarray, same), POINTS, atol=1e-7)


def test_a_cloud_gets_its_normals(library: Library) -> None:
    """A copy with all that it has; points that are not finite stay, and have none."""
    holes = np.vstack([POINTS, [[np.nan, 0, 0]]])
    cloud = library.make(holes, None, np.vstack([COLORS, [[1, 2, 3]]]).astype(np.uint8))
    found = normals(cloud)
    assert type(found) is type(cloud)
    assert found is not cloud
    points, made, colors = library.read(found)
    np.testing.assert_allclose(points, holes, atol=1e-7)
    assert made is not None
    np.testing.assert_allclose(made, normals(points), atol=1e-6)
    assert (made[:-1] * POINTS).sum(1).min() > 0.9
    assert np.isnan(made[-1]).all()
    assert colors is not None
    np.testing.assert_array_equal(colors[-1], [1, 2, 3])
    assert library.read(cloud)[1] is None


def test_normals_stand_in_the_cloud_or_beside_it(library: Library) -> None:
    beside = upsample(library.make(POINTS, None, None), POINTS, model=Spread())
    within = upsample(library.make(POINTS, POINTS, None), model=Spread())
    np.testing.assert_allclose(library.read(beside)[0], library.read(within)[0], atol=1e-7)
    assert library.read(beside)[2] is None
    with pytest.raises(ValueError, match=r"^normals: are in the [\w.]+ already; give points without, or no normals"):
        upsample(library.make(POINTS, POINTS, None), POINTS, model=Spread())


def test_too_few_points_of_a_library(library: Library) -> None:
    with pytest.raises(ValueError, match="^points: holds 3 points; at least 16 are needed$"):
        upsample(library.make(POINTS[:3], None, None))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.float16])
def test_a_tensor_comes_back_as_a_tensor(dtype: torch.dtype) -> None:
    """Float32 as it is, all else as float64: whole meters would be no dense cloud."""
    points = (1000 * torch.from_numpy(POINTS)).to(dtype)
    wanted = torch.float32 if dtype == torch.float32 else torch.float64
    dense, found = upsample(points, points, model=Spread()), normals(points)
    assert (dense.dtype, found.dtype) == (wanted, wanted)
    expected = upsample(points.double().numpy(), points.double().numpy(), model=Spread())
    np.testing.assert_allclose(dense.numpy(), expected, rtol=1e-6, atol=1e-4)
    assert found.shape == (200, 3)


def test_what_is_no_single_cloud_is_refused() -> None:
    pyvista = pytest.importorskip("pyvista")
    with pytest.raises(ValueError, match="^points: expected a cloud, found PolyData with faces or lines; give pyvista"):
        upsample(pyvista.Sphere())
    trimesh = pytest.importorskip("trimesh")
    with pytest.raises(ValueError, match=r"^points: expected an array .*, found Trimesh$"):
        upsample(trimesh.creation.box())


@pytest.mark.slow
def test_a_batch_is_refused() -> None:
    data = pytest.importorskip("torch_geometric.data")
    batch = data.Batch.from_data_list([data.Data(pos=torch.from_numpy(POINTS))] * 3)
    with pytest.raises(ValueError, match=r"^points: expected one cloud, found a batch of 3; give each of its to_data_"):
        upsample(batch)


def test_no_library_is_imported_for_it() -> None:
    code = (
        "import sys; import numpy as np; from pnu.io.library_clouds import KINDS, kind_of; "
        "assert kind_of(np.eye(3)) is None; print({kind.where[0] for kind in KINDS} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
    assert len(KINDS) == len([*LIBRARIES, SLOW])
    assert kind_of(POINTS) is None


@pytest.mark.parametrize("function", [whole_clouds.upsample, whole_clouds.normals])
def test_the_types_that_editors_see_are_those_of_the_function(function: Any) -> None:
    """The signatures for arrays and for all else have the same arguments and defaults as the one that runs."""
    own = inspect.signature(function)
    overloads = typing.get_overloads(function)
    assert len(overloads) == 2
    for seen in map(inspect.signature, overloads):
        assert list(seen.parameters) == list(own.parameters)
        for name, parameter in own.parameters.items():
            assert seen.parameters[name].replace(annotation=None) == parameter.replace(annotation=None)
            assert name == "points" or seen.parameters[name].annotation == parameter.annotation


def test_an_upsampler_reads_its_weights_once(monkeypatch: pytest.MonkeyPatch) -> None:
    poor_axes(POINTS, POINTS)  # keeps its own
    read: list[str] = []
    whole = weights.read
    monkeypatch.setattr(weights, "read", lambda path, *kind: read.append(Path(path).stem) or whole(path, *kind))
    upsampler = PointCloudUpsampler(ratio=2).fit()
    assert read == ["surface"]
    for _ in range(2):
        np.testing.assert_array_equal(upsampler.transform(POINTS, POINTS), upsample(POINTS, POINTS, ratio=2))
    assert read == ["surface"] * 3  # two are of the function
    without = upsampler.transform(torch.from_numpy(POINTS))  # other weights, for estimated normals
    np.testing.assert_array_equal(without, upsample(POINTS, ratio=2))
    assert read[3:] == ["surface_estimated"] * 2


def test_an_upsampler_is_set_as_estimators_are() -> None:
    assert repr(PointCloudUpsampler(seed=3, model="apss")) == "PointCloudUpsampler(model='apss', seed=3)"
    network = Spread()
    upsampler = PointCloudUpsampler(model=network, ratio=3)
    again = PointCloudUpsampler(**upsampler.get_params())  # what scikit-learn's clone does
    assert all(value is again.get_params()[name] for name, value in upsampler.get_params().items())
    assert len(again.fit_transform(POINTS, POINTS)) == 600
    assert again.set_params(ratio=2, model=Spread(step=0.0)) is again
    dense = again.transform(POINTS, POINTS)
    np.testing.assert_array_equal(dense, upsample(POINTS, POINTS, model=Spread(step=0.0), ratio=2))
    with pytest.raises(ValueError, match=r"^rate: expected one of ratio, spacing, model, "):
        again.set_params(rate=2)
    with pytest.raises(ValueError, match="expected a run folder.*found no folder"):
        PointCloudUpsampler(model="nowhere").fit()


def test_an_upsampler_has_the_settings_of_the_function() -> None:
    """All but the parts of one long computation."""
    settings = inspect.signature(upsample).parameters
    own = inspect.signature(PointCloudUpsampler).parameters
    assert list(own) == [name for name in settings if name not in ("points", "normals", "parts")]
    assert all(own[name].default == settings[name].default for name in own)


SNIPPET = """
import numpy as np
import open3d
import pyvista
import torch
import trimesh
from torch_geometric.data import Data
import pnu

array, tensor, data = np.zeros((20, 3)), torch.zeros(20, 3), Data()
legacy, tensors = open3d.geometry.PointCloud(), open3d.t.geometry.PointCloud()
vertices, poly = trimesh.PointCloud(array), pyvista.PolyData(array)
upsampler = pnu.PointCloudUpsampler(ratio=2, keep=True).fit()
reveal_type(pnu.upsample(array, ratio=2.5))
reveal_type(pnu.upsample([[0.0, 0.0, 1.0]]))
reveal_type(pnu.upsample(tensor))
reveal_type(pnu.normals(legacy, up="z"))
reveal_type(upsampler.transform(tensors))
reveal_type(upsampler.fit_transform(vertices))
reveal_type(pnu.upsample(poly, normals=tensor))
reveal_type(pnu.normals(data))
pnu.upsample(array, ration=2)
pnu.upsample(array, density="evn")
"""
ARRAY = "numpy.ndarray[tuple[Any, ...], numpy.dtype[Any]]"
SEEN = [
    *(ARRAY, ARRAY, "torch._tensor.Tensor"),
    *("open3d.pybind.geometry.PointCloud", "open3d.pybind.t.geometry.PointCloud", "trimesh.points.PointCloud"),
    *("pyvista.core.pointset.PolyData", "Any"),  # the last has no types of its own
]


@pytest.mark.slow
def test_an_editor_knows_what_comes_back(tmp_path: Path) -> None:
    """As mypy sees the installed package: the kind of each result, and wrong arguments."""
    for name in ("open3d", "pyvista", "trimesh", "torch_geometric"):
        pytest.importorskip(name)
    (tmp_path / "snippet.py").write_text(SNIPPET)
    command = [sys.executable, "-m", "mypy", "--config-file=", "--no-error-summary", "--hide-error-context"]
    options = ["--ignore-missing-imports", "--python-version=3.11", "snippet.py"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run([*command, *options], cwd=tmp_path, env=environment, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith("snippet.py")]
    assert re.findall('Revealed type is "(.*)"', "\n".join(lines)) == SEEN, done.stdout
    assert {line.split(":")[1] for line in lines if "error" in line} == {"22", "23"}, done.stdout
