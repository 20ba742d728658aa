"""`pnu prepare`: cuts patches, describes files, refuses in one line."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from pnu.commands.prepare import main
from pnu.data import shapes
from pnu.data.patch_file import check_patch_file
from pnu.data.patch_module import PatchDataModule
from pnu.io import Mesh, write_mesh
from tests.refusals import refused


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two meshes of two formats, one in a subfolder."""
    (tmp_path / "meshes/sub").mkdir(parents=True)
    write_mesh(tmp_path / "meshes/washer.off", shapes.make("washer"))
    write_mesh(tmp_path / "meshes/sub/dice.stl", shapes.make("dice"))
    return tmp_path


def prepare(folder: Path, *overrides: str) -> None:
    main(
        [
            "data=meshes",
            f"data.root={folder / 'meshes'}",
            "data.patches=2",
            f"data.cache={folder / 'cache'}",
            *overrides,
        ]
    )


def test_meshes_become_a_file_that_training_takes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prepare(folder, "quiet=true", f"output={folder / 'mine/patches.h5'}")
    assert capsys.readouterr().out.strip() == str(folder / "mine/patches.h5")
    contents = check_patch_file(folder / "mine/patches.h5")
    assert contents.names == ["sub_dice", "washer"]
    (cached,) = (folder / "cache").iterdir()
    assert cached.read_bytes() == (folder / "mine/patches.h5").read_bytes()


def test_describe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(2, 128, 3))
    cloud = np.concatenate(
        [rng.uniform(-2, 3, (2, 128, 3)), normals / np.linalg.norm(normals, axis=-1, keepdims=True)], -1
    )
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["poisson_4096"] = cloud.astype(np.float32)
    main([f"describe={tmp_path / 'foreign.h5'}"])
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["datasets"] == "poisson_4096 (2, 128, 6) float32"
    assert (lines["patches"], lines["points"], lines["shapes"]) == ("2", "128", "-")
    assert float(lines["coordinates_from"]) == pytest.approx(cloud[..., :3].min(), rel=1e-3)
    assert lines["normals_of_length_1"] == "1"
    assert lines["no"] == "training: a patch needs 256 points or more, these have 128"


def patches(path: Path, number: int, points: int = 4096, shapes: int = 20) -> Path:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(number, points, 3))
    ball /= np.linalg.norm(ball, axis=-1, keepdims=True)
    with h5py.File(path, "w") as file:
        file["poisson_4096"] = np.concatenate([ball, ball], -1).astype(np.float32)
        file["name"] = np.array([f"ball_{i % shapes}" for i in range(number)], dtype=h5py.string_dtype())
    return path


@pytest.mark.parametrize(
    ("made", "options"),
    [
        ((40,), ""),
        ((12,), " data.batch_size=10"),
        ((40, 256), " data.input_points=64 data.target_points=256"),
        ((6, 300), " data.input_points=75 data.target_points=300 data.batch_size=4"),
    ],
)
def test_the_next_line_is_a_training_that_the_file_is_fit_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], made: tuple[int, ...], options: str
) -> None:
    path = patches(tmp_path / "patches.h5", *made)
    main([f"describe={path}"])
    line = capsys.readouterr().out.splitlines()[-1]
    assert line == f"next: pnu train data=patches data.path={path}{options}"
    arguments = dict(word.removeprefix("data.").split("=") for word in line.split()[4:])
    numbers = {name: int(value) for name, value in arguments.items() if value.isdigit()}
    PatchDataModule(str(path), **numbers).setup()  # type: ignore[arg-type]


def test_no_training_for_what_cannot_be_split(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([f"describe={patches(tmp_path / 'patches.h5', 4, 256, shapes=2)}"])
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("no training: data: 2 shapes cannot be split")


@pytest.mark.parametrize("quiet", ["false", "true"])
def test_a_file_with_one_bad_patch_is_not_recommended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], quiet: str
) -> None:
    path = patches(tmp_path / "patches.h5", 40, 256)
    with h5py.File(path, "r+") as file:
        file["poisson_4096"][33, 7, 2] = np.nan
    message = refused(capsys, main, [f"describe={path}", f"quiet={quiet}"])
    assert f"{path}: patch 33 of poisson_4096 holds NaN or infinity" in message


@pytest.mark.slow
def test_meshes_with_open_edges_are_counted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dice = shapes.make("dice")
    write_mesh(folder / "meshes/open.off", Mesh(dice.vertices, dice.faces[1:]))
    prepare(folder, "data.patches=3")
    output = capsys.readouterr()
    assert "1 of 3: open (3)" in output.err
    for _ in (0, 1):  # from the file that is there, too
        (line,) = (line for line in output.out.splitlines() if line.startswith("meshes_with_open_edges"))
        assert line.split(maxsplit=1)[1] == "1 of 3: open (3)"
        prepare(folder, "data.patches=3")
        output = capsys.readouterr()
        assert not output.err


def test_refusals(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache = f"data.cache={folder / 'cache'}"
    assert "none.h5: no such file" in refused(capsys, main, [f"describe={folder / 'none.h5'}"])
    assert "data.root=FOLDER is required" in refused(capsys, main, ["data=meshes", cache])
    assert "data.path=FILE is required" in refused(capsys, main, ["data=patches"])
    assert "expected organic or cad, found 'metal'" in refused(capsys, main, ["data.kinds=[metal]", cache])
    assert "data.patchs" in refused(capsys, main, ["data.patchs=3"])
    (folder / "meshes/broken.obj").write_text("v 0 0 0\n")
    mesh = [f"data.root={folder / 'meshes'}", "data.patches=3", "quiet=true"]
    assert "broken" in refused(capsys, main, ["data=meshes", cache, *mesh])
    assert not list((folder / "cache").glob("*"))


def test_output_with_a_wrong_suffix(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        prepare(folder, "quiet=true", f"output={folder / 'patches.ply'}")
    assert "expected a name that ends with .h5" in capsys.readouterr().err
    assert not (folder / "cache").exists(), "it is said after the work"
