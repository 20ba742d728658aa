"""Formats of scanners and of visualization: e57, vtk, vtp, and what lidar files say about their coordinates."""

import base64
import importlib.util
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from pnu.io import read_cloud, read_mesh, write_cloud
from tests.io.test_io import CUBE, volume

Array = np.ndarray


def sphere(count: int = 60) -> Array:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


# Lidar


def las(path: Path, keys: list[int] | None, wkt: str) -> None:
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 1e-7)
    if keys:
        words = struct.pack("<8H", 1, 1, 0, 1, *keys)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", words))
    if wkt:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt.encode() + b"\0"))
    data = laspy.LasData(header)
    data.xyz = sphere() * 1e-3 + [8.5, 47.3, 0.4]
    data.write(path)


@pytest.mark.parametrize(
    ("keys", "wkt", "degrees"),
    [
        ([1024, 0, 1, 2], "", True),
        ([1024, 0, 1, 1], "", False),
        (None, 'GEOGCS["WGS 84",DATUM["WGS_1984"]]', True),
        (None, 'PROJCS["UTM 32N",GEOGCS["WGS 84"]]', False),
        (None, 'COMPD_CS["both",GEOGCS["WGS 84"],VERT_CS["h"]]', True),
        (None, 'COMPD_CS["both",PROJCS["UTM 32N",GEOGCS["WGS 84"]],VERT_CS["h"]]', False),
        (None, "", False),
    ],
)
def test_degrees_are_said(tmp_path: Path, keys: list[int] | None, wkt: str, degrees: bool) -> None:
    las(tmp_path / "c.las", keys, wkt)
    assert any("degrees" in note and "project" in note for note in read_cloud(tmp_path / "c.las").notes) == degrees


def test_laz_in_one_piece_is_one_line(tmp_path: Path) -> None:
    """As laszip 1 compressed; the decompressor would panic with a path of the machine that built it."""
    path = tmp_path / "c.laz"
    write_cloud(path, sphere())
    data = bytearray(path.read_bytes())
    at = data.index(b"laszip encoded") - 2 + 54
    data[at : at + 2] = b"\1\0"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"c\.laz: is compressed in one piece, as by laszip 1, .* las2las -i") as error:
        read_cloud(path)
    assert "\n" not in str(error.value)


# e57


def e57(path: Path, scans: list[dict[str, Array]], move: Array) -> None:
    """move: of all scans (3,), or of each."""
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(path), mode="w")
    for scan, place in zip(scans, np.broadcast_to(move, (len(scans), 3)), strict=True):
        file.write_scan_raw(scan, rotation=np.array([1.0, 0, 0, 0]), translation=place)
    file.close()


def scan(points: Array, colors: Array | None) -> dict[str, Array]:
    columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), np.ascontiguousarray(points.T), strict=True))
    columns["intensity"] = np.linspace(0, 1, len(points))
    if colors is not None:
        columns |= dict(zip(("colorRed", "colorGreen", "colorBlue"), np.ascontiguousarray(colors.T), strict=True))
    return columns


def test_e57(tmp_path: Path) -> None:
    """All scans where their poses put them."""
    points = sphere()
    colors = np.random.default_rng(1).integers(0, 256, (60, 3)).astype(np.uint8)
    e57(tmp_path / "c.e57", [scan(points[:40], colors[:40]), scan(points[40:], colors[40:])], np.array([10.0, 20, 30]))
    read = read_cloud(tmp_path / "c.e57")
    np.testing.assert_allclose(read.points, points + [10, 20, 30], atol=1e-6)
    np.testing.assert_array_equal(read.attributes["colors"], colors)
    assert len(read.attributes["intensity"]) == 60
    (tmp_path / "d.e57").write_bytes((tmp_path / "c.e57").read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"d\.e57: is no e57 file that can be read \(.*\); export it again") as error:
        read_cloud(tmp_path / "d.e57")
    assert "\n" not in str(error.value)


def test_e57_says_where_each_scan_stood(tmp_path: Path) -> None:
    points = sphere()
    scans = [scan(points[:40], None), scan(points[40:], None)]
    stood = np.array([[1.0, 2, 3], [-4, 5, 6]])
    for places, expected in ((stood, stood), (stood * [[1], [0]], [stood[0], np.full(3, np.nan)])):
        e57(tmp_path / "c.e57", scans, places)
        found = read_cloud(tmp_path / "c.e57").attributes
        np.testing.assert_array_equal(found["scan"], np.repeat([0, 1], [40, 20]))
        sensors = np.stack([found[f"sensor_{axis}"] for axis in "xyz"], 1)
        np.testing.assert_array_equal(sensors, np.repeat(expected, [40, 20], axis=0))


def test_e57_of_scans_whose_places_it_does_not_say(tmp_path: Path) -> None:
    """0 0 0, where files put what was joined elsewhere."""
    points = sphere()
    e57(tmp_path / "c.e57", [scan(points[:40], None), scan(points[40:], None)], np.zeros(3))
    assert read_cloud(tmp_path / "c.e57").attributes.keys() == {"intensity", "scan"}
    e57(tmp_path / "d.e57", [scan(points, None)], np.zeros(3))
    assert read_cloud(tmp_path / "d.e57").attributes.keys() == {"intensity"}


def test_e57_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "c.e57").write_bytes(b"x")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        ValueError, match=r'c\.e57: reading e57 needs pye57, which is not installed: pip install "pnu\[e57\]"'
    ):
        read_cloud(tmp_path / "c.e57")


# vtk


def legacy(binary: bool, version: int) -> bytes:
    def numbers(values: Array, kind: str) -> bytes:
        return (
            values.astype(">" + kind).tobytes() + b"\n"
            if binary
            else " ".join(map(str, values.ravel())).encode() + b"\n"
        )

    text = f"# vtk DataFile Version {version}.0\ncube\n{'BINARY' if binary else 'ASCII'}\nDATASET POLYDATA\n"
    body = text.encode() + b"POINTS 8 float\n" + numbers(CUBE.vertices, "f4")
    if version == 5:
        body += b"POLYGONS 13 36\nOFFSETS vtktypeint64\n" + numbers(np.arange(13) * 3, "i8")
        body += b"CONNECTIVITY vtktypeint64\n" + numbers(CUBE.faces, "i8")
    else:
        body += b"POLYGONS 12 48\n" + numbers(np.c_[np.full(12, 3), CUBE.faces], "i4")
    body += b"CELL_DATA 12\nSCALARS part int 1\nLOOKUP_TABLE default\n" + numbers(np.arange(12), "i4")
    return body + b"POINT_DATA 8\nNORMALS Normals float\n" + numbers((CUBE.vertices - 0.5) * 2 / 3**0.5, "f4")


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("version", [3, 5])
def test_legacy_vtk(tmp_path: Path, binary: bool, version: int) -> None:
    path = tmp_path / "m.vtk"
    path.write_bytes(legacy(binary, version))
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.faces, CUBE.faces)
    np.testing.assert_array_equal(mesh.vertices, CUBE.vertices)
    cloud = read_cloud(path, minimum=8)
    np.testing.assert_allclose(cloud.normals, (CUBE.vertices - 0.5) * 2 / 3**0.5, atol=1e-6)
    assert "12 faces are ignored" in cloud.notes[0]


def xml(form: str, packed: bool) -> bytes:
    blocks: list[bytes] = []

    def array(name: str, values: Array, kind: str, width: int) -> str:
        head = f"<DataArray type='{kind}' Name='{name}' NumberOfComponents='{width}' format='{form.split()[0]}'"
        if form == "ascii":
            return head + ">" + " ".join(map(str, values.ravel())) + "</DataArray>"
        data = values.tobytes()
        table, content = struct.pack("<I", len(data)), data
        if packed:  # in two blocks
            half = len(data) // 2
            parts = [zlib.compress(data[:half]), zlib.compress(data[half:])]
            table, content = struct.pack("<5I", 2, half, len(data) - half, *map(len, parts)), b"".join(parts)
        whole = table + content
        if form != "appended raw":
            whole = base64.b64encode(table) + base64.b64encode(content) if packed else base64.b64encode(whole)
        if form == "binary":
            return head + ">" + whole.decode() + "</DataArray>"
        blocks.append(whole)
        return head + f" offset='{sum(map(len, blocks[:-1]))}'/>"

    compressor = " compressor='vtkZLibDataCompressor'" if packed else ""
    text = (
        f"<?xml version='1.0'?><VTKFile type=\"PolyData\" byte_order='LittleEndian' header_type='UInt32'{compressor}>"
    )
    text += "<PolyData><Piece NumberOfPoints='8'><PointData>"
    text += array("Normals", ((CUBE.vertices - 0.5) * 2 / 3**0.5).astype("<f4"), "Float32", 3) + "</PointData><Points>"
    text += array("Points", CUBE.vertices.astype("<f8"), "Float64", 3) + "</Points><Polys>"
    text += array("connectivity", CUBE.faces.astype("<i8"), "Int64", 1)
    text += array("offsets", (3 * np.arange(1, 13)).astype("<i4"), "Int32", 1) + "</Polys></Piece></PolyData>"
    end = b"</VTKFile>"
    if form.startswith("appended"):
        kind = form.split()[1]
        end = f'<AppendedData encoding="{kind}">_'.encode() + b"".join(blocks) + b"</AppendedData></VTKFile>"
    return text.encode() + end


@pytest.mark.parametrize("form", ["ascii", "binary", "appended raw", "appended base64"])
@pytest.mark.parametrize("packed", [False, True])
def test_vtp(tmp_path: Path, form: str, packed: bool) -> None:
    (tmp_path / "m.vtp").write_bytes(xml(form, packed))
    mesh = read_mesh(tmp_path / "m.vtp")
    assert volume(mesh) == pytest.approx(1)
    np.testing.assert_array_equal(mesh.faces, CUBE.faces)
    assert read_cloud(tmp_path / "m.vtp", minimum=8).normals is not None


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("m.vtk", legacy(True, 3).replace(b"POINTS 8", b"POINTS 800000000")),
        ("m.vtk", legacy(False, 5).replace(b"POLYGONS 13", b"POLYGONS 12")),
        ("m.vtk", b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\n"),
        ("m.vtk", legacy(True, 3)[:200]),
        ("m.vtk", b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nNORMALS a float\nSCALARS b float\n1"),
        ("m.vtp", b"<!DOCTYPE a [<!ENTITY b 'c'>]><VTKFile type='PolyData'/>"),
        ("m.vtp", b"<VTKFile type='UnstructuredGrid'/>"),
        ("m.vtp", xml("appended raw", True).replace(b"offset='0'", b"offset='9'")),
        ("m.vtp", xml("binary", False)[:-400]),
    ],
)
def test_bad_vtk(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(
        ValueError, match=rf"{name}: is no vt[kp] file that can be read \(.*\); save it as ply"
    ) as error:
        read_mesh(tmp_path / name)
    assert "\n" not in str(error.value)
