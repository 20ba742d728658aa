"""Damaged and forged files for every reader: `python -m tests.fuzz [cases a reader] [seed]`.

Half of the cases are valid files with changed bytes, half are files put together from the grammar of the format, with
numbers that lie. A reader must give a right result or a `ValueError` of one line that names the file. Cases run in a
child process for each reader, with a limit of 10 s a case and of 1 GiB beyond what the child takes at its start. A case
is on disk before it is read: a child that dies leaves the one that killed it.
"""

import io
import json
import os
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parents[1]
SECONDS, GIBIBYTE = int(os.environ.get("PNU_FUZZ_SECONDS", 10)), 2**30
NUMBERS = b"0 -1 1 3 255 65536 2147483647 4294967295 4294967297 9223372036854775807 99999999999999999999"
WORDS = [*NUMBERS.split(), b"1e308", b"1e39", b"nan", b"-inf", b"x", b"1_0"]


class Reader(NamedTuple):
    """How a kind of file is read and checked, valid examples of it, and its grammar."""

    suffix: str
    read: Callable[[Path], None]
    examples: Callable[[], list[bytes]]
    structures: st.SearchStrategy[bytes]


# What a right result is


def read_cloud(path: Path) -> None:
    from pnu.io import read_cloud

    cloud = read_cloud(path)
    n = len(cloud.points)
    assert n >= 16
    assert cloud.points.shape == (n, 3)
    assert np.isfinite(cloud.points).all()
    if cloud.normals is not None:
        lengths = np.linalg.norm(cloud.normals, axis=1)
        assert (np.isnan(lengths) | np.isclose(lengths, 1)).all()
        assert not np.isnan(lengths).all()
    assert all("\n" not in note and len(note) < 1000 for note in cloud.notes)
    assert all(len(values) == n for values in cloud.attributes.values())


def read_mesh(path: Path) -> None:
    from pnu.io import read_mesh

    mesh = read_mesh(path)
    assert np.isfinite(mesh.vertices).all()
    assert len(mesh.faces)
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)


def read_patches(path: Path) -> None:
    import torch

    from pnu.data.patch_dataset import Options, PatchDataset
    from pnu.data.patch_file import check_patch_file, describe

    contents = check_patch_file(path)
    describe(path)
    data = PatchDataset(path, range(contents.patches), Options(64, 64), seed=0, names=contents.names)
    for i in range(min(contents.patches, 4)):
        assert all(torch.isfinite(data[i][part]).all() for part in ("input", "target"))


def read_checkpoint(path: Path) -> None:
    """As best.ckpt of a run folder."""
    import pnu

    run = path.parent.parent / "run"
    shutil.copyfile(path, run / "checkpoints" / "best.ckpt")
    outputs_of(pnu.load(run))


def read_weights(path: Path) -> None:
    import pnu

    outputs_of(pnu.load(path))


def read_config(path: Path) -> None:
    """As config.yaml of a run folder."""
    import pnu

    run = path.parent.parent / "run with config"
    shutil.copyfile(path, run / "config.yaml")
    outputs_of(pnu.load(run))


def outputs_of(network: Any) -> None:
    """A network that came out of a file can be used."""
    import torch

    assert not network.training
    with torch.no_grad():
        assert network(torch.randn(1, 64, 6)).shape[1] == 64 * network.ratio


# Valid files


def cloud_files(suffix: str) -> Callable[[], list[bytes]]:
    def examples() -> list[bytes]:
        from pnu.io import write_cloud

        rng = np.random.default_rng(0)
        points, normals = rng.normal(size=(2, 20, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        attributes = {"colors": rng.integers(0, 256, (20, 3)).astype(np.uint8), "time": rng.normal(size=20)}
        keeps = attributes if suffix in (".ply", ".pcd", ".las", ".laz") else {}
        made = [written(suffix, lambda path: write_cloud(path, points, normals, keeps))]
        made += [written(suffix, lambda path: write_cloud(path, points))]
        rows = "\n".join(f"{x:.3f} {y:.3f} {z:.3f}" for x, y, z in points)
        if suffix == ".ply":
            head = "ply\nformat {} 1.0\nelement vertex 20\nproperty float x\nproperty float y\nproperty float z\n"
            made += [(head.format("ascii") + f"end_header\n{rows}\n").encode()]
            made += [(head.format("binary_big_endian") + "end_header\n").encode() + points.astype(">f4").tobytes()]
            made += mesh_files(suffix)()
        if suffix == ".pcd":
            head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 20\nHEIGHT 1\nPOINTS 20\nDATA "
            made += [f"{head}ascii\n{rows}\n".encode()]
            flat = points.astype("<f4").T.tobytes()
            packed = b"".join(bytes([len(flat[i : i + 32]) - 1]) + flat[i : i + 32] for i in range(0, len(flat), 32))
            sizes = struct.pack("<II", len(packed), len(flat))
            made += [f"{head}binary_compressed\n".encode() + sizes + packed]
        return made

    return examples


def mesh_files(suffix: str) -> Callable[[], list[bytes]]:
    def examples() -> list[bytes]:
        from pnu.io import Mesh, write_mesh

        rng = np.random.default_rng(1)
        mesh = Mesh(rng.normal(size=(20, 3)), rng.integers(0, 20, (30, 3)))
        made = [written(suffix, lambda path: write_mesh(path, mesh))]
        if suffix != ".stl":
            made += [written(suffix, lambda path: write_mesh(path, mesh, vertex_normals=rng.normal(size=(20, 3))))]
        if suffix == ".ply":
            quads = b"\n".join(b"4 0 1 2 3" if i % 2 else b"3 0 1 2" for i in range(6))
            head = (
                b"ply\nformat ascii 1.0\nelement vertex 16\nproperty double x\nproperty double y\nproperty double z\n"
            )
            rows = b"\n".join(b"%d %d %d" % (i, i % 3, i % 5) for i in range(16))
            face = b"element face 6\nproperty list uchar int vertex_indices\nend_header\n"
            made += [head + face + rows + b"\n" + quads + b"\n"]
            body = rng.normal(size=(16, 3)).tobytes()
            polygons = b"".join(struct.pack(f"<B{k}i", k, *range(k)) for k in (3, 4, 5, 3, 4, 3))
            made += [head.replace(b"ascii", b"binary_little_endian") + face + body + polygons]
        return made

    return examples


def gltf_examples() -> list[bytes]:
    import trimesh

    box, sphere = trimesh.creation.box(), trimesh.creation.icosphere(1)
    return [shape.scene().export(file_type="glb", include_normals=shape is sphere) for shape in (box, sphere)]


def vtk_examples() -> list[bytes]:
    from tests.io.test_scanner_formats import legacy

    return [legacy(binary, version) for binary in (False, True) for version in (3, 5)]


def vtp_examples() -> list[bytes]:
    from tests.io.test_scanner_formats import xml

    return [xml(form, packed) for form in ("ascii", "binary", "appended raw") for packed in (False, True)]


def e57_examples() -> list[bytes]:
    from tests.io.test_scanner_formats import e57, scan, sphere

    return [written(".e57", lambda path: e57(path, [scan(sphere(), None)], np.zeros(3)))]


def patch_files() -> list[bytes]:
    import h5py

    rng = np.random.default_rng(0)
    ball = rng.normal(size=(6, 64, 3)).astype(np.float32)
    ball /= np.linalg.norm(ball, axis=-1, keepdims=True)
    made = []
    for options in ({}, {"compression": "gzip", "chunks": (1, 64, 6)}, {"libver": "latest"}):
        buffer = io.BytesIO()
        with h5py.File(buffer, "w", libver=options.pop("libver", None)) as file:
            file.create_dataset("poisson_4096", data=np.concatenate([ball, ball], -1), **options)
            file["name"] = np.array([f"s{i % 3}" for i in range(6)], h5py.string_dtype())
            file["edges"] = ball[:, :8]
            file.attrs["parameters"] = "{}"
        made.append(buffer.getvalue())
    return made


MODEL = {"_target_": "pnu.networks.pnu.PNU", "ratio": 2, "local_features": False}


def checkpoint_files() -> list[bytes]:
    import torch

    from pnu.networks import build_network

    state = {f"model.{name}": value for name, value in build_network(MODEL).state_dict().items()}
    made = []
    for more in ({}, {"epoch": 3, "global_step": 9, "optimizer_states": [{"lr": np.float64(0.1)}], "loops": {}}):
        torch.save({"state_dict": state, **more}, buffer := io.BytesIO())
        made.append(buffer.getvalue())
    torch.save({"state_dict": state}, buffer := io.BytesIO(), _use_new_zipfile_serialization=False)
    return [*made, buffer.getvalue()]


def weight_files() -> list[bytes]:
    from pnu import weights
    from pnu.networks import build_network

    state = build_network(MODEL).state_dict()
    return [written(".safetensors", lambda path: weights.write(path, MODEL, state))]


def config_files() -> list[bytes]:
    return [json.dumps({"model": MODEL, "data": {"input_points": 64}}).encode()]


def written(suffix: str, write: Callable[[Path], None]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"example{suffix}")
        write(path)
        return path.read_bytes()


# Bytes changed


def mutated(examples: list[bytes], rng: np.random.Generator) -> bytes:
    """A valid file with a change or a few, mostly near its start, where headers are."""
    data = bytearray(examples[rng.integers(len(examples))])
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        reach = min(len(data), int(rng.choice([16, 100, 500, 3000, 10**9])))
        at = int(rng.integers(max(reach, 1)))
        length = int(rng.choice([1, 2, 4, 8, 50]))
        word = WORDS[rng.integers(len(WORDS))]
        value = int(rng.choice([0, 1, -1, 2**31 - 1, 2**32 - 1, 2**62, 10**9, -(2**63)]))
        numbers = list(re.finditer(rb"[-+.\d]+(e[-+]?\d+)?", data[:reach]))
        match rng.integers(8):
            case 0:
                data[at : at + 1] = rng.bytes(1)
            case 1:
                data[at : at + 1] = bytes(byte ^ 1 << int(rng.integers(8)) for byte in data[at : at + 1])
            case 2:
                del data[at : at + length]
            case 3:
                data[at:at] = data[at : at + length] * int(rng.integers(1, 4))
            case 4:
                del data[at:]
            case 5 if numbers:
                found = numbers[rng.integers(len(numbers))]
                data[found.start() : found.end()] = word
            case 6:
                size = int(rng.choice([1, 2, 4, 8]))
                data[at : at + size] = (value % 256**size).to_bytes(size, str(rng.choice(["little", "big"])))
            case 7:
                other = examples[rng.integers(len(examples))]
                start = int(rng.integers(len(other)))
                data[at : at + length] = other[start : start + length]
    return bytes(data)


# Files from the grammar

number = (
    st.sampled_from([word.decode() for word in WORDS]) | st.integers(-5, 40).map(str) | st.floats(width=32).map(str)
)
count = st.sampled_from(["0", "1", "3", "16", "20", "-1", "1000000000", "99999999999999999999", "1e3", ""])
junk = st.binary(max_size=600)
lines = st.lists(st.lists(number, max_size=8).map(" ".join), max_size=24).map("\n".join)
square = st.integers(0, 30).map(lambda n: "\n".join(f"{i} {i % 4} {i % 5}" for i in range(n)))
body = (lines | square).map(str.encode) | junk


@st.composite
def ply_files(draw: st.DrawFn) -> bytes:
    kinds = st.sampled_from(["float", "double", "uchar", "int", "int64", "uint8", "float128", "list"])
    axes = st.just([f"property {draw(kinds)} {axis}" for axis in "xyz"])
    one = st.builds("property {} {}".format, kinds, st.sampled_from(["x", "nx", "ny", "nz", "red", "a", ""]))
    many = st.builds("property list {} {} {}".format, kinds, kinds, st.sampled_from(["vertex_indices", "a"]))
    properties = axes | st.lists(one | many, max_size=5)
    form = draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian", "binary"]))
    head = ["ply", f"format {form} 1.0"]
    for name in draw(st.lists(st.sampled_from(["vertex", "face", "edge", ""]), max_size=3)):
        head += [f"element {name} {draw(count)}", *draw(properties)]
    return "\n".join([*head, draw(st.sampled_from(["end_header", ""]))]).encode() + b"\n" + draw(body)


@st.composite
def pcd_files(draw: st.DrawFn) -> bytes:
    width = draw(st.integers(0, 6))
    fields = st.lists(st.sampled_from(["x", "y", "z", "normal_x", "rgb", "_", "a"]), min_size=width, max_size=width)
    head = ["FIELDS " + " ".join(draw(st.just(["x", "y", "z"]) | fields))]
    for key, words in (("SIZE", "0 1 2 4 8 3 -1"), ("TYPE", "F U I X"), ("COUNT", "1 1 1 2 0 -1 4294967297")):
        word = st.sampled_from(words.split())
        head += [f"{key} " + " ".join(draw(st.lists(word, min_size=3, max_size=3) | st.lists(word, max_size=6)))]
    head += [f"{key} {draw(count)}" for key in draw(st.sets(st.sampled_from(["WIDTH", "HEIGHT", "POINTS"])))]
    head += ["DATA " + draw(st.sampled_from(["ascii", "binary", "binary_compressed", ""]))]
    sizes = struct.pack("<II", draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([0, 240, 2**31, 2**32 - 1])))
    return "\n".join(head).encode() + b"\n" + draw(st.sampled_from([b"", sizes])) + draw(body)


@st.composite
def npy_files(draw: st.DrawFn) -> bytes:
    kind = draw(st.sampled_from(["<f8", "<f4", ">f8", "|u1", "<i8", "|O", "<U9", "<c16", "<f16", "|V3", "nonsense"]))
    shape = draw(st.lists(st.sampled_from([0, 1, 3, 6, 20, 10**12, 2**63, -1]), max_size=3).map(tuple))
    head = f"{{'descr': '{kind}', 'fortran_order': {draw(st.booleans())}, 'shape': {shape}}}"
    head = draw(st.sampled_from([head, head[:-3], "(" * 3000, "[" * 90, "{'descr': 1}", "__import__('os')", ""]))
    version = draw(st.sampled_from([b"\1\0", b"\2\0", b"\3\0", b"\x09\0"]))
    length = draw(st.sampled_from([len(head), 0, 65535])).to_bytes(2 if version == b"\1\0" else 4, "little")
    return b"\x93NUMPY" + version + length + head.encode() + draw(junk | square.map(str.encode))


@st.composite
def text_files(draw: st.DrawFn) -> bytes:
    """Titles, names, counts and comments before lines that have separators, decimal commas, words and holes."""
    separator = draw(st.sampled_from([" ", ",", ", ", ";", "\t", "//", "\r", "\0"]))
    width = draw(st.integers(3, 11))
    word = st.sampled_from(["x", "Y", "z", "nx", "ny", "Nz", "r", "G", "b", "i", "_", "", "lon", "lat", "a [m]", '"q"'])
    head = st.sampled_from(
        ["", "20", "30", "-1", "1e3", "99999999999999999999", "# x y z i", "//X,Y,Z", "a title", "% 3"]
    )
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    table = rng.normal(size=(20, width))
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, width - 1))
        table[:, at : at + 3] = draw(st.sampled_from([0, 1, 255, np.nan, 1e30])) * np.ones_like(table[:, at : at + 3])
    table = np.rint(table * 50) if draw(st.booleans()) else table
    rows = [[f"{value:.6g}" for value in row] for row in table]
    for _ in range(draw(st.integers(0, 3))):
        rows[draw(st.integers(0, 19))][draw(st.integers(0, width - 1))] = draw(number | word)
    lines = draw(st.lists(head | st.lists(word, max_size=width + 1).map(separator.join), max_size=3))
    text = "\n".join([*lines, *(separator.join(row) for row in rows)]) + "\n"
    if draw(st.booleans()):
        text = text.replace(".", draw(st.sampled_from([",", ".", ""])))
    whole = text.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])))
    return draw(
        st.sampled_from([whole, whole[: draw(st.integers(0, len(whole)))]])
        | body.map(lambda data: data.replace(b" ", separator.encode()))
    )


def ptx_examples() -> list[bytes]:
    points = np.random.default_rng(0).normal(size=(20, 4))
    head = "5\n4\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    scan = head + "".join("{:.3f} {:.3f} {:.3f} {:.3f}\n".format(*row) for row in points)
    return [scan.encode(), (scan + scan.replace("0 0 0 1", "3 2 1 1")).encode()]


@st.composite
def ptx_files(draw: st.DrawFn) -> bytes:
    rows = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    many = st.lists(st.builds("{}\n{}\n".format, count, count), max_size=2)
    return "".join(head + draw(st.sampled_from([rows, ""])) for head in draw(many)).encode() + draw(body)


def npz_examples() -> list[bytes]:
    points, normals = np.random.default_rng(0).normal(size=(2, 20, 3))
    made = []
    for save, arrays in (
        (np.savez, {"points": points, "normals": normals, "label": np.arange(20)}),
        (np.savez_compressed, {"scan": np.hstack([points, np.arange(60).reshape(20, 3)])}),
        (np.savez, {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2]}),
    ):
        save(buffer := io.BytesIO(), **arrays)  # type: ignore[operator]
        made.append(buffer.getvalue())
    return made


@st.composite
def npz_files(draw: st.DrawFn) -> bytes:
    """Archives whose arrays have any names, shapes and types, and members that are no arrays."""
    name = st.sampled_from(["points", "xyz", "normals", "colors", "x", "y", "z", "a", "points/b", "é"])
    with zipfile.ZipFile(buffer := io.BytesIO(), "w", draw(st.sampled_from([0, 8, 12, 14]))) as archive:
        for one in draw(st.sets(name, max_size=4)):
            shape = draw(st.sampled_from([(20, 3), (20, 6), (4, 5, 3), (20,), (0, 3), (20, 2), ()]))
            kind = draw(st.sampled_from(["f8", "f4", "u1", "i8", "c8", "U3", "?", "f2", [("x", "f8"), ("y", "f8")]]))
            np.save(member := io.BytesIO(), np.random.default_rng(1).integers(0, 9, shape).astype(np.dtype(kind)))
            archive.writestr(
                one + draw(st.sampled_from([".npy", ".npy", ""])), draw(st.just(member.getvalue()) | npy_files())
            )
    return buffer.getvalue()


@st.composite
def obj_files(draw: st.DrawFn) -> bytes:
    corner = st.builds("{}{}{}".format, number, st.sampled_from(["", "/", "//", "/1/"]), number)
    row = st.builds("v {0} {0} {1}".format, number, number) | st.builds("vn {} 0 1".format, number)
    row |= st.lists(corner, max_size=6).map(lambda corners: "f " + " ".join(corners)) | lines
    good = draw(st.sampled_from(["", "".join(f"v {i} {i % 4} {i % 5}\n" for i in range(20)) + "f 1 2 3\n"]))
    return (good + "\n".join(draw(st.lists(row, max_size=30)))).encode()


@st.composite
def off_files(draw: st.DrawFn) -> bytes:
    head = draw(st.sampled_from(["OFF", "NOFF", "COFF", "CNOFF", "STOFF", "off", ""]))
    between = draw(st.sampled_from(["\n", " ", ""]))
    faces = st.lists(
        st.lists(number, max_size=6).map(lambda corners: f"{len(corners)} " + " ".join(corners)), max_size=5
    )
    return f"{head}{between}{draw(count)} {draw(count)} 0\n".encode() + draw(body) + "\n".join(draw(faces)).encode()


@st.composite
def stl_files(draw: st.DrawFn) -> bytes:
    claimed = draw(st.sampled_from([0, 1, 3, 2**31, 2**32 - 1]))
    binary = (
        b"x" * 80 + claimed.to_bytes(4, "little") + draw(st.binary(max_size=200) | st.just(b"\1" * 50 * (claimed % 7)))
    )
    vertices = draw(st.lists(st.lists(number, min_size=1, max_size=4).map(" ".join), max_size=9))
    text = "solid a\n" + "".join(f"vertex {vertex}\n" for vertex in vertices) + draw(st.sampled_from(["", "endsolid"]))
    return draw(st.sampled_from([binary, text.encode()]))


@st.composite
def gltf_files(draw: st.DrawFn) -> bytes:
    """A tree whose counts, types and references may lie, between the two parts of glb."""
    number = st.sampled_from([0, 1, 3, 8, 36, 96, -1, 10**9, 2**63])
    index = st.sampled_from([0, 0, 0, 1, 2, -1, 99])
    kinds = st.sampled_from([5126, 5126, 5123, 5125, 5121, 7])
    view = st.fixed_dictionaries({"buffer": index, "byteLength": number}, optional={"byteOffset": number})
    accessor = st.fixed_dictionaries(
        {
            "componentType": kinds,
            "count": number,
            "type": st.sampled_from(["VEC3", "VEC3", "SCALAR", "MAT4", "x"]),
        },
        optional={"bufferView": index, "byteOffset": number, "sparse": st.just({"count": 10**9})},
    )
    attributes = st.fixed_dictionaries({"POSITION": index}, optional={"COLOR_0": index, "NORMAL": index})
    primitive = st.fixed_dictionaries({"attributes": attributes}, optional={"indices": index, "mode": index})
    node = st.fixed_dictionaries(
        {"mesh": index}, optional={"children": st.lists(index, max_size=2), "scale": st.lists(number, max_size=4)}
    )
    tree = {
        "asset": {"version": "2.0"},
        "scene": draw(index),
        "scenes": [{"nodes": draw(st.lists(index, max_size=3))}],
        "nodes": draw(st.lists(node, max_size=3)),
        "meshes": [{"primitives": draw(st.lists(primitive, max_size=2))}],
        "accessors": draw(st.lists(accessor, max_size=3)),
        "bufferViews": draw(st.lists(view, max_size=3)),
        "buffers": [{"byteLength": draw(number)}],
    }
    text = draw(st.sampled_from([json.dumps(tree), json.dumps(tree)[:-1], "[]", "{", "[" * 9000])).encode()
    length = draw(st.sampled_from([len(text), len(text), 0, 2**31]))
    rest = draw(junk)
    head = b"glTF" + struct.pack("<III", 2, 28 + len(text) + len(rest), length) + b"JSON"
    return head + text + struct.pack("<I", draw(st.sampled_from([len(rest), 0, 2**32 - 1]))) + b"BIN\0" + rest


@st.composite
def vtk_files(draw: st.DrawFn) -> bytes:
    kind = st.sampled_from(["float", "double", "int", "vtktypeint64", "bit", "x"])
    row = st.builds("POINTS {} {}".format, count, kind) | st.builds("POLYGONS {} {}".format, count, count)
    row |= st.builds("OFFSETS {}".format, kind) | st.builds("POINT_DATA {}".format, count)
    row |= st.builds("SCALARS a {} {}".format, kind, count) | st.builds("FIELD f {}".format, count)
    row |= st.builds("NORMALS a {}".format, kind) | st.builds("a {} {} {}".format, count, count, kind) | lines
    form = draw(st.sampled_from(["ASCII", "BINARY", ""]))
    head = f"# vtk DataFile Version 3.0\nx\n{form}\nDATASET {draw(st.sampled_from(['POLYDATA', 'x', '']))}\n"
    good = draw(
        st.sampled_from(["", "POINTS 16 float\n" + "\n".join(f"{i} {i % 3} {i % 5}" for i in range(16)) + "\n"])
    )
    return (head + good + "\n".join(draw(st.lists(row, max_size=8)))).encode() + draw(junk)


@st.composite
def vtp_files(draw: st.DrawFn) -> bytes:
    kind = st.sampled_from(["Float32", "Float64", "Int32", "Int64", "String", "UInt8"])
    form = st.sampled_from(["ascii", "binary", "appended", ""])

    def array(name: str) -> str:
        text = draw(body).hex() if draw(st.booleans()) else draw(lines | square)
        head = f"<DataArray type='{draw(kind)}' Name='{name}' format='{draw(form)}' offset='{draw(count)}'"
        return f"{head} NumberOfComponents='{draw(count)}'>{text}</DataArray>"

    packed = draw(
        st.sampled_from(["", " compressor='vtkZLibDataCompressor'", " header_type='UInt64'", " compressor='x'"])
    )
    text = f"<VTKFile type='PolyData'{packed}><PolyData><Piece><Points>{array('Points')}</Points>"
    text += f"<PointData>{array('Normals')}</PointData><Polys>{array('connectivity')}{array('offsets')}</Polys>"
    text += "</Piece></PolyData>" + draw(st.sampled_from(["", '<AppendedData encoding="raw">_']))
    bomb = "<!DOCTYPE a [<!ENTITY b 'bbbbbbbbbb'><!ENTITY c '&b;&b;&b;&b;'>]><VTKFile type='PolyData'>&c;</VTKFile>"
    end = draw(st.sampled_from([b"</VTKFile>", b"</AppendedData></VTKFile>"]))
    return draw(st.sampled_from([text.encode() + draw(body) + end, text.encode() + end, bomb.encode()]))


@st.composite
def e57_files(draw: st.DrawFn) -> bytes:
    """A header whose lengths may lie, a page."""
    far = st.sampled_from([48, 1024, 0, 2**40, 2**63])
    head = b"ASTM-E57" + struct.pack("<IIQQQQ", draw(st.integers(0, 2)), 0, *(draw(far) for _ in range(4)))
    return head + draw(junk).ljust(976, b"\0")


@st.composite
def las_files(draw: st.DrawFn) -> bytes:
    """A header whose sizes and counts may lie, records of the kinds that a reader interprets, points."""
    form, length = draw(st.sampled_from([(0, 20), (6, 30), (7, 36), (3, 34), (128, 20), (134, 30), (10, 67), (63, 1)]))
    length = draw(st.sampled_from([length, length, length + 6, 0, 65535]))
    points = draw(st.sampled_from([20, 20, 0, 2**31, 2**32 - 1]))
    minor, start = draw(st.sampled_from([(2, 227), (4, 375), (0, 227), (9, 375)]))
    records = b""
    kinds = st.sampled_from([(b"LASF_Spec", 4), (b"laszip encoded", 22204), (b"LASF_Projection", 34735), (b"copc", 1)])
    bodies = junk | st.just(b"\0\0\3\0" + b"nx".ljust(188, b"\0")) | st.just(struct.pack("<HHBBHIIqqH", 2, *[0] * 9))
    chosen = draw(st.lists(st.tuples(kinds, bodies), max_size=3))
    for (user, kind), content in chosen:
        size = draw(st.sampled_from([len(content), len(content), 0, 65535]))
        records += struct.pack("<H16sHH32s", 0, user, kind, size, b"") + content
    count = draw(st.sampled_from([len(chosen), len(chosen), 0, 10**5, 2**32 - 1]))
    offset = draw(st.sampled_from([start + len(records), start + len(records), 0, 2**32 - 1]))
    size = draw(st.sampled_from([start, start, 0, 65535]))
    head = struct.pack("<4s20xBB64x4xHIIBHI20x", b"LASF", 1, minor, size, offset, count, form, length, points)
    scales = draw(st.lists(st.sampled_from([0.01, 1.0, 0.0, 1e300, np.nan, -1.0]), min_size=6, max_size=6))
    head += struct.pack("<12d", *scales, *[0.0] * 6)
    far = st.sampled_from([0, 0, 20, 2**31, 2**63])
    head += struct.pack("<QQIQ120x", draw(far), draw(far), draw(far) % 2**32, draw(st.sampled_from([points, 2**62])))
    rows = np.random.default_rng(draw(st.integers(0, 9))).bytes(draw(st.sampled_from([20 * length, 0, 77])))
    return head[:start] + records + rows


@st.composite
def h5_files(draw: st.DrawFn) -> bytes:
    import h5py

    kind = st.sampled_from(["f4", "f8", "f2", "i4", "S3", ">f4", "c8", h5py.string_dtype()])
    sizes = st.lists(st.sampled_from([0, 1, 3, 6, 64, 65]), max_size=4).map(tuple) | st.just((6, 64, 6))
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name in draw(st.sets(st.sampled_from(["poisson_4096", "montecarlo_1024", "edges", "name", "other"]))):
            shape, dtype, value = draw(sizes), np.dtype(draw(kind)), draw(st.sampled_from([0, 1, -1e30]))
            match draw(st.integers(0, 5)):
                case 0:
                    file.create_group(name)
                case 1:
                    file[name] = h5py.SoftLink("/poisson_4096")
                case 2:
                    file[name] = h5py.Empty(dtype if dtype.kind != "O" else "f4")
                case 3 if shape and all(shape):
                    chunks = tuple(max(1, size) for size in shape)
                    file.create_dataset(name, tuple(size * 10**6 for size in shape), dtype, chunks=chunks)
                case _:
                    content = np.full(shape, "shape" if dtype.kind in "OS" else value).astype(dtype)
                    file.create_dataset(name, data=content, dtype=dtype)
    return buffer.getvalue()


@st.composite
def torch_files(draw: st.DrawFn) -> bytes:
    import torch

    leaf = st.none() | st.booleans() | st.integers(-9, 2**40) | st.floats() | st.text(max_size=5)
    leaf |= st.sampled_from(
        [torch.zeros(3), torch.zeros(0), torch.tensor(1j), np.float64(1), torch.zeros(2).to_sparse()]
    )
    tree = st.recursive(leaf, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner))
    content = draw(tree | st.fixed_dictionaries({"state_dict": tree}))
    torch.save(content, buffer := io.BytesIO())
    return buffer.getvalue()


@st.composite
def safetensors_files(draw: st.DrawFn) -> bytes:
    offset = st.sampled_from([0, 4, 12, 24, -1, 2**40, 2**64])
    tensor = st.fixed_dictionaries(
        {
            "dtype": st.sampled_from(["F32", "F64", "I64", "BOOL", "F99", "BF16"]),
            "shape": st.lists(st.sampled_from([0, 1, 3, 2**62, -1]), max_size=3),
            "data_offsets": st.lists(offset, min_size=2, max_size=2),
        }
    )
    head: dict[str, Any] = draw(st.dictionaries(st.text(max_size=4), tensor, max_size=3))
    model = draw(st.sampled_from([json.dumps(MODEL), "{}", "[]", "null", "{", "[" * 9000, '{"_target_": "os.system"}']))
    head |= draw(st.sampled_from([{}, {"__metadata__": {"model": model}}, {"__metadata__": {"model": 3}}]))
    text = json.dumps(head).encode()
    length = draw(st.sampled_from([len(text), 0, 8, 2**40, 2**63]))
    return length.to_bytes(8, "little") + text + draw(st.binary(max_size=64))


@st.composite
def yaml_files(draw: st.DrawFn) -> bytes:
    leaf = st.sampled_from([None, True, -1, 0, 3, 2.5, float("nan"), "x", "pnu", [], {}, [1, 2], "${oc.env:HOME}"])
    key = st.sampled_from(["ratio", "local_features", "global_features", "predict_normals", "input_normals", "other"])
    networks = ["pnu.networks.pnu.PNU", "pnu.networks.pnu_paper.PNUPaper"]
    target = st.sampled_from([*networks, "os.system", "pnu.io.os", "", 3])
    model = st.fixed_dictionaries({"_target_": target}) | st.dictionaries(key, leaf, max_size=4)
    model |= st.builds(lambda a, b: a | b, st.fixed_dictionaries({"_target_": target}), st.dictionaries(key, leaf))
    content = json.dumps({"model": draw(model | leaf), "data": draw(leaf | st.just({"input_points": draw(leaf)}))})
    bomb = "a: &a [x,x]\nb: &b [*a,*a]\nmodel: *b\n"
    return draw(
        st.sampled_from([content, content[:-1], bomb, "!!python/name:os.system", "{" * 2000, "a: b: c"])
    ).encode()


def of_clouds(suffix: str, structures: st.SearchStrategy[bytes]) -> Reader:
    return Reader(suffix, read_cloud, cloud_files(suffix), structures)


def of_meshes(suffix: str, structures: st.SearchStrategy[bytes]) -> Reader:
    return Reader(suffix, read_mesh, mesh_files(suffix), structures)


READERS = {
    "ply": of_clouds(".ply", ply_files()),
    "xyz": of_clouds(".xyz", text_files()),
    "pcd": of_clouds(".pcd", pcd_files()),
    "obj": of_clouds(".obj", obj_files()),
    "off": of_clouds(".off", off_files()),
    "npy": of_clouds(".npy", npy_files()),
    "npz": Reader(".npz", read_cloud, npz_examples, npz_files()),
    "pts": Reader(".pts", read_cloud, cloud_files(".xyz"), text_files()),
    "csv": Reader(".csv", read_cloud, cloud_files(".xyz"), text_files()),
    "pwn": Reader(".pwn", read_cloud, cloud_files(".xyz"), text_files()),
    "ptx": Reader(".ptx", read_cloud, ptx_examples, ptx_files()),
    "las": of_clouds(".las", las_files()),
    "laz": of_clouds(".laz", las_files()),
    "ply mesh": of_meshes(".ply", ply_files()),
    "obj mesh": of_meshes(".obj", obj_files()),
    "off mesh": of_meshes(".off", off_files()),
    "stl": of_meshes(".stl", stl_files()),
    "stl cloud": Reader(".stl", read_cloud, mesh_files(".stl"), stl_files()),
    "glb": Reader(".glb", read_mesh, gltf_examples, gltf_files()),
    "vtk": Reader(".vtk", read_mesh, vtk_examples, vtk_files()),
    "vtp": Reader(".vtp", read_mesh, vtp_examples, vtp_files()),
    "e57": Reader(".e57", read_cloud, e57_examples, e57_files()),
    "h5": Reader(".h5", read_patches, patch_files, h5_files()),
    "checkpoint": Reader(".ckpt", read_checkpoint, checkpoint_files, torch_files()),
    "safetensors": Reader(".safetensors", read_weights, weight_files, safetensors_files()),
    "config": Reader(".yaml", read_config, config_files, yaml_files()),
}


# Child and parent


def child(names: list[str], cases: int, start: int, folder: Path) -> None:
    """Run the cases of readers; prints a line of JSON a reader: how many were refused, and what went wrong."""
    import torch

    from pnu.networks import build_network, checkpoints

    torch.set_num_threads(1)
    if any(READERS[name].read in (read_checkpoint, read_weights, read_config) for name in names):
        for run in ("run", "run with config"):
            checkpoints.save(folder / run, network := build_network(MODEL), MODEL, {})
        outputs_of(network.eval())  # loads what the first call loads
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + GIBIBYTE, used + GIBIBYTE))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends the process, in native code too
    warnings.simplefilter("ignore")
    for name in names:
        print(json.dumps({"reader": name, **cases_of(READERS[name], cases, start, folder / "cases")}), flush=True)


def cases_of(reader: Reader, cases: int, start: int, folder: Path) -> dict[str, Any]:
    folder.mkdir(exist_ok=True)
    path = folder / f"case{reader.suffix}"
    refused = 0
    wrong: dict[str, Path] = {}

    def attempt(data: bytes) -> None:
        nonlocal refused
        path.write_bytes(data)
        problem = None
        signal.alarm(SECONDS)
        try:
            reader.read(path)
        except ValueError as error:
            refused += 1
            if "\n" in str(error) or len(str(error)) > 1000:
                problem = f"message of several lines: {error}"
            elif not re.search(rf"case\{reader.suffix}|best\.ckpt|config\.yaml|model|points", str(error)):
                problem = f"message without the file: {error}"
        except BaseException as error:
            problem = f"{type(error).__name__}: {error}"
        finally:
            signal.alarm(0)
        if problem is None and [entry.name for entry in folder.iterdir()] != [path.name]:
            problem = "left a file"
        if problem and (problem := " ".join(problem.split())[:300]) not in wrong:
            kept = folder.parent / f"wrong_{len(wrong)}{reader.suffix}"
            shutil.copyfile(path, kept)
            wrong[problem] = kept

    examples, rng = reader.examples(), np.random.default_rng([start, len(reader.suffix)])
    for example in examples:
        attempt(example)
    if refused:
        wrong["a valid file was refused"] = folder
    for _ in range(cases // 2):
        attempt(mutated(examples, rng))
    run = settings(
        max_examples=cases - cases // 2,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )(given(reader.structures)(attempt))
    seed(start)(run)()
    path.unlink()
    return {
        "cases": cases + len(examples),
        "refused": refused,
        "wrong": [f"{kept}: {text}" for text, kept in wrong.items()],
    }


def fuzz(names: list[str], cases: int, start: int, folder: Path) -> list[dict[str, Any]]:
    """Results of a child process for these readers; a reader on which the child died has that under "wrong"."""
    folder.mkdir(parents=True, exist_ok=True)
    arguments = ["child", json.dumps(names), str(cases), str(start), str(folder)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.fuzz", *arguments]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    results = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"reader"')]
    if done.returncode:
        name = names[len(results)]
        reason = signal.Signals(-done.returncode).name if done.returncode < 0 else done.stderr.strip()[-2000:]
        results.append({"reader": name, "cases": 0, "refused": 0, "wrong": [f"{folder}/cases: ended by {reason}"]})
    return results


def main() -> None:
    if sys.argv[1:2] == ["child"]:
        child(json.loads(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), Path(sys.argv[5]))
        return
    cases, start = (int(word) for word in [*sys.argv[1:], "800", "0"][:2])
    folder = Path(tempfile.mkdtemp(prefix="pnu_fuzz_"))
    wrong = 0
    for name in READERS:
        for result in fuzz([name], cases, start, folder / name.replace(" ", "_")):
            print(f"{name:12s} {result['cases']:6d} cases, {result['refused']:6d} refused", flush=True)
            print("".join(f"    {line}\n" for line in result["wrong"]), end="", flush=True)
            wrong += len(result["wrong"])
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
