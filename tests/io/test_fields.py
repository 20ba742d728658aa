"""Names that files give to a point's values are known in one place."""

import numpy as np
import pytest

from pnu.io import read_cloud
from pnu.io.fields import arranged

N = 20
VALUES = np.random.default_rng(0).random((N, 9))


@pytest.mark.parametrize(
    "names",
    [
        "x y z nx ny nz red green blue",
        "X Y Z NX NY NZ R G B",
        "x y z normal_x normal_y normal_z diffuse_red diffuse_green diffuse_blue",
        "Points:0 Points:1 Points:2 Normals:0 Normals:1 Normals:2 Rf Gf Bf",
        "Easting Northing Height Normal_X Normal_Y Normal_Z Color_R Color_G Color_B",
    ],
)
def test_spellings(names: str) -> None:
    found = arranged(dict(zip(names.split(), VALUES.T, strict=True)))
    np.testing.assert_array_equal(found.points, VALUES[:, :3])
    np.testing.assert_array_equal(found.normals, VALUES[:, 3:6])
    np.testing.assert_array_equal(found.colors, np.rint(255 * VALUES[:, 6:]))
    assert found.others == {}
    assert found.notes == ()


def test_a_second_set_of_normals_is_left_out_and_said() -> None:
    names = "x y z nx ny nz normal_x normal_y normal_z"
    found = arranged(dict(zip(names.split(), VALUES.T, strict=True)))
    np.testing.assert_array_equal(found.normals, VALUES[:, 3:6])
    assert found.others == {}
    assert found.notes == ("normal_x normal_y normal_z left out: a second set of normals",)


def test_degrees_are_said() -> None:
    found = arranged(dict(zip(("Longitude", "Latitude", "Altitude"), VALUES.T, strict=False)))
    np.testing.assert_array_equal(found.points, VALUES[:, :3])
    assert "degrees" in found.notes[0]
    assert "project" in found.notes[0]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.array([0, 257, 65535], np.uint16), [0, 1, 255]),
        (np.array([0, 1, 255], np.uint16), [0, 1, 255]),
        (np.array([0, 1, 1], np.int32), [0, 1, 1]),
        (np.array([0, 0.2, 1]), [0, 51, 255]),
        (np.array([0, 51, 255.0]), [0, 51, 255]),
        (np.array([np.nan, -1, 257]), [0, 0, 1]),
    ],
)
def test_colors_of_all_ranges(values: np.ndarray, expected: list[int]) -> None:
    columns = dict(zip(("x", "y", "z"), VALUES[:3].T, strict=False)) | dict.fromkeys(("r", "g", "b"), values)
    colors = arranged(columns).colors
    assert colors is not None
    assert colors.dtype == np.uint8
    assert colors[:, 0].tolist() == expected


def test_alpha_and_scalars_stay() -> None:
    names = "x y z red green blue alpha quality label"
    found = arranged(dict(zip(names.split(), VALUES.T, strict=True)))
    assert found.colors is not None
    assert found.colors.shape == (N, 4)
    assert found.others.keys() == {"quality", "label"}


def test_ply_and_pcd_know_the_same_names(tmp_path) -> None:
    rows = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in VALUES)
    names = ["X", "Y", "Z", "normal_x", "normal_y", "normal_z", "r", "g", "b"]
    header = "\n".join(f"property float {name}" for name in names)
    (tmp_path / "c.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex {N}\n{header}\nend_header\n{rows}\n")
    header = f"FIELDS {' '.join(names)}\nSIZE{' 4' * 9}\nTYPE{' F' * 9}\nCOUNT{' 1' * 9}\nPOINTS {N}\nDATA ascii\n"
    (tmp_path / "c.pcd").write_text(header + rows + "\n")
    for suffix in ("ply", "pcd"):
        cloud = read_cloud(tmp_path / f"c.{suffix}")
        np.testing.assert_allclose(cloud.points, VALUES[:, :3], atol=1e-6)
        assert cloud.normals is not None
        assert cloud.attributes.keys() == {"colors"}
