"""Polygons and indices of mesh files: the faces that are read, against trimesh and against areas known beforehand."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pnu.io import Mesh, read_mesh, write_mesh
from pnu.io.polygons import triangulate

Array = np.ndarray


def area(vertices: Array, faces: Array) -> Array:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a) / 2


def star(corners: int, rng: np.random.Generator) -> Array:
    """A polygon (2 k, 2), counter-clockwise, with deep notches: no fan from any corner stays inside."""
    angle = np.linspace(0, 2 * np.pi, 2 * corners, endpoint=False)
    radius = np.where(np.arange(2 * corners) % 2, 0.2, 1.0) * rng.uniform(0.8, 1.2, 2 * corners)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)


def shoelace(outline: Array) -> float:
    x, y = outline.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_concave_polygons_are_filled_once(offset: float, scale: float) -> None:
    """All triangles have the polygon's side and together its area, in any plane, between convex ones."""
    rng = np.random.default_rng(0)
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    frame *= np.linalg.det(frame)  # no mirror
    outlines = [star(k, rng) for k in range(3, 9)]
    outlines[2:2] = [np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 0], [1, 0], [0, 1.0]])]
    counts = np.array([len(outline) for outline in outlines])
    flat = np.concatenate(outlines)
    vertices = np.c_[flat, np.zeros(len(flat))] @ frame.T * scale + offset * scale
    faces = triangulate(vertices, counts, np.arange(len(flat)))
    areas = area(vertices, faces) @ frame[:, 2] / scale**2
    assert areas.min() > 0
    ends = np.cumsum(counts - 2)
    for outline, found in zip(outlines, np.split(areas, ends[:-1]), strict=True):
        assert found.sum() == pytest.approx(shoelace(outline), rel=1e-6)
        assert len(found) == len(outline) - 2
    np.testing.assert_array_equal(faces[ends[1] :][:2] - faces[ends[1], 0], [[0, 1, 2], [0, 2, 3]])  # the square: a fan


@pytest.mark.parametrize(
    "outline",
    [
        [[0, 0]] * 5,
        [[0, 0], [1, 0], [2, 0], [3, 0]],
        [[0, 0], [1, 1], [1, 0], [0, 1]],
        [[0, 0], [1, np.nan], [0.4, 0.4], [0, 1]],
        [[0, 0], [1, 0], [0.2, 0.2], [1e30, 1]],
    ],
)
def test_polygons_that_are_none(outline: list) -> None:
    """Points, lines, crossings, NaN: as many triangles as corners promise, of those corners."""
    vertices = np.c_[np.array(outline, float), np.zeros(len(outline))]
    faces = triangulate(vertices, np.array([len(outline)]), np.arange(len(outline)))
    assert faces.shape == (len(outline) - 2, 3)
    assert set(faces.ravel()) <= set(range(len(outline)))


L_SHAPE = np.array([[2, 1], [1, 1], [1, 2], [0, 2], [0, 0], [2, 0]])  # a fan from its first corner leaves it


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply"])
def test_a_concave_polygon_of_each_format(tmp_path: Path, suffix: str) -> None:
    rows = "".join(f"{x} {y} 0\n" for x, y in L_SHAPE)
    head = "ply\nformat ascii 1.0\nelement vertex 6\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    text = {
        ".obj": "".join(f"v {x} {y} 0\n" for x, y in L_SHAPE) + "f 1 2 3 4 5 6\n",
        ".off": f"OFF\n6 1 0\n{rows}6 0 1 2 3 4 5\n",
        ".ply": f"{head}element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}6 0 1 2 3 4 5\n",
    }
    path = tmp_path / f"m{suffix}"
    path.write_text(text[suffix])
    mesh = read_mesh(path)
    assert np.abs(area(mesh.vertices, mesh.faces)).sum() == pytest.approx(3)


# Wavefront's indices


def absolute(i: int, read: int) -> int:
    return i + 1


def relative(i: int, read: int) -> int:
    return i - read


SPELLINGS = {
    "absolute": (absolute, "{}", "\n", " "),
    "relative": (relative, "{}", "\n", " "),
    "relative with texture": (relative, "{0}/1", "\n", " "),
    "relative with normals": (relative, "{0}//-1", "\n", " "),
    "tabs": (absolute, "{}", "\n", "\t"),
    "carriage returns": (relative, "{}", "\r\n", "  "),
    "lines that go on": (relative, "{}", "\n", " \\\n "),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_obj_faces_are_those_of_trimesh(tmp_path: Path, spelling: str) -> None:
    """Vertices in several groups, each with its faces behind; trimesh reads them spelled plainly."""
    trimesh = pytest.importorskip("trimesh")
    index, form, end, blank = SPELLINGS[spelling]
    rng = np.random.default_rng(len(spelling))
    for _ in range(5):
        text, plain = f"vt 0 0{end}vn 0 0 1{end}", ""
        read = 0
        for _ in range(rng.integers(2, 5)):
            some = rng.normal(size=(rng.integers(4, 9), 3)).round(3)
            text += "".join(f"v{blank}{x}{blank}{y}{blank}{z}{end}" for x, y, z in some)
            plain += "".join(f"v {x} {y} {z}\n" for x, y, z in some)
            read += len(some)
            for _ in range(rng.integers(3, 6)):
                corners = rng.choice(read, 3, replace=False)
                text += "f" + "".join(blank + form.format(index(int(i), read)) for i in corners) + end
                plain += "f {} {} {}\n".format(*corners + 1)
        path = tmp_path / "m.obj"
        path.write_bytes(text.encode())
        (tmp_path / "plain.obj").write_text(plain)
        ours, theirs = read_mesh(path), trimesh.load(tmp_path / "plain.obj", process=False, maintain_order=True)
        np.testing.assert_allclose(
            turned(ours.vertices[ours.faces]), turned(np.asarray(theirs.vertices)[theirs.faces]), atol=1e-12
        )


def turned(triangles: Array) -> Array:
    """Triangles (f, 3, 3) sorted, each from its smallest corner on: its orientation stays."""
    start = np.lexsort(triangles.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
    rolled = triangles[np.arange(len(triangles))[:, None], (start[:, None] + np.arange(3)) % 3].reshape(-1, 9)
    return rolled[np.lexsort(rolled.T)]


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl"])
@pytest.mark.parametrize("make", ["icosphere", "box", "torus", "capsule", "annulus"])
def test_faces_are_those_of_trimesh(tmp_path: Path, suffix: str, make: str) -> None:
    """What trimesh writes we read as it is, and the other way round."""
    trimesh = pytest.importorskip("trimesh")
    makers: dict[str, Callable] = {
        "icosphere": lambda: trimesh.creation.icosphere(2),
        "box": lambda: trimesh.creation.box((1, 2, 3)),
        "torus": lambda: trimesh.creation.torus(2, 0.5, major_sections=12, minor_sections=8),
        "capsule": lambda: trimesh.creation.capsule(1, 0.5, count=[8, 8]),
        "annulus": lambda: trimesh.creation.annulus(0.5, 1, 2, sections=9),
    }
    mesh = makers[make]()
    mesh.export(tmp_path / f"theirs{suffix}")
    read = read_mesh(tmp_path / f"theirs{suffix}")
    true = turned(np.asarray(mesh.vertices)[mesh.faces].round(4))
    np.testing.assert_allclose(turned(read.vertices[read.faces].round(4)), true, atol=2e-4)
    write_mesh(tmp_path / f"ours{suffix}", Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)))
    again = trimesh.load(tmp_path / f"ours{suffix}", process=False)
    np.testing.assert_allclose(turned(np.asarray(again.vertices)[again.faces].round(4)), true, atol=2e-4)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("v 0 0 0\nv 1 0 0\nf -1 -2 -3\nv 0 1 0\n", "'f -1 -2 -3' is no face; .* of the 2 before it"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "'f 0 1 2' is no face"),
        ("v 0 0 0\nv\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a line has 'v' and no numbers"),
    ],
)
def test_obj_indices_that_mean_no_vertex(tmp_path: Path, text: str, found: str) -> None:
    (tmp_path / "m.obj").write_text(text)
    with pytest.raises(ValueError, match=f"m.obj: {found}"):
        read_mesh(tmp_path / "m.obj")
