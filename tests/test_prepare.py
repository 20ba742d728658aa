"""`python -m pnu.prepare`: cuts patches, describes files, refuses in one line."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from pnu.data import shapes
from pnu.data.patchset import check
from pnu.io import write_mesh
from pnu.prepare import main
from tests.commands import refused


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
    contents = check(folder / "mine/patches.h5")
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
    assert lines["next:"] == f"python -m pnu.train data=patches data.path={tmp_path / 'foreign.h5'}"


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
