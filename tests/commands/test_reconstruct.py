"""The commands reconstruct and picture on real files."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnu.commands import picture, reconstruct
from pnu.data import shapes
from pnu.geometry.mesh_sampling import sample_area, signed_volume
from pnu.geometry.normal_estimation import estimate_normals
from pnu.io import Mesh, read_cloud, read_json, read_mesh, write_cloud, write_mesh
from tests import refusals
from tests.geometry.test_depth_steps import off_sphere, seen_sphere, stepped
from tests.reconstruction.test_surfaces import icosphere, sphere_points


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a cloud with colors, its true mesh, and the mesh that the command makes of them."""
    folder = tmp_path_factory.mktemp("surface")
    cloud = sphere_points(1500)
    colors = np.where(cloud[:, :1] > 0, [[200, 30, 30]], [[30, 30, 200]]).astype(np.uint8)
    write_cloud(folder / "cloud.ply", cloud[:, :3], cloud[:, 3:], {"colors": colors})
    write_mesh(folder / "truth.ply", icosphere())
    run(reconstruct, input=folder / "cloud.ply", output=folder / "mesh.ply", truth=folder / "truth.ply")
    return folder


def run(command, **keys: object) -> None:  # type: ignore[no-untyped-def]
    command.main([f"{key}={value}" for key, value in keys.items()])


def refused(capsys: pytest.CaptureFixture[str], command, **keys: object) -> str:  # type: ignore[no-untyped-def]
    """The line that the command ends with, exit code 2."""
    before = set(Path(str(keys.get("output", "."))).parent.glob("*"))
    line = refusals.refused(capsys, command.main, [f"{key}={value}" for key, value in keys.items()])
    assert set(Path(str(keys.get("output", "."))).parent.glob("*")) == before
    return line


def test_mesh_and_its_errors(folder: Path) -> None:
    mesh, stored = read_mesh(folder / "mesh.ply"), read_cloud(folder / "mesh.ply")
    assert signed_volume(mesh) == pytest.approx(4 / 3 * np.pi, rel=0.02)
    distance = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1)
    np.testing.assert_allclose(stored.attributes["quality"], distance, atol=5e-3)
    best, worst = (f(stored.attributes["quality"]) for f in (np.argmin, np.argmax))
    colors = stored.attributes["colors"].astype(int)
    assert colors[best].argmax() == 0
    assert colors[worst].argmax() == 2
    assert stored.normals is not None
    report = read_json(folder / "mesh.json")
    assert report["to_truth_mean"] == pytest.approx(stored.attributes["quality"].mean(), rel=1e-4)
    assert {"to_truth_rms", "to_truth_max", "from_truth_mean", "from_truth_max", "normal_deg_mean", "depth"} <= set(
        report
    )


@pytest.mark.slow
def test_axes_of_plane_fits_are_found_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where the edges of a bracket are, the surface is nearer to the truth."""
    shape = shapes.make("bracket")
    cloud = sample_area(shape, 2000, np.random.default_rng(0))
    planes = estimate_normals(cloud[:, :3], orient=False)
    planes *= np.sign((planes * cloud[:, 3:]).sum(1, keepdims=True))
    write_cloud(tmp_path / "cloud.ply", cloud[:, :3], planes)
    write_mesh(tmp_path / "truth.ply", shape)
    errors, keys = {}, {"input": tmp_path / "cloud.ply", "truth": tmp_path / "truth.ply"}
    for choice in ("auto", "keep"):
        run(reconstruct, output=tmp_path / f"{choice}.ply", normals=choice, **keys)
        said = capsys.readouterr().out
        assert ("axes are found anew" in said) == (choice == "auto")
        errors[choice] = read_json(tmp_path / f"{choice}.json")["to_truth_mean"]
    assert errors["auto"] < 0.85 * errors["keep"]


@pytest.mark.slow
def test_colors_of_the_cloud_and_trimming(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(reconstruct, input=folder / "cloud.ply", output=tmp_path / "a.ply", depth=5, trim=0.2)
    said = capsys.readouterr().out
    mesh = read_cloud(tmp_path / "a.ply")
    assert f"vertices before, {len(mesh.points)} after" in said
    red = mesh.attributes["colors"][:, 0] > 120
    np.testing.assert_array_equal(
        red[np.abs(mesh.points[:, 0]) > 0.2], (mesh.points[:, 0] > 0)[np.abs(mesh.points[:, 0]) > 0.2]
    )


def test_normals_are_estimated_where_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cloud(tmp_path / "bare.xyz", sphere_points(1500)[:, :3])
    run(reconstruct, input=tmp_path / "bare.xyz", output=tmp_path / "bare.stl", quiet=True)
    assert capsys.readouterr().out == ""
    assert signed_volume(read_mesh(tmp_path / "bare.stl")) == pytest.approx(4 / 3 * np.pi, rel=0.03)


@pytest.mark.slow
def test_open_truth_and_inward_normals_are_said(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = sphere_points(800)
    write_cloud(tmp_path / "in.ply", cloud[:, :3], -cloud[:, 3:])
    truth = icosphere()
    write_mesh(tmp_path / "open.ply", Mesh(truth.vertices, truth.faces[1:]))
    run(
        reconstruct,
        input=tmp_path / "in.ply",
        output=tmp_path / "out.ply",
        truth=tmp_path / "open.ply",
        colormap="perceptual",
    )
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "open.ply: is not watertight (3 open edges)" in said[0]
    assert "normals look inward" in said[1]


@pytest.mark.slow
@pytest.mark.parametrize("keys", [{"viewpoint": "0,0,0"}, {"side": "in"}])
def test_what_was_seen_from_within_looks_inward(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: dict[str, str]
) -> None:
    cloud = sphere_points(800)
    write_cloud(tmp_path / "in.ply", cloud[:, :3], cloud[:, 3:] if "side" in keys else None)
    run(reconstruct, input=tmp_path / "in.ply", output=tmp_path / "out.ply", **keys)
    assert "inward" not in capsys.readouterr().err
    assert signed_volume(read_mesh(tmp_path / "out.ply")) == pytest.approx(-4 / 3 * np.pi, rel=0.05)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"output": "a.txt"}, r"a\.txt: expected a mesh, one of \.obj"),
        ({"output": "cloud.ply"}, "is the input"),
        ({"output": "none/a.ply"}, "does not exist"),
        ({"input": "none.ply"}, "none.ply"),
        ({"truth": "far.ply"}, "is not in the frame of"),
        ({"truth": "none.ply"}, "none.ply"),
        ({"depth": 99}, "depth=99: expected 1 to 16"),
        ({"depth": "deep"}, "depth=deep"),
        ({"trim": 1.5}, "trim=1.5: expected a share"),
        ({"limit": -1}, "limit=-1: expected a distance above 0"),
        ({"colormap": "jet"}, "colormap=jet: expected error or perceptual"),
        ({"normals": "none"}, "normals=none: expected auto, orient, estimate or keep"),
        ({"timeout": 0.01}, "took longer than timeout=0.01 seconds"),
        ({"trum": 0}, "did you mean 'trim'"),
    ],
)
def test_reconstruct_refuses(folder: Path, keys: dict, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_mesh(folder / "far.ply", Mesh(icosphere().vertices * 1000, icosphere().faces))
    keys = {"input": "cloud.ply", "output": "new.ply"} | keys
    paths = {name: folder / value for name, value in keys.items() if name in ("input", "output", "truth")}
    assert re.search(message, refused(capsys, reconstruct, **keys | paths))


def test_picture_of_files(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ",".join(str(folder / name) for name in ("cloud.ply", "mesh.ply", "truth.ply"))
    run(picture, inputs=f"[{files}]", output=tmp_path / "a.png", size=100)
    said = capsys.readouterr().out
    assert "cloud.ply (cloud, color=stored)" in said
    assert "mesh.ply (mesh, color=quality)" in said
    assert "truth.ply (mesh, color=plain)" in said
    image = np.asarray(Image.open(tmp_path / "a.png")).astype(int)
    height, width = image.shape[:2]
    assert width > 2.5 * height
    plain = image[:, int(0.62 * width) : int(0.8 * width)]
    assert np.ptp(plain, axis=2).max() < 20  # the true surface is gray
    run(picture, inputs=f"[{files}]", output=tmp_path / "b.png", size=100, color="plain", panels=1, captions="[a,b,c]")
    tall = np.asarray(Image.open(tmp_path / "b.png"))
    assert tall.shape[0] > 2.5 * tall.shape[1]
    assert np.ptp(tall.astype(int), axis=2).max() < 40


def test_a_whole_turn_is_an_animation(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(picture, inputs=f"[{folder}/cloud.ply,{folder}/mesh.ply]", output=tmp_path / "a.webp", size=60, frames=3)
    assert "a.webp, 3 pictures of " in capsys.readouterr().out
    with Image.open(tmp_path / "a.webp") as turning:
        assert (turning.n_frames, turning.info["loop"]) == (3, 0)
        frames = []
        for number in range(3):
            turning.seek(number)
            frames.append(np.asarray(turning.convert("L")).astype(int))
    assert all(np.abs(a - b).mean() > 1 for a, b in itertools.pairwise(frames))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"inputs": "[]"}, "expected one file or more"),
        ({"output": "a.webp"}, r"ends in \.png; frames=36 makes an animated \.webp"),
        ({"frames": 8}, r"ends in \.webp; frames=8 are an animation"),
        ({"frames": 0}, "frames=0: expected 1 to 360"),
        ({"output": "a.jpg"}, r"ends in \.png"),
        ({"captions": "[a,b]"}, "found 2 for 1 inputs"),
        ({"fit": 2}, "fit=2: expected a panel, 1 to 1"),
        ({"color": "quality"}, "holds nothing for color=quality"),
        ({"color": "pink"}, "color=pink: expected one of auto"),
        ({"up": "w"}, "up='w'"),
        ({"size": 5}, "size=5: expected 16 to 4096"),
        ({"limit": 0}, "limit=0: expected a number above 0"),
    ],
)
def test_picture_refuses(
    folder: Path, tmp_path: Path, keys: dict, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = {"inputs": f"[{folder / 'truth.ply'}]", "output": "a.png"} | keys
    line = refused(capsys, picture, **keys | {"output": tmp_path / keys["output"]})
    assert re.search(message, line)


@pytest.mark.slow
def test_a_cloud_whose_every_point_is_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cloud(tmp_path / "c.ply", *np.hsplit(np.repeat(sphere_points(300), 20, 0), 2))
    run(reconstruct, input=tmp_path / "c.ply", output=tmp_path / "m.ply")
    said = capsys.readouterr().out
    assert "c.ply, 300 points, with normals\n        5700 of 6000 points left out: at the place of another\n" in said
    assert "depth 5," in said  # 11, the deepest, where the spacing seemed zero


@pytest.mark.slow
def test_columns_of_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, normals = np.hsplit(sphere_points(300), 2)
    np.savetxt(tmp_path / "c.txt", np.hstack([normals, np.ones((300, 1)), points]))
    given = {"input": tmp_path / "c.txt", "output": tmp_path / "m.ply", "depth": 4}
    run(reconstruct, **given, columns="nx,ny,nz,_,x,y,z")
    said = capsys.readouterr().out
    assert "c.txt, 300 points, with normals\noutput:" in said
    assert said.endswith("""output=picture.png 'columns="nx,ny,nz,_,x,y,z"'\n""")  # the picture reads that file too
    line = refused(capsys, reconstruct, **given | {"output": tmp_path / "n.ply"}, columns="nx,ny,nz,x,y,z")
    assert "columns=nx,ny,nz,x,y,z are 6 names, line 1 has 7 columns" in line


@pytest.mark.slow
def test_steps_of_depth_are_no_terraces_of_the_surface(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    true = seen_sphere(80)[0]
    points = stepped(true, 0.06)
    write_cloud(tmp_path / "scan.ply", points, [0, 0, 3] - true)
    off = {}
    for normals in ("keep", "auto"):
        run(reconstruct, input=tmp_path / "scan.ply", output=tmp_path / f"{normals}.ply", normals=normals, depth=6)
        assert ("steps of depth of about 0.06" in capsys.readouterr().out) == (normals == "auto")
        off[normals] = off_sphere(read_mesh(tmp_path / f"{normals}.ply").vertices)
    assert off["auto"] < 0.7 * off["keep"]
