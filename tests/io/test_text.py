"""Text and arrays as programs and people write them: by names, by the usual order, or by columns=."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pnu.io import Cloud, read_cloud

N = 24
RNG = np.random.default_rng(0)
XYZ = np.round(RNG.normal(size=(N, 3)), 6)
NORMALS = np.round(XYZ / np.linalg.norm(XYZ, axis=1, keepdims=True), 6)
RGB = RNG.integers(0, 256, (N, 3))
INTENSITY = RNG.integers(300, 2000, (N, 1))


def lines(*blocks: np.ndarray, separator: str = " ") -> str:
    return "\n".join(separator.join(f"{value:.9g}" for value in row) for row in np.hstack(blocks)) + "\n"


def read(tmp_path: Path, name: str, content: str | bytes, **options: object) -> Cloud:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_cloud(path, **options)  # type: ignore[arg-type]


def check(cloud: Cloud, *, normals: bool = False, colors: bool = False, intensity: bool = False) -> None:
    np.testing.assert_allclose(cloud.points, XYZ, atol=1e-9)
    assert (cloud.normals is not None) == normals
    if normals:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=2e-6)
    assert ("colors" in cloud.attributes) == colors
    if colors:
        np.testing.assert_array_equal(cloud.attributes["colors"][:, :3], RGB)
    assert ("intensity" in cloud.attributes) == intensity
    if intensity:
        np.testing.assert_array_equal(cloud.attributes["intensity"], INTENSITY[:, 0])
    assert len(cloud.attributes) == colors + intensity


PLAIN = lines(XYZ)
WRITTEN: dict[str, tuple[str, str | bytes]] = {
    "byte order mark": ("c.xyz", b"\xef\xbb\xbf" + PLAIN.encode()),
    "utf-16": ("c.txt", PLAIN.encode("utf-16")),
    "utf-16 without a mark": ("c.txt", PLAIN.encode("utf-16-le")),
    "utf-16 big endian": ("c.txt", PLAIN.encode("utf-16-be")),
    "count": ("c.txt", f"{N}\n{PLAIN}"),
    "names": ("c.txt", f"x y z\n{PLAIN}"),
    "names and count": ("c.txt", f"X Y Z\n{N}\n{PLAIN}"),
    "comments": ("c.asc", f"# by hand\n// X Y Z\n% 3\n{PLAIN}# end\n"),
    "commas": ("c.csv", lines(XYZ, separator=",")),
    "comma at the end": ("c.csv", lines(XYZ, separator=",").replace("\n", ",\n")),
    "quotes": ("c.csv", '"x","y","z"\n' + lines(XYZ, separator='","').replace("\n", '"\n"')[:-1].join(['"', ""])),
    "semicolons": ("c.csv", lines(XYZ, separator=";")),
    "tabs": ("c.tsv", "X\tY\tZ\n" + lines(XYZ, separator="\t")),
    "old line ends": ("c.pts", PLAIN.replace("\n", "\r")),
    "decimal commas": ("c.txt", lines(XYZ, separator=";").replace(".", ",")),
    "decimal commas and blanks": ("c.txt", PLAIN.replace(".", ",")),
    "decimal commas and names": ("c.csv", "x;y;z\n" + lines(XYZ, separator=";").replace(".", ",")),
    "units": ("c.csv", "X [m],Y [m],Z (m)\n" + lines(XYZ, separator=",")),
    "row numbers": ("c.txt", lines(np.arange(N)[:, None], XYZ)),
    "a column of words": ("c.csv", "x,y,z,what\n" + lines(XYZ, separator=",").replace("\n", ",tree\n")),
    "several scans": ("c.pts", f"{N - 5}\n{lines(XYZ[:-5])}5\n{lines(XYZ[-5:])}"),
}


@pytest.mark.parametrize("case", WRITTEN)
def test_spellings_of_three_columns(tmp_path: Path, case: str) -> None:
    check(read(tmp_path, *WRITTEN[case]))


ALPHA = np.full((N, 1), 255)
SMALL = RNG.integers(0, 256, (N, 1))
ORDERED: dict[str, tuple[str, str, dict[str, bool]]] = {
    "x y z i": ("c.txt", lines(XYZ, INTENSITY), {"intensity": True}),
    "x y z n": ("c.xyzn", lines(XYZ, NORMALS), {"normals": True}),
    "x y z n of any length": ("c.xyz", lines(XYZ, NORMALS * RNG.uniform(1e-4, 2e-4, (N, 1))), {"normals": True}),
    "x y z c": ("c.txt", lines(XYZ, RGB), {"colors": True}),
    "x y z c in 0..1": ("c.xyzrgb", lines(XYZ, RGB / 255), {"colors": True}),
    "x y z c of 16 bits": ("c.txt", lines(XYZ, RGB * 257), {"colors": True}),
    "x y z i c": ("c.pts", lines(XYZ, INTENSITY, RGB), {"colors": True, "intensity": True}),
    "x y z c i": ("c.txt", lines(XYZ, RGB, INTENSITY), {"colors": True, "intensity": True}),
    "x y z c a": ("c.xyz", lines(XYZ, RGB, ALPHA), {"colors": True}),
    "x y z c n": ("c.txt", lines(XYZ, RGB, NORMALS), {"colors": True, "normals": True}),
    "x y z n c": ("c.txt", lines(XYZ, NORMALS, RGB), {"colors": True, "normals": True}),
    "x y z c a n": ("c.txt", lines(XYZ, RGB, ALPHA, NORMALS), {"colors": True, "normals": True}),
    "x y z c i n": ("c.asc", lines(XYZ, RGB, INTENSITY, NORMALS), {"colors": True, "normals": True, "intensity": True}),
    "names, any order": (
        "c.csv",
        "B,Intensity,Y,nx,R,X,G,ny,nz,Z\n"
        + lines(RGB[:, 2:], INTENSITY, XYZ[:, 1:2], NORMALS[:, :1], RGB[:, :1], XYZ[:, :1], RGB[:, 1:2], NORMALS[:, 1:],
                XYZ[:, 2:], separator=","),
        {"colors": True, "normals": True},
    ),
    "names in a comment": ("c.asc", "//X Y Z Rf Gf Bf Nx Ny Nz\n" + lines(XYZ, RGB / 255, NORMALS),
                           {"colors": True, "normals": True}),
    "points, then normals": ("c.pwn", f"{N}\n{lines(XYZ)}{lines(NORMALS)}", {"normals": True}),
}  # fmt: skip


@pytest.mark.parametrize("case", ORDERED)
def test_usual_orders(tmp_path: Path, case: str) -> None:
    name, content, found = ORDERED[case]
    cloud = read(tmp_path, name, content)
    if case == "names, any order":
        np.testing.assert_array_equal(cloud.attributes.pop("Intensity"), INTENSITY[:, 0])
    check(cloud, **found)


@pytest.mark.parametrize(("suffix", "first"), [("pts", "intensity"), ("txt", "red")])
def test_what_may_be_either_is_said_with_the_line_to_type(tmp_path: Path, suffix: str, first: str) -> None:
    """Four columns of whole numbers up to 255: i r g b, or r g b i."""
    order = (SMALL, RGB) if first == "intensity" else (RGB, SMALL)
    cloud = read(tmp_path, f"c.{suffix}", lines(XYZ, *order))
    np.testing.assert_array_equal(cloud.attributes["colors"], RGB)
    np.testing.assert_array_equal(cloud.attributes["intensity"], SMALL[:, 0])
    other = "x,y,z,r,g,b,i" if first == "intensity" else "x,y,z,i,r,g,b"
    (note,) = cloud.notes
    assert note.endswith(f"if they are not: columns={other}")
    typed = read_cloud(tmp_path / f"c.{suffix}", columns=other)
    assert typed.notes == ()
    np.testing.assert_array_equal(typed.attributes["intensity"], order[0][:, 0] if first == "red" else RGB[:, 2])


def test_columns_are_taken_as_they_are_given(tmp_path: Path) -> None:
    cloud = read(tmp_path, "c.txt", "a b c d e f g\n" + lines(XYZ, INTENSITY, RGB), columns="x,y,z,_,r,g,b")
    check(cloud, colors=True)
    assert cloud.notes == ()
    check(read(tmp_path, "c.txt", lines(INTENSITY, XYZ[:, ::-1]), columns=["i", "z", "y", "x"]), intensity=True)
    np.save(tmp_path / "c.npy", np.hstack([INTENSITY, XYZ]))
    check(read_cloud(tmp_path / "c.npy", columns="_,x,y,z"))
    for columns, message in {
        "x,y,z": r"columns=x,y,z are 3 names, line 1 has 4 columns; leave one out with _",
        "x,y,i,_": "columns=x,y,i,_: expected x, y and z among the names",
        "x,y,z,X": "expected x, y and z among the names, each once",
    }.items():
        with pytest.raises(ValueError, match=message):
            read_cloud(tmp_path / "c.txt", columns=columns)
    with pytest.raises(ValueError, match=r"c.ply: has names for what it holds; columns= is for text"):
        read(tmp_path, "c.ply", "ply\n", columns="x,y,z")


def test_what_was_taken_for_what_is_said(tmp_path: Path) -> None:
    said = {
        lines(XYZ, INTENSITY): "columns taken as x y z intensity; columns=x,y,z,... says otherwise",
        lines(
            XYZ, INTENSITY, 2.5 * INTENSITY
        ): "columns taken as x y z column_4 column_5; columns=x,y,z,... says otherwise",
        lines(XYZ, separator=";").replace(".", ","): "commas are read as decimal points",
        lines(np.arange(N)[:, None], XYZ): "column 1 counts the points: left out",
        f"{N - 2}\n{PLAIN}": f"a line promises {N - 2} points, {N} follow: all are read",
        "x y z what\n" + PLAIN.replace("\n", " tree\n"): "left out, no numbers: what",
        f"scan of 2020\n{PLAIN}": "line left out: scan of 2020",
        lines(XYZ, -3 * NORMALS): "normals have lengths 3 to 3: their directions are taken",
    }
    for content, note in said.items():
        assert read(tmp_path, "c.txt", content).notes == (note,)
    for quiet in (PLAIN, lines(XYZ, NORMALS), "x y z i\n" + lines(XYZ, INTENSITY)):
        assert read(tmp_path, "c.txt", quiet).notes == ()


def test_empty_fields_are_nan(tmp_path: Path) -> None:
    rows = lines(XYZ, INTENSITY, separator=",").splitlines()
    rows[3] = ",".join([*rows[3].split(",")[:3], ""])
    rows[5] = ",".join(["", *rows[5].split(",")[1:]])
    cloud = read(tmp_path, "c.csv", "x,y,z,i\n" + "\n".join(rows))
    np.testing.assert_allclose(cloud.points, np.delete(XYZ, 5, 0))
    assert np.isnan(cloud.attributes["intensity"][3])
    assert cloud.notes == (f"1 of {N} points left out: NaN, infinite or beyond 1e+30",)


def test_ptx(tmp_path: Path) -> None:
    """Two scans, moved to their places; a pixel that saw nothing is 0 0 0."""

    def scan(points: np.ndarray, place: str) -> str:
        head = f"{len(points)}\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n{place}"
        return head + lines(points, np.full((len(points), 1), 0.5), np.zeros((len(points), 3)))

    turned = "0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n"
    second = np.vstack([XYZ[10:], np.zeros((2, 3))])
    cloud = read(tmp_path, "c.ptx", scan(XYZ[:10], "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n") + scan(second, turned))
    x, y, z = XYZ[10:].T
    np.testing.assert_allclose(cloud.points, np.vstack([XYZ[:10], np.stack([10 - y, 20 + x, 30 + z], 1)]))
    assert cloud.attributes.keys() == {"intensity", "colors", "scan", "sensor_x", "sensor_y", "sensor_z"}
    np.testing.assert_array_equal(cloud.attributes["scan"], np.repeat([0, 1], [10, N - 10]))
    sensors = np.stack([cloud.attributes[f"sensor_{axis}"] for axis in "xyz"], 1)
    np.testing.assert_array_equal(sensors, np.repeat([[np.nan] * 3, [10.0, 20, 30]], [10, N - 10], axis=0))
    assert cloud.notes == (f"2 of {N + 2} points left out: no return", "2 scans, each moved to its place")


def test_ptx_of_points_that_lie_where_they_belong(tmp_path: Path) -> None:
    """No matrix moves them; the scanner's place is in the first of its lines."""
    head = f"{N}\n1\n4 5 6\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    cloud = read(tmp_path, "c.ptx", head + lines(XYZ, np.full((N, 1), 0.5)))
    np.testing.assert_allclose(cloud.points, XYZ)
    assert cloud.attributes.keys() == {"intensity", "sensor_x", "sensor_y", "sensor_z"}
    assert [set(cloud.attributes[f"sensor_{axis}"]) for axis in "xyz"] == [{4}, {5}, {6}]


STRUCTURED = np.zeros((4, 6), [("xyz", "<f8", 3), ("Normal", "<f4", 3), ("rgb", "u1", 3), ("label", "<i4")])
STRUCTURED["xyz"], STRUCTURED["Normal"], STRUCTURED["rgb"] = (block.reshape(4, 6, 3) for block in (XYZ, NORMALS, RGB))
FLAT = np.zeros(N, [("X", "<f8"), ("Y", "<f8"), ("Z", "<f8"), ("intensity", "<i4")])
FLAT["X"], FLAT["Y"], FLAT["Z"], FLAT["intensity"] = *XYZ.T, INTENSITY[:, 0]
ARRAYS: dict[str, tuple[Callable[[Path], None], dict[str, bool], str]] = {
    "map.npy": (lambda path: np.save(path, XYZ.reshape(4, 6, 3)), {}, "a map of 4 x 6 points, taken as a cloud"),
    "colors.npy": (lambda path: np.save(path, np.hstack([XYZ, RGB])), {"colors": True}, ""),
    "structured.npy": (lambda path: np.save(path, FLAT), {"intensity": True}, ""),
    "one.npz": (lambda path: np.savez(path, scan=np.hstack([XYZ, NORMALS])), {"normals": True}, ""),
    "several.npz": (
        lambda path: np.savez_compressed(path, points=XYZ, normals=NORMALS, colors=RGB, other=np.zeros((9, 3))),
        {"normals": True, "colors": True},
        "array 'points' of points, normals, colors, other",
    ),
    "columns.npz": (lambda path: np.savez(path, x=XYZ[:, 0], y=XYZ[:, 1], z=XYZ[:, 2]), {}, ""),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays(tmp_path: Path, name: str) -> None:
    write, found, note = ARRAYS[name]
    write(tmp_path / name)
    cloud = read_cloud(tmp_path / name)
    check(cloud, **found)
    assert cloud.notes == ((note,) if note else ())


def test_structured_arrays_with_blocks(tmp_path: Path) -> None:
    np.save(tmp_path / "c.npy", STRUCTURED)
    cloud = read_cloud(tmp_path / "c.npy")
    assert cloud.attributes.pop("label").shape == (N,)
    check(cloud, normals=True, colors=True)


def test_an_archive_of_several_clouds_is_refused_with_their_names(tmp_path: Path) -> None:
    np.savez(tmp_path / "c.npz", first=XYZ, second=NORMALS)
    with pytest.raises(ValueError, match=r"expected an array 'points', or a single one .*found first \(24, 3\)"):
        read_cloud(tmp_path / "c.npz")
