"""Bad files: each is refused in one line that names it, what was expected and what was found."""

import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest

from pnu.io import OUTPUT_SUFFIXES, atomic_path, check_output, read_cloud, read_mesh, write_cloud
from tests.io.test_io import ply_binary, ply_text

Array = np.ndarray


@pytest.fixture
def cloud() -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(40, 3))
    return rng.normal(size=(40, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


TEXT_PLY = b"ply\nformat ascii 1.0\n"
XYZ_PCD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
ROWS = "\n".join(f"{i} {i % 4} {i % 5}" for i in range(20))
BAD_CLOUDS = {
    "empty.xyz": (b"", "the file is empty; expected a point cloud"),
    "suffix.foo": (b"1", r"suffix '.foo' is not a format of a point cloud; use one of .asc .csv .e57 .glb"),
    "plain": (b"1", "plain: has no suffix; use one of .asc .csv"),
    "words.xyz": (ROWS.replace("7 3 2", "seven 3 2").encode(), "line 8: expected numbers, found 'seven'"),
    "names.txt": (f"a b c\n{ROWS}".encode(), r"expected points with x y z, found a b c; say .*columns=x,y,z"),
    "ragged.xyz": (f"{ROWS}\n1 2".encode(), "line 21 has 2 columns, those before have 3"),
    "two.xyz": (b"1 2\n" * 20, "has 2 columns; expected x y z"),
    "six.xyz": (b"1 2 3 4.5 500 6\n" * 20, r"neither unit normals nor colors.*say which they are: columns=x,y,z,nx,"),
    "names.csv": (b"x,y,z,i\n" + b"1,2,3,4,5\n" * 20, "has 4 names of columns, line 2 has 5 columns; say them"),
    "counted.pts": (f"30\n{ROWS}".encode(), "promises 30 points, holds 20; it is cut off"),
    "commas.csv": (b"1,05,-2,50,3,75\n" * 20, "line 1: commas stand between numbers and within them; write decimal"),
    "cut.ptx": (b"5\n4\n" + b"0 0 0\n" * 4 + b"1 0 0 0\n" * 4 + b"1 2 3 0.5\n" * 19, "promises 20 points, holds 19"),
    "endless.ptx": (b"99999999999999999999\n1\n" + b"0 0 0\n" * 4 + b"1 0 0 0\n" * 4, "promises 99999999999999999999"),
    "words.ptx": (b"1\n1\na b c\n" + b"0 0 0\n" * 3 + b"1 0 0 0\n" * 4 + b"1 2 3 0.5\n", "expected ptx: two counts"),
    "pts.ptx": (ROWS.encode(), "expected ptx: two counts"),
    "text.npz": (b"PK\x03\x04" + bytes(99), "is no npz file of numbers"),
    "comments.xyz": (b"# nothing\n" * 20, "holds no numbers"),
    "binary.xyz": (bytes(range(256)), "holds binary data; expected text, as the suffix '.xyz' says"),
    "nan.xyz": (re.sub("(?m) .$", " nan", ROWS).encode(), "20 of 20 points left out: NaN, .* 16 others are needed"),
    "huge.xyz": (re.sub("(?m) .$", " 1e200", ROWS).encode(), "20 of 20 points left out: .* beyond 1e\\+30"),
    "few.xyz": (b"1 2 3\n4 5 6\n", "holds 2 points; at least 16 are needed"),
    "equal.xyz": (b"1e6 2 3\n" * 20, "all 20 points are equal; expected points on a surface"),
    "twice.xyz": (b"1e6 2 3\n7 8 9\n" * 20, "holds 2 different points; at least 16 are needed"),
    "none.ply": (b"hello", "expected a ply header from 'ply' to 'end_header', found none"),
    "format.ply": (b"ply\nelement vertex 1\nend_header\n", "the ply header has no format line"),
    "line.ply": (TEXT_PLY + b"element vertex many\nend_header\n", "'element vertex many' is no line of a ply header"),
    "type.ply": (TEXT_PLY + b"element vertex 1\nproperty text x\nend_header\n", "'property text x' is no line"),
    "cut.ply": (ply_binary("<")[:-30], "header promises 20 of element 'vertex', the file holds 1[89]; it is cut off"),
    "cut_text.ply": (ply_text()[:-60], "the header promises 20 of element 'vertex', the file holds 1[0-9]"),
    "billion.ply": (ply_binary("<").replace(b"vertex 20", b"vertex 2000000000"), "promises 2000000000 of"),
    "billion_text.ply": (ply_text().replace(b"vertex 20", b"vertex 2000000000"), "promises 2000000000 of"),
    "endless.ply": (ply_text().replace(b"vertex 20", b"vertex 99999999999999999999"), "promises 99999999999999999999"),
    "xy.ply": (ply_binary("<").replace(b"float64 z", b"float64 w"), "points with x y z, found x y w red label"),
    "empty.ply": (TEXT_PLY + b"end_header\n", "expected points with x y z, found none"),
    "none.pcd": (b"\x00" * 50, "expected a pcd header up to a DATA line"),
    "fields.pcd": (b"FIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 2\nDATA binary\n", "COUNT and POINTS .* disagree"),
    "count.pcd": (XYZ_PCD + b"COUNT 1 1 4294967297\nPOINTS 1\nDATA binary\n", "POINTS .* disagree"),
    "lacks.pcd": (XYZ_PCD + b"DATA binary\n", "the pcd header lacks POINTS"),
    "billion.pcd": (XYZ_PCD + b"POINTS 1000000000\nDATA binary\n", "promises 12000000000 bytes"),
    "bomb.pcd": (
        XYZ_PCD + b"POINTS 1000000000\nDATA binary_compressed\n"
        + struct.pack("<II", 10, 12_000_000_000 % 2**32),
        "the header promises 12000000000 bytes",
    ),
    "damaged.pcd": (
        XYZ_PCD + b"POINTS 20\nDATA binary_compressed\n"
        + struct.pack("<II", 9, 240) + b"\xff" * 9,
        "the compressed points are damaged",
    ),
    "array.npy": (b"\x93NUMPY\x01\x00", "is no npy file of numbers"),
    "pickle.npy": (b"\x80\x04\x95", "is no npy file of numbers"),
    "words.obj": (b"v 1 2 x\n", "line 1: expected numbers, found 'x'"),
    "none.obj": (b"# nothing\n", "holds 0 points; at least 16 are needed"),
    "none.off": (b"COFFEE\n", "expected the numbers of vertices and faces, found 'EE'"),
    "other.off": (b"solid x\n", "expected 'OFF' in the first line, found 'solid x'"),
    "long.off": (b"OFF\n16 0 0\n" + b"1 2 3\n" * 20, "goes on after the last face, with 4 lines more"),
    "long.pcd": (XYZ_PCD + b"POINTS 16\nDATA ascii\n" + ROWS.encode(), "after the last point, with 4 lines more"),
    "long_binary.pcd": (XYZ_PCD + b"POINTS 16\nDATA binary\n" + b"abc4" * 60, " the last point, with 48 bytes more"),
    "short.off": (b"OFF\n100 0 0\n1 2 3\n", "promises 100 vertices and 0 faces, the file holds 1 lines more"),
}  # fmt: skip


def one_line(error: pytest.ExceptionInfo[ValueError], name: str) -> None:
    text = str(error.value)
    assert "\n" not in text
    assert name in text


@pytest.mark.parametrize("name", BAD_CLOUDS)
def test_bad_cloud(tmp_path: Path, name: str) -> None:
    content, message = BAD_CLOUDS[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        read_cloud(tmp_path / name)
    one_line(error, name)


def test_no_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"c.ply: no such file; give the path of a point cloud"):
        read_cloud(tmp_path / "c.ply")
    (tmp_path / "f.ply").mkdir()
    with pytest.raises(ValueError, match=r"f.ply: is a folder; give the file of a point cloud"):
        read_cloud(tmp_path / "f.ply")
    with pytest.raises(ValueError, match=r"m.off: no such file; give the path of a mesh"):
        read_mesh(tmp_path / "m.off")


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.zeros((20, 2)), r"found float64 \(20, 2\)"),
        (np.zeros(20), r"found float64 \(20,\)"),
        (np.array([["a"] * 3] * 20), r"expected an array \(n, 3\), .* of numbers, found <U1"),
        (np.zeros((20, 3), complex), "found complex128"),
    ],
)
def test_npy_of_something_else(tmp_path: Path, values: Array, found: str) -> None:
    np.save(tmp_path / "c.npy", values)
    with pytest.raises(ValueError, match=found) as error:
        read_cloud(tmp_path / "c.npy")
    one_line(error, "c.npy")


def test_npy_runs_no_code_and_believes_no_header(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "trapped"),)

    np.save(tmp_path / "c.npy", np.array([Trap()], object), allow_pickle=True)
    with pytest.raises(ValueError, match="no npy file of numbers"):
        read_cloud(tmp_path / "c.npy")
    assert not (tmp_path / "trapped").exists()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)}
    with (tmp_path / "big.npy").open("wb") as handle:
        np.lib.format.write_array_header_1_0(handle, header)
        handle.write(b"\0" * 100)
    with pytest.raises(ValueError, match="no npy file of numbers"):
        read_cloud(tmp_path / "big.npy")


BAD_MESHES = {
    "cloud.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "expected a mesh, found 3 vertices and no faces"),
    "cloud.off": (b"OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "expected a mesh, found 3 vertices and no faces"),
    "corner.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a face has corner 8, there are 3 vertices"),
    "corner.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "'3 0 1' is no face"),
    "face.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 a\n", "'f 1 2 a' is no face"),
    "nan.obj": (b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1 of 3 vertices hold NaN"),
    "cut.stl": (b"stl".ljust(80) + b"\x02\0\0\0" + b"\0" * 50, "184 bytes for the 2 triangles promised, found 134"),
    "counts.off": (b"OFF\nmany 1 0\n", "expected the numbers of vertices and faces, found 'many 1 0'"),
    "m.dae": (b"<xml>", "the suffix '.dae' is not a format of a mesh; use one of .glb .gltf .obj .off .ply .stl .vtk"),
    "empty.stl": (b"", "the file is empty; expected a mesh"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_MESHES)
def test_bad_mesh(tmp_path: Path, name: str) -> None:
    content, message = BAD_MESHES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        read_mesh(tmp_path / name)
    one_line(error, name)


@pytest.mark.parametrize("suffix", sorted(set(OUTPUT_SUFFIXES) - {".laz"}))  # a process a case: in tests/fuzz.py
def test_damaged_bytes_never_crash(tmp_path: Path, cloud: tuple[Array, Array], suffix: str) -> None:
    """Cut, changed and inserted bytes: a cloud or a one-line ValueError, nothing else."""
    rng = np.random.default_rng(4)
    path = tmp_path / f"c{suffix}"
    write_cloud(path, *cloud)
    good = bytearray(path.read_bytes())
    refused = 0
    for _ in range(150):
        bad = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(min(len(bad), int(rng.choice([60, 400, 10**9])))))
            match rng.integers(3):
                case 0:
                    del bad[at:]
                    bad += b" "
                case 1:
                    bad[at] = rng.integers(256)
                case 2:
                    bad[at:at] = bytes(rng.integers(48, 58, 3).tolist())
        path.write_bytes(bad)
        message = ""
        try:
            read_cloud(path)
        except ValueError as error:
            message = str(error)
            refused += 1
        assert "\n" not in message
    assert refused > 20


def test_a_crash_of_the_decompressor_is_an_error(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    """laz whose table counts billions of parts, for which the decompressor asks 62 GB and then ends its process."""
    path = tmp_path / "cloud.laz"
    write_cloud(path, *cloud)
    data = bytearray(path.read_bytes())
    (points,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, points)
    struct.pack_into("<I", data, table + 4, 2**32 - 1)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"cloud\.laz: is no las file that can be read \(.*\); export") as error:
        read_cloud(path)
    assert "\n" not in str(error.value)


# Writing


def test_bad_output(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    with pytest.raises(ValueError, match=r"the folder .*nowhere does not exist; create it first"):
        check_output(tmp_path / "nowhere" / "c.ply")
    with pytest.raises(ValueError, match=r"the suffix '.e57' is not a format of a point cloud to write"):
        write_cloud(tmp_path / "c.e57", *cloud)
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ValueError, match="is a folder; give the name of a file to write"):
        write_cloud(tmp_path / "folder.ply", *cloud)
    with pytest.raises(ValueError, match=r"expected 40 rows of 'normals', one a point, found \(39, 3\)"):
        write_cloud(tmp_path / "c.ply", cloud[0], cloud[1][1:])
    with pytest.raises(ValueError, match="expected 40 rows of 'time'"):
        write_cloud(tmp_path / "c.ply", *cloud, {"time": np.zeros(3)})
    assert [file.name for file in tmp_path.iterdir()] == ["folder.ply"]


def test_full_disk(tmp_path: Path, cloud: tuple[Array, Array]) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")

    def write() -> None:
        with atomic_path(tmp_path / "c.xyz") as temporary:
            temporary.unlink()
            temporary.symlink_to("/dev/full")
            np.savetxt(temporary, cloud[0])

    with pytest.raises(ValueError, match=r"c.xyz: cannot be written \(No space left on device\)"):
        write()
    assert list(tmp_path.iterdir()) == []
