"""`pnu normals` on real files: the same points with normals, whatever decides their side."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from bench.scenes import rescanned_room
from pnu.commands.normals import main
from pnu.geometry.mesh_sampling import signed_volume
from pnu.io import read_cloud, read_mesh, write_cloud
from pnu.io.sensor import sight_of
from pnu.runtime.system_libraries import open3d_error
from tests.refusals import ran, refused

Array = np.ndarray
RNG = np.random.default_rng(0)
BALL = RNG.normal(size=(600, 3))
BALL /= np.linalg.norm(BALL, axis=1, keepdims=True)
SIGN = np.where(RNG.random(600) < 0.3, -1.0, 1.0)
CENTER = np.array([447321.25, 5411934.5, 313.0])
OUTWARD = "normals: 600 estimated; side: outward, by the winding field"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a ball whose normals contradict each other, far from the origin, and one without normals."""
    monkeypatch.chdir(tmp_path)
    colors = RNG.integers(0, 256, (600, 3)).astype(np.uint8)
    attributes = {"colors": colors, "intensity": np.arange(600, dtype=np.uint16), "label": np.arange(600) % 7 - 3.5}
    write_cloud("mixed.ply", BALL + CENTER, BALL * SIGN[:, None], attributes)
    write_cloud("bare.ply", BALL + CENTER)
    return tmp_path


def outward(name: str) -> float:
    """Of a ball's normals, the share that looks out."""
    cloud = read_cloud(name)
    assert cloud.normals is not None
    return float((((cloud.points - CENTER) * cloud.normals).sum(1) > 0).mean())


def test_the_same_points_in_the_same_order_with_all_that_the_file_says(place: Path) -> None:
    done = ran(main, place, "input=mixed.ply", "output=out.ply")
    assert done.returncode == 0, done.stderr
    before, after = read_cloud("mixed.ply"), read_cloud("out.ply")
    np.testing.assert_array_equal(after.points, before.points)
    assert after.attributes.keys() == before.attributes.keys() == {"colors", "intensity", "label"}
    for name, values in before.attributes.items():
        np.testing.assert_array_equal(after.attributes[name], values)
    assert before.normals is not None
    assert after.normals is not None
    np.testing.assert_allclose(np.abs((after.normals * before.normals).sum(1)), 1, atol=1e-6)
    assert outward("out.ply") == 1
    lines = done.stdout.splitlines()
    assert lines[0] == "input:   mixed.ply, 600 points, with normals"
    assert re.fullmatch(
        rf"normals: 600 given, {(SIGN < 0).sum()} of them turned over \(4\d% of neighbors contradicted each "
        r"other\); side: outward, by the winding field",
        lines[1],
    )
    assert lines[2].startswith("output:  out.ply, 600 points with unit normals, ")
    assert lines[3] == "next:    pnu upsample input=out.ply output=dense.ply"


SIDES = {
    "the file's, repaired": ("mixed.ply", [], "600 given, ", 1.0),
    "the file's as they are": ("mixed.ply", ["normals=keep"], "none of them turned over", (SIGN > 0).mean()),
    "all estimated": ("mixed.ply", ["normals=estimate"], "600 estimated; side: outward, by the winding field", 1.0),
    "of a room": ("bare.ply", ["side=in"], "600 estimated; side: inward, side=in", 0.0),
    "outward": ("mixed.ply", ["side=out"], "side: outward, side=out", 1.0),
    "a sensor inside": ("bare.ply", ["viewpoint=447321.25,5411934.5,313"], "side: towards the sensor at 4473", 0.0),
    "a sensor outside": ("mixed.ply", ["viewpoint=[447321,5411934,320]"], "side: towards the sensor at 447321,", 1.0),
    "from above": ("bare.ply", ["up=z"], "side: up=z", None),
    "from below": ("mixed.ply", ["up=-z"], "side: up=-z", None),
    "from the side": ("mixed.ply", ["up=x", "normals=orient"], "side: up=x", None),
}


@pytest.mark.parametrize("case", SIDES)
def test_each_key_decides_the_side_and_it_is_said(place: Path, case: str, capsys: pytest.CaptureFixture[str]) -> None:
    name, keys, words, share = SIDES[case]
    main([f"input={name}", "output=out.ply", *keys])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("normals: ")]
    assert words in line
    if share is not None:
        assert outward("out.ply") == pytest.approx(share)
    else:
        axis = {"z": [0, 0, 1], "-z": [0, 0, -1], "x": [1, 0, 0]}[keys[0].removeprefix("up=")]
        normals = read_cloud("out.ply").normals
        assert normals is not None
        up = normals @ np.array(axis)
        assert (up[np.abs(up) > 0.5] > 0).all()


def test_normals_that_agree_stay_and_what_the_file_says_of_its_sensor_is_for_others(place: Path) -> None:
    write_cloud("inward.ply", BALL + CENTER, -BALL)
    main(["input=inward.ply", "output=out.ply", "quiet=true"])
    assert outward("out.ply") == 0
    main(["input=inward.ply", "output=out.ply", "normals=orient", "quiet=true"])
    assert outward("out.ply") == 1
    some = np.where(np.arange(600)[:, None] % 3 == 0, np.nan, -BALL)
    write_cloud("some.ply", BALL + CENTER, some)
    main(["input=some.ply", "output=out.ply", "quiet=true"])
    assert outward("out.ply") == 0


def pcd(viewpoint: str, comment: str = "") -> bytes:
    head = f"{comment}VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 600\nHEIGHT 1\n"
    return f"{head}VIEWPOINT {viewpoint}\nPOINTS 600\nDATA binary\n".encode() + BALL.astype("<f4").tobytes()


@pytest.mark.parametrize(
    ("viewpoint", "comment", "expected"),
    [
        ("0 0 0 1 0 0 0", "", None),
        ("0 0 0.25 1 0 0 0", "", [0, 0, 0.25]),
        ("0 0 0 0.5 0.5 0.5 0.5", "", [0, 0, 0]),
        ("1 2 3 1 0 0 0", "# shift 100 200 300\n", [101, 202, 303]),
        ("1 2 3", "", None),
        ("a b c d e f g", "", None),
        ("nan 0 0 1 0 0 0", "", None),
    ],
)
def test_viewpoint_of_a_pcd(place: Path, viewpoint: str, comment: str, expected: list[float] | None) -> None:
    Path("c.pcd").write_bytes(pcd(viewpoint, comment))
    found = sight_of("c.pcd", {})
    if expected is None:
        assert found is None
    else:
        assert found is not None
        np.testing.assert_allclose(found.viewpoint, expected)


@pytest.mark.slow
def test_sensor_of_a_pcd_or_in_columns(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("c.pcd").write_bytes(pcd("0 0 0.25 1 0 0 0"))
    main(["input=c.pcd", "output=out.ply"])
    assert "600 estimated; side: towards the file's VIEWPOINT 0,0,0.25" in capsys.readouterr().out
    cloud = read_cloud("out.ply")
    assert ((cloud.points * cloud.normals).sum(1) < 0).all()
    sensors = 0.5 * BALL + CENTER  # each point from its own place inside
    sensors[5] = np.nan
    columns = dict(zip(("Sensor_X", "Sensor_Y", "Sensor_Z"), sensors.T, strict=True))
    write_cloud("c.ply", BALL + CENTER, None, columns)
    main(["input=c.ply", "output=out.ply"])
    assert "side: towards the sensors of Sensor_X Sensor_Y Sensor_Z" in capsys.readouterr().out
    cloud = read_cloud("out.ply")
    assert cloud.normals is not None
    assert outward("out.ply") == 0
    assert np.isnan(cloud.attributes["Sensor_X"][5])
    main(["input=c.ply", "output=out.ply", "side=out"])
    assert outward("out.ply") == 1


def las(path: str, **dimensions: object) -> None:
    """Hills, as a las file of an old format with these dimensions."""
    laspy = pytest.importorskip("laspy")
    xy = RNG.uniform(-50, 50, (600, 2))
    file = laspy.LasData(laspy.LasHeader(version="1.2", point_format=3))
    file.header.scales = [0.001] * 3
    file.x, file.y, file.z = xy[:, 0], xy[:, 1], 3 * np.sin(xy[:, 0] / 9) + 3 * np.sin(xy[:, 1] / 9)
    for name, values in dimensions.items():
        file[name] = np.broadcast_to(np.asarray(values), 600)
    file.write(path)


ANGLES = np.arange(600) % 41 - 20
LAS = {
    "angles": ({"scan_angle_rank": ANGLES, "return_number": 1, "number_of_returns": 1}, True),
    "returns": ({"number_of_returns": np.arange(600) % 3 + 1, "return_number": 1}, True),
    "neither": ({"number_of_returns": 1, "return_number": 1}, False),
    "looks around": ({"scan_angle_rank": np.arange(600) % 180 - 90, "number_of_returns": 2}, False),
}


@pytest.mark.parametrize("case", LAS)
def test_airborne_scans_are_seen_from_above(place: Path, case: str, capsys: pytest.CaptureFixture[str]) -> None:
    dimensions, from_above = LAS[case]
    las("c.las", **dimensions)
    main(["input=c.las", "output=out.ply"])
    assert ("side: up, as seen from the air" in capsys.readouterr().out) == from_above
    if from_above:
        normals = read_cloud("out.ply").normals
        assert normals is not None
        assert (normals[:, 2] > 0).all()


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_keeps_what_belongs_to_the_pulse(place: Path, suffix: str, capsys: pytest.CaptureFixture[str]) -> None:
    number = np.arange(600) % 4 + 1
    las(
        "c.las", scan_angle_rank=ANGLES, return_number=number, number_of_returns=4, user_data=np.arange(600) % 250,
        point_source_id=7326, scan_direction_flag=number % 2, key_point=number % 2, gps_time=np.arange(600) / 8,
        classification=number, intensity=number * 1000,
    )  # fmt: skip
    main(["input=c.las", f"output=out.{suffix}"])
    assert "'scan_angle_rank' is written as 'scan_angle'" in capsys.readouterr().out
    before, after = (read_cloud(name, pulses=True) for name in ("c.las", f"out.{suffix}"))
    np.testing.assert_allclose(0.006 * after.attributes.pop("scan_angle"), ANGLES, atol=0.003)
    np.testing.assert_array_equal(before.attributes.pop("scan_angle_rank"), ANGLES)
    assert after.attributes.keys() == before.attributes.keys()
    assert len(after.attributes) == 9
    for name, values in before.attributes.items():
        np.testing.assert_array_equal(after.attributes[name], values, err_msg=name)
    assert after.normals is not None
    assert sight_of(f"out.{suffix}", {}) is not None
    assert "return_number" not in read_cloud("c.las").attributes  # which means nothing between points


def test_a_las_dimension_of_few_bits_holds_no_larger_numbers(place: Path) -> None:
    pytest.importorskip("laspy")
    values = np.arange(600) % 100
    write_cloud("c.las", BALL, None, {"return_number": values.astype(np.uint8)})
    np.testing.assert_array_equal(read_cloud("c.las").attributes["return_number"], values)


BAD = {
    "viewpoint=1,2": "viewpoint=1,2: expected the place of the sensor, viewpoint=x,y,z",
    "viewpoint=5": "viewpoint=5: expected the place of the sensor, viewpoint=x,y,z",
    "viewpoint=a,b,c": "viewpoint=a,b,c: expected the place of the sensor, viewpoint=x,y,z",
    "viewpoint=no.txt": "no.txt: no such file",
    "viewpoint=nan,0,0": "viewpoint=nan,0,0: expected three numbers, found NaN",
    "up=w": "up=w: expected x, y, z, -x, -y or -z, the axis that points up",
    "side=left": "side=left: expected out or in, the side of closed shapes to look to",
    "up=z side=in": "up= and side=: both decide the side of normals; give one of them",
    "viewpoint=1,2,3 normals=keep": "viewpoint=1,2,3: decides nothing where normals=keep; take normals=orient",
    "normals=maybe": "normals=maybe: expected auto, orient, estimate or keep",
    "output=mixed.ply": "output=mixed.ply: is the input; give another name",
    "output=no/out.ply": "no/out.ply: the folder no does not exist; create it",
    "input=no.ply": "no.ply: no such file; give the path of a point cloud",
    "viewpiont=0": "unknown key 'viewpiont': did you mean 'viewpoint'?",
    "columns=x,y,z": "mixed.ply: has names for what it holds; columns= is for text and arrays without",
}


@pytest.mark.parametrize("keys", BAD)
def test_what_is_wrong_is_one_line(place: Path, keys: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(place.iterdir())
    given = {"input": "mixed.ply", "output": "out.ply"} | dict(key.split("=") for key in keys.split())
    assert refused(capsys, main, [f"{key}={value}" for key, value in given.items()]).startswith(f"error: {BAD[keys]}")
    assert sorted(place.iterdir()) == before


def notes(capsys: pytest.CaptureFixture[str], command: str, *keys: str) -> str:
    """The line on normals that a command prints; empty where there is none."""
    importlib.import_module(f"pnu.commands.{command}").main([*keys])
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if line.strip().startswith("normals: ")]
    assert len(lines) < 2
    return lines[0] if lines else ""


@pytest.mark.slow
def test_upsample_takes_the_same_keys(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys = ("output=dense.ply", "ratio=1.5", "outliers=keep")
    turned = f"normals: 600 given, {(SIGN < 0).sum()} of them turned over ("
    assert notes(capsys, "upsample", "input=mixed.ply", *keys).startswith(turned)
    assert outward("dense.ply") == 1
    assert notes(capsys, "upsample", "input=mixed.ply", "normals=keep", *keys) == ""
    assert outward("dense.ply") < 0.9
    line = notes(capsys, "upsample", "input=bare.ply", "viewpoint=447321.25,5411934.5,313", *keys)
    assert line == "normals: 600 estimated; side: towards the sensor at 447321.25,5411934.5,313"
    assert outward("dense.ply") == 0
    line = notes(capsys, "upsample", "input=mixed.ply", "up=z", "normals=orient", *keys)
    assert line.endswith("of them turned over; side: up=z")
    assert notes(capsys, "upsample", "input=bare.ply", *keys) == OUTWARD
    assert outward("dense.ply") == 1


@pytest.mark.slow
def test_upsample_takes_weights_for_estimated_normals_where_the_file_has_none(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    upsample = importlib.import_module("pnu.commands.upsample").main
    for keys in (["input=bare.ply"], ["input=bare.ply", "side=in"], ["input=mixed.ply", "normals=estimate", "up=z"]):
        upsample([*keys, "output=dense.ply", "ratio=1"])
        assert "run:    surface_estimated (comes with pnu)" in capsys.readouterr().out
    upsample(["input=mixed.ply", "side=in", "output=dense.ply", "ratio=1"])
    assert "run:    surface (comes with pnu)" in capsys.readouterr().out


@pytest.mark.slow
def test_what_a_las_says_is_enough_for_upsample(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    las("c.las", scan_angle_rank=ANGLES, return_number=1, number_of_returns=1)
    line = notes(capsys, "upsample", "input=c.las", "output=dense.ply", "ratio=2")
    assert line.endswith("estimated; side: up, as seen from the air (scan angles or several returns)")
    normals = read_cloud("dense.ply").normals
    assert normals is not None
    assert (normals[:, 2] > 0).all()
    assert set(read_cloud("dense.ply").attributes) <= {"intensity", "classification", "gps_time"}


@pytest.mark.skipif(bool(open3d_error()), reason="open3d's system libraries are missing")
@pytest.mark.slow
def test_reconstruct_and_scan_take_the_same_keys(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys = ("output=mesh.ply", "depth=5")
    line = notes(capsys, "reconstruct", "input=mixed.ply", *keys)
    assert line.startswith(f"normals: 600 given, {(SIGN < 0).sum()} of them turned over (")
    assert signed_volume(read_mesh("mesh.ply")) == pytest.approx(4 / 3 * np.pi, rel=0.1)
    line = notes(capsys, "reconstruct", "input=bare.ply", "viewpoint=447321.25,5411934.5,320", *keys)
    assert line == "normals: 600 estimated; side: towards the sensor at 447321.25,5411934.5,320"
    line = notes(capsys, "scan", "input=bare.ply", "side=out", "ratio=1", "cloud=dense.ply", *keys)
    assert line == "normals: 600 estimated; side: outward, side=out"
    assert outward("dense.ply") == 1
    assert notes(capsys, "scan", "input=bare.ply", "ratio=1", *keys) == OUTWARD


@pytest.mark.parametrize("command", ["upsample", "reconstruct", "scan"])
@pytest.mark.parametrize("keys", ["viewpoint=1,2", "up=w", "side=left", "up=z side=in"])
def test_other_commands_refuse_the_same(
    place: Path, command: str, keys: str, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["input=mixed.ply", "output=mesh.ply", *keys.split()]
    found = refused(capsys, importlib.import_module(f"pnu.commands.{command}").main, line)
    assert found.startswith(f"error: {BAD[keys]}")
    assert not Path("mesh.ply").exists()


def test_points_on_a_line_have_no_normals(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savetxt("line.xyz", np.arange(40)[:, None] * [1.0, 2, 3])
    line = refused(capsys, main, ["input=line.xyz", "output=out.ply"])
    assert line == "error: points: all 40 points lie on a line; expected points on a surface"


def test_what_cannot_be_used_is_left_out_and_said(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = np.hstack([BALL, BALL, np.arange(600)[:, None]])
    rows[7, 0] = np.nan
    np.savetxt("c.csv", np.vstack([rows, rows[20:30]]), delimiter=",", header="x,y,z,nx,ny,nz,number", comments="")
    main(["input=c.csv", "output=out.ply"])
    out = capsys.readouterr().out
    assert "1 of 610 points left out: NaN" in out
    assert "10 of 609 points left out: at the place of another" in out
    np.testing.assert_array_equal(read_cloud("out.ply").attributes["number"], np.delete(np.arange(600), 7))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("told", "side"),
    [
        (1, "towards the sensors of sensor_x sensor_y sensor_z"),
        (0, "towards the scanners of 2 scans, found by their points"),
    ],
)
def test_two_scans_of_a_room_look_into_it(tmp_path: Path, told: int, side: str) -> None:
    """From a file that says where each scan stood, or that has them moved already and only keeps them apart."""
    points, true, places, scans = rescanned_room()
    lines = []
    for number in (0, 1):
        rows = scans == number
        place = told * places[rows][0]
        head = [str(rows.sum()), "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0"]
        lines += [*head, " ".join(map(str, [*place, 1]))]
        lines += [f"{x:.6f} {y:.6f} {z:.6f} 0.5" for x, y, z in points[rows] - place]
    (tmp_path / "room.ptx").write_text("\n".join(lines))
    done = ran(main, tmp_path, "input=room.ptx", "output=out.ply")
    assert done.returncode == 0, done.stderr
    assert f"side: {side}" in done.stdout
    found = read_cloud(tmp_path / "out.ply")
    assert found.normals is not None
    assert ((found.normals * true).sum(1) > 0).mean() > 0.98
    assert set(found.attributes["scan"]) == {0, 1}


@pytest.mark.parametrize("timed", [True, False])
def test_the_way_of_a_scanner(tmp_path: Path, timed: bool) -> None:
    """A room in one cloud, and a file that says where the scanner was, when or not."""
    points, true, places, scans = rescanned_room()
    write_cloud(tmp_path / "room.ply", points, None, {"gps_time": 100.0 + 50 * scans + np.linspace(0, 40, len(scans))})
    stood = np.unique(places, axis=0)[[0, 0, 1, 1]]
    times = 100.0 + np.array([[0], [45], [60], [100]])
    way = np.hstack([times, stood]) if timed else stood
    (tmp_path / "way.txt").write_text("\n".join(" ".join(map(str, row)) for row in way))
    done = ran(main, tmp_path, "input=room.ply", "output=out.ply", "viewpoint=way.txt")
    assert done.returncode == 0, done.stderr
    words = "the sensor, which was where way.txt says it was at the time" if timed else "the 4 places of way.txt that"
    assert f"side: towards {words}" in done.stdout
    found = read_cloud(tmp_path / "out.ply").normals
    assert found is not None
    assert ((found * true).sum(1) > 0).mean() > 0.98
