"""Patch files: what is cut, what is written, what is refused."""

import functools
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pnu.data import shapes
from pnu.data.patch_file import check_patch_file, cut_patch_file, cut_patches, describe, different
from pnu.geometry.mesh_sampling import closest_points, face_normals
from pnu.io import Mesh

MAKERS = {name: functools.partial(shapes.make, name) for name in ("washer", "dice")}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("patches") / "two.h5"
    cut_patch_file(path, MAKERS, 5, parameters={"source": "test"})
    return path


def test_patches_lie_on_the_surface_with_its_normals() -> None:
    mesh = shapes.make("dice")
    made = cut_patches(mesh, 3, np.random.default_rng(0))
    assert made.clouds.shape == (3, 4096, 6)
    assert made.clouds.dtype == np.float32
    for cloud in made.clouds:
        _, distance, face = closest_points(mesh, cloud[::40, :3].astype(float))
        assert distance.max() < 1e-6
        cosine = (face_normals(mesh)[face] * cloud[::40, 3:]).sum(1)
        assert np.mean(cosine > 0.999) > 0.95  # the others lie on an edge, where two faces are closest


def test_points_are_even_and_patches_connected_in_space() -> None:
    cloud = cut_patches(shapes.make("washer"), 1, np.random.default_rng(0)).clouds[0, :, :3]
    spacing = cKDTree(cloud).query(cloud, 2)[0][:, 1]
    assert spacing.std() / spacing.mean() < 0.25  # random points have 0.52
    center = cloud[np.linalg.norm(cloud - cloud.mean(0), axis=1).argmin()]
    assert np.linalg.norm(cloud - center, axis=1).max() < 1.2


def test_edges_lie_beside_the_patch() -> None:
    made = cut_patches(shapes.make("star_prism"), 4, np.random.default_rng(0))
    for cloud, edges in zip(made.clouds, made.edges, strict=True):
        edges = edges[np.isfinite(edges[:, 0])]
        assert len(edges) > 10
        assert cKDTree(cloud[:, :3]).query(edges)[0].max() < 0.05
    assert np.isnan(cut_patches(shapes.make("pillow"), 1, np.random.default_rng(0)).edges).all()


def test_file_has_the_documented_datasets(file: Path) -> None:
    with h5py.File(file) as opened:
        assert opened["poisson_4096"].shape == (5, 4096, 6)
        assert opened["poisson_4096"].dtype == np.float32
        assert [name.decode() for name in opened["name"][()]] == ["dice"] * 3 + ["washer"] * 2
        length = np.linalg.norm(opened["poisson_4096"][:, :, 3:], axis=-1)
    assert np.allclose(length, 1, atol=1e-5)
    contents = check_patch_file(file)
    assert (contents.patches, contents.points, contents.has_edges, contents.has_input) == (5, 4096, True, False)
    assert contents.parameters == {"source": "test"}


@pytest.mark.slow
def test_same_patches_with_two_processes(file: Path, tmp_path: Path) -> None:
    cut_patch_file(tmp_path / "again.h5", MAKERS, 5, processes=2)
    with h5py.File(file) as one, h5py.File(tmp_path / "again.h5") as two:
        assert np.array_equal(one["poisson_4096"][()], two["poisson_4096"][()])
        assert np.array_equal(one["edges"][()], two["edges"][()], equal_nan=True)


def test_failure_leaves_no_file(tmp_path: Path) -> None:
    def broken() -> None:
        raise ValueError("no faces")

    with pytest.raises(ValueError, match="^zebra: no faces$"):
        cut_patch_file(tmp_path / "out.h5", {"dice": MAKERS["dice"], "zebra": broken}, 2)
    assert list(tmp_path.iterdir()) == []


def test_describe(file: Path) -> None:
    figures = describe(file)
    assert (figures["patches"], figures["shapes"], figures["points"]) == (5, 2, 4096)
    assert 0.01 < figures["spacing_over_radius"] < 0.05
    assert figures["share_with_sharp_edges"] == 1
    assert figures["normals_of_length_1"] == 1
    assert -1 <= figures["coordinates_from"] < -0.4 < 0.4 < figures["coordinates_to"] <= 1
    assert figures["datasets"] == (
        "edges (5, 256, 3) float32, name (5,) text, open_edges (5,) int32, poisson_4096 (5, 4096, 6) float32"
    )
    assert figures["meshes_with_open_edges"] == "0 of 2"


def cloud(n: int = 2, points: int = 128) -> np.ndarray:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(n, points, 3))
    return np.concatenate([rng.random((n, points, 3)), normals / np.linalg.norm(normals, axis=-1, keepdims=True)], -1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, r"lacks the dataset poisson_4096 \(patches, points, 6\); it has nothing"),
        ({"montecarlo_5k": cloud()}, r"lacks the dataset poisson_4096 .* it has montecarlo_5k \(2, 128, 6\) float64"),
        ({"poisson_4096": cloud()[..., :3]}, r"must have shape .*, found \(2, 128, 3\)"),
        ({"poisson_4096": cloud(points=20)}, r"must have shape .*, found \(2, 20, 6\)"),
        ({"poisson_4096": cloud()[0]}, r"must have shape .*, found \(128, 6\)"),
        ({"poisson_4096": (9 * cloud()).astype(int)}, "must hold floating-point numbers, found int64"),
        (
            {"poisson_4096": np.where(cloud() > 0.9, np.nan, cloud())},
            r"patch 0 of poisson_4096 holds NaN or infinity \(and 1 more patches\)",
        ),
        (
            {"poisson_4096": cloud() * [1, 1, 1, 2, 2, 2]},
            "patch 0 .* no unit normals in columns 4 to 6, found lengths 2 to 2",
        ),
        (
            {"poisson_4096": cloud(), "name": [b"a"]},
            r"name must have one entry for each of the 2 patches, found \(1,\)",
        ),
        (
            {"poisson_4096": cloud(), "edges": np.full((2, 4, 3), b"x")},
            "edges must hold floating-point numbers, found |S1",
        ),
        (
            {"poisson_4096": cloud(), "montecarlo_1024": cloud(3)},
            r"montecarlo_1024 must have shape \(2, 64 or more points, 6\)",
        ),
        ({"poisson_4096": cloud(), "montecarlo_1024": cloud(points=0)}, r"64 or more points, 6\), found \(2, 0, 6\)"),
        ({"poisson_4096": cloud(), "edges": cloud()}, r"edges must have shape \(2, points, 3\)"),
    ],
)
def test_foreign_file_is_refused_with_what_it_lacks(tmp_path: Path, content: dict, message: str) -> None:
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as opened:
        for name, value in content.items():
            opened[name] = value
    with pytest.raises(ValueError, match=message) as raised:
        check_patch_file(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def with_fault(fault: str, row: int, patches: int = 70) -> np.ndarray:
    """Clouds of which one cannot be trained on."""
    clouds = cloud(patches)
    if fault == "nan":
        clouds[row, 5, 1] = np.nan
    elif fault == "infinite":
        clouds[row, 127, 2] = np.inf
    elif fault == "too large for single precision":
        clouds[row, 0, 0] = 1e39
    elif fault == "nan in a normal":
        clouds[row, 9, 4] = np.nan
    elif fault == "equal":
        clouds[row] = clouds[row, 0]
    elif fault == "few":
        clouds[row, :, :3] = clouds[row, np.arange(128) % 63, :3]
    elif fault == "no normals":
        clouds[row, :, 3:] = 0
    elif fault == "some normals":
        clouds[row, ::20, 3:] = 0
    return clouds


@pytest.mark.parametrize("name", ["poisson_4096", "montecarlo_1024"])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("nan", "holds NaN or infinity;"),
        ("infinite", "holds NaN or infinity;"),
        ("too large for single precision", "holds NaN or infinity;"),
        ("nan in a normal", "holds NaN or infinity;"),
        ("equal", "has 1 different points, 64 or more are needed;"),
        ("few", "has 63 different points, 64 or more are needed;"),
        ("no normals", "has no unit normals in columns 4 to 6, found lengths 0 to 0;"),
        ("some normals", "has no unit normals in columns 4 to 6, found lengths 0 to 1;"),
    ],
)
@pytest.mark.parametrize("row", [0, 1, 69])
def test_every_patch_is_checked_and_the_row_named(
    tmp_path: Path, name: str, fault: str, message: str, row: int
) -> None:
    """None is in a sample of every so many, and the last is beyond the first that are read at once."""
    path = tmp_path / "one.h5"
    with h5py.File(path, "w") as opened:
        opened["poisson_4096"] = cloud(70)
        if name in opened:
            del opened[name]
        opened[name] = with_fault(fault, row)
    for function in (check_patch_file, describe):
        with pytest.raises(ValueError, match=f"one.h5: patch {row} of {name} {message} mend or remove it$"):
            function(path)


@pytest.mark.parametrize("value", [[np.nan, 0, 0], [np.inf, 0, 0]])
def test_edges_are_points_or_empty(tmp_path: Path, value: list[float]) -> None:
    edges = np.full((70, 4, 3), np.nan)
    edges[:, 0] = 0.5
    with h5py.File(tmp_path / "edges.h5", "w") as opened:
        opened["poisson_4096"], opened["edges"] = cloud(70), edges
    assert check_patch_file(tmp_path / "edges.h5").has_edges
    edges[66, 1] = value
    with h5py.File(tmp_path / "edges.h5", "r+") as opened:
        opened["edges"][...] = edges
    with pytest.raises(ValueError, match=r"edges.h5: patch 66 of edges holds infinity, or NaN in a part of a row"):
        check_patch_file(tmp_path / "edges.h5")


def test_different_points_are_counted() -> None:
    points = np.random.default_rng(0).normal(size=(3, 4096, 3)).astype(np.float32)
    points[1, 100:] = points[1, :1]
    points[2] = np.where(np.arange(4096)[:, None] % 2, 0.0, -0.0)
    expected = [len(np.unique(cloud, axis=0)) for cloud in points]
    assert expected == [4096, 100, 1]
    assert different(points).tolist() == expected


def test_a_file_is_read_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "two.h5"
    with h5py.File(path, "w") as opened:
        opened["poisson_4096"] = cloud()
    assert check_patch_file(path) is check_patch_file(path)
    with h5py.File(path, "r+") as opened:
        opened["poisson_4096"][1, 3] = np.nan
    os.utime(path, ns=(1, 1))
    with pytest.raises(ValueError, match="patch 1"):
        check_patch_file(path)


def test_meshes_with_open_edges_are_counted_in_the_file(tmp_path: Path) -> None:
    def opened_dice() -> Mesh:
        mesh = shapes.make("dice")
        return Mesh(mesh.vertices, mesh.faces[1:])

    cut_patch_file(tmp_path / "three.h5", {**MAKERS, "hole": opened_dice}, 4)
    assert check_patch_file(tmp_path / "three.h5").open_edges == {"dice": 0, "hole": 3, "washer": 0}
    assert describe(tmp_path / "three.h5")["meshes_with_open_edges"] == "1 of 3: hole (3)"


def test_no_file_and_no_hdf5(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        check_patch_file(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("not a file of patches")
    with pytest.raises(ValueError, match="expected an HDF5 file of patches"):
        check_patch_file(tmp_path / "text.h5")


def test_damaged_and_forged_files_are_refused(file: Path, tmp_path: Path) -> None:
    short = tmp_path / "short.h5"
    short.write_bytes(file.read_bytes()[:-100_000])
    with pytest.raises(ValueError, match=r"short.h5: expected an HDF5 file of patches, found .* a damaged file"):
        check_patch_file(short)
    with h5py.File(tmp_path / "forged.h5", "w") as opened:  # a terabyte, none of it written
        opened.create_dataset("poisson_4096", (10, 2**32, 6), "f4", chunks=(1, 4096, 6))
    with pytest.raises(ValueError, match=r"poisson_4096 claims the shape \(10, 4294967296, 6\), more than the file"):
        check_patch_file(tmp_path / "forged.h5")
    with h5py.File(tmp_path / "names.h5", "w") as opened:
        opened["poisson_4096"] = cloud()
        opened.create_dataset("name", (10**12,), h5py.string_dtype(), chunks=(1000,))
    with pytest.raises(ValueError, match="name claims the shape"):
        check_patch_file(tmp_path / "names.h5")


@pytest.mark.parametrize("value", ["no JSON", "[1, 2]", 5])
def test_foreign_parameters_do_no_harm(tmp_path: Path, value: object) -> None:
    with h5py.File(tmp_path / "foreign.h5", "w") as opened:
        opened["poisson_4096"] = cloud()
        opened.attrs["parameters"] = value
    assert check_patch_file(tmp_path / "foreign.h5").parameters == {}


def test_too_few_patches() -> None:
    with pytest.raises(ValueError, match="at least one for each of the 2 shapes, found 1"):
        cut_patch_file("never.h5", MAKERS, 1)
