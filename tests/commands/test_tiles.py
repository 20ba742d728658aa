"""`pnu upsample` of clouds in tiles: within a memory, in jobs, and what it refuses."""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from pnu.commands import _tiles
from pnu.commands.upsample import main
from pnu.config.compose import parse
from pnu.config.quoting import override
from pnu.io import read_cloud, write_cloud
from tests.io.test_point_stream import write_copc
from tests.refusals import ran, refused

NASTY = "it's a=b, (c)"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a cloud of 300 points with intensities, of which tiles hold 160, as of a large one."""
    xy = np.random.default_rng(0).uniform(0, 17, (300, 2))
    points = np.column_stack([xy, np.sin(xy[:, 0] / 9)])
    write_cloud(tmp_path / "cloud.ply", points, None, {"intensity": np.arange(300, dtype=np.uint16)})
    monkeypatch.setattr(_tiles, "tile_size", lambda memory, ratio: 160)
    return tmp_path


def tiled(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return ran(main, place, "input=cloud.ply", "ratio=2", "up=z", *arguments)


def test_a_cloud_within_a_memory(place: Path) -> None:
    (place / NASTY).mkdir()
    done = tiled(place, override("output", f"{NASTY}/dense.ply"), "memory=4GiB")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "input:  cloud.ply, 300 points, normals estimated and oriented"
    assert lines[1] == "run:    surface_estimated"
    assert lines[2].startswith("tiles:  2, of at most 150 points and a margin of ")
    assert lines[3] == "        carried over: intensity"
    assert lines[4].startswith(f"output: {NASTY}/dense.ply, 600 points with unit normals, ")
    following, program, verb, *arguments = shlex.split(lines[5])
    assert (following, program, verb) == ("next:", "pnu", "reconstruct")
    assert [one.value() for one in parse(arguments)] == [f"{NASTY}/dense.ply", "mesh.ply"]
    cloud = read_cloud(place / NASTY / "dense.ply")
    assert len(cloud.points) == 600
    assert cloud.normals is not None
    assert (cloud.normals[:, 2] > 0).all()
    assert set(cloud.attributes) == {"intensity"}
    assert [path.name for path in (place / NASTY).iterdir()] == ["dense.ply"]


@pytest.mark.slow
def test_tiles_as_jobs_give_the_same_bits(place: Path) -> None:
    assert tiled(place, "output=whole.ply", "tiles=all", "quiet=true").returncode == 0
    (place / NASTY).mkdir()
    done = tiled(place, "-m", override("output", f"{NASTY}/jobs.ply"), "tiles=all")
    assert done.returncode == 0, done.stderr
    done_by_jobs = [line.partition(", ")[0] for line in done.stdout.splitlines() if line.startswith("tile ")]
    both = ["tile 0 of 2", "tile 1 of 2"]
    assert done_by_jobs == [f"{tile}: {what}" for what in ("prepared", "made") for tile in both]
    assert (place / NASTY / "jobs.ply").read_bytes() == (place / "whole.ply").read_bytes()
    assert [path.name for path in (place / NASTY).iterdir()] == ["jobs.ply"]


@pytest.mark.slow
def test_single_tiles_by_hand(place: Path) -> None:
    done = tiled(place, "output=dense.ply", "tiles=1")
    assert done.returncode == 2
    assert "error: tiles=1: there is no plan in dense.ply.parts/tiles_" in done.stderr
    assert "begin with tiles=plan and the same keys" in done.stderr
    assert "        numbers 0 1" in tiled(place, "output=dense.ply", "tiles=plan").stdout
    assert tiled(place, "output=dense.ply", "tiles=1").stdout.startswith("tile 1 of 2: prepared, ")
    assert tiled(place, "output=dense.ply", "tiles=1").stdout.startswith("tile 1 of 2: is prepared, others are not yet")
    assert tiled(place, "output=dense.ply", "tiles=0").stdout.startswith("tile 0 of 2: prepared, ")
    assert tiled(place, "output=dense.ply", "tiles=1").stdout.startswith("tile 1 of 2: made, ")
    assert "tiles=7: expected one of 2 tiles, 0 to 1" in tiled(place, "output=dense.ply", "tiles=7").stderr
    assert tiled(place, "output=dense.ply", "tiles=all").returncode == 0
    assert len(read_cloud(place / "dense.ply").points) == 600


@pytest.mark.slow
def test_copc_gives_what_plain_laz_gives(place: Path) -> None:
    laspy = pytest.importorskip("laspy")
    points = write_copc(place / "cloud.copc.laz", read_cloud(place / "cloud.ply").points)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 1e-3)
    plain = laspy.LasData(header)
    plain.xyz = points
    plain.write(place / "cloud.laz")
    for name in ("cloud.copc", "cloud"):
        done = tiled(place, f"input={name}.laz", f"output={name}.npy", "memory=4GiB")
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[2].startswith("tiles:  2, ")
    dense = np.load(place / "cloud.copc.npy")
    assert dense.shape == (600, 6)
    np.testing.assert_array_equal(dense, np.load(place / "cloud.npy"))


BAD = {
    "memory=much": "memory=much: expected a size such as 4GiB or 1500MiB",
    "memory=100MiB": "memory=100MiB: is too little for this ratio; expected at least ",
    "memory=4GiB holes=1": "holes=1.0: takes the cloud as a whole; leave it out, or memory= and tiles=",
    "memory=4GiB merge=agreed": "merge=agreed: takes the cloud as a whole; leave it out, or memory= and tiles=",
    "memory=4GiB devices=2": "devices=2: takes the cloud as a whole; leave it out, or memory= and tiles=",
    "memory=4GiB run=apss": "run=apss: takes the cloud as a whole, without memory= and tiles=; surface takes tiles",
    "memory=4GiB output=a.xyz": "a.xyz: .xyz is not written in parts, as memory= and tiles= want it; take one of",
    "memory=4GiB input=no.las": "no.las: no such file; give the path of a point cloud",
    "memory=4GiB input=no.xyz": "no.xyz: .xyz is not read in slices, as memory= and tiles= want it; save it as one of",
    "tiles=some": "tiles=some: expected all, plan or the number of a tile",
    "-m tiles=all ratio=2,3": "tiles=all: makes the jobs of one run; give each key one value",
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(
    tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("cloud.npy", np.random.default_rng(0).normal(size=(100, 3)))
    given = {"input": "cloud.npy", "output": "dense.ply"}
    given |= dict(word.split("=") for word in case.split() if word != "-m")
    line = refused(capsys, main, [*["-m"] * ("-m" in case), *(f"{key}={value}" for key, value in given.items())])
    assert line.startswith(f"error: {BAD[case]}")
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.npy"]


def test_memory_sets_the_size_of_tiles() -> None:
    small, large = _tiles.tile_size("2GiB", 4), _tiles.tile_size("4 gb", 4)
    assert 3 * small > large > 2 * small
    assert _tiles.tile_size("4096MiB", 4) == large
    assert _tiles.tile_size("4GiB", 1) > large


def small_memory() -> str:
    """The smallest that is accepted: tiles of a thousand points."""
    for size in range(500, 2000, 10):
        with contextlib.suppress(ValueError):
            _tiles.tile_size(f"{size}MiB", 1)
            return f"memory={size}MiB"
    raise AssertionError


LAUNCHERS = {
    "joblib": ("loky.backend.popen_loky", ["hydra.launcher.n_jobs=2"]),
    "submitit_local": ("submitit.core._submit", []),
}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_worker_that_is_killed_changes_nothing(tmp_path: Path, launcher: str) -> None:
    pytest.importorskip({"submitit_local": "submitit"}.get(launcher, launcher))
    worker, options = LAUNCHERS[launcher]
    with one_worker_killed(tmp_path, [f"hydra/launcher={launcher}", *options], worker) as (whole, jobs, _):
        np.testing.assert_array_equal(jobs, whole)


@pytest.mark.slow
def test_a_worker_of_a_ray_cluster_that_is_killed_changes_nothing(tmp_path: Path) -> None:
    """Ray gives its job to another one, so that the command itself has nothing left to do."""
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    place = tmp_path / "place"
    place.mkdir()
    with (
        ray_cluster() as (cluster, address),
        one_worker_killed(place, ["hydra/launcher=ray"], "ray::_run_job", cluster, RAY_ADDRESS=address) as found,
    ):
        whole, jobs, said = found
        np.testing.assert_array_equal(jobs, whole)
        assert "ended early" not in said
        assert "made, " in said


@contextlib.contextmanager
def one_worker_killed(
    place: Path, launcher: Sequence[str], worker: str, cluster: int | None = None, **environment: str
) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
    """Points of a single process, those by a launcher of whose workers one is killed, and what was said.

    worker: words in the line of its process; cluster: the process whose descendants workers are, the command's without.
    """
    xy = np.random.default_rng(0).uniform(0, 70, (5000, 2))
    np.save(place / "cloud.npy", np.column_stack([xy, np.sin(xy[:, 0] / 9)]))
    keys = [sys.executable, "-m", "pnu", "upsample", "input=cloud.npy", "ratio=1", "up=z", small_memory()]
    subprocess.run([*keys, "output=whole.npy", "quiet=true"], cwd=place, check=True)
    command = [*keys, "-m", "output=jobs.npy", "tiles=all", *launcher]
    given = {**os.environ, **environment}
    with subprocess.Popen(
        command, cwd=place, env=given, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as child:
        assert child.stdout is not None
        while child.poll() is None and not list(place.glob("jobs.npy.parts/tiles_*/share_*")):
            time.sleep(0.05)
        workers = [pid for pid in descendants(cluster or child.pid) if worker in command_line(pid)]
        if workers:
            os.kill(workers[-1], signal.SIGKILL)
        said = child.stdout.read()
    assert workers, said
    assert child.returncode == 0, said
    yield np.load(place / "whole.npy"), np.load(place / "jobs.npy"), said
    assert sorted(path.name for path in place.iterdir()) == ["cloud.npy", "jobs.npy", "whole.npy"]


@contextlib.contextmanager
def ray_cluster() -> Iterator[tuple[int, str]]:
    """A cluster of two workers that runs in a folder of its own: its process and its address."""
    start = "ray start --head --block --port=0 --num-cpus=2 --include-dashboard=false --disable-usage-stats"
    given = {**os.environ, "RAY_agent_register_timeout_ms": "300000"}  # a busy machine takes its time
    with tempfile.TemporaryDirectory() as folder:  # a path short enough for sockets
        command = [str(Path(sys.executable).with_name("ray")), *start.split()[1:], f"--temp-dir={folder}"]
        with subprocess.Popen(
            command, cwd=folder, env=given, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as child:
            assert child.stdout is not None
            try:
                told = ""
                while not (found := re.search(r"ray start --address='([^']+)'", told)):
                    line = child.stdout.readline()
                    assert line, told
                    told += line
                yield child.pid, found[1]
            finally:
                started = descendants(child.pid)
                child.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.communicate(timeout=60)
                for pid in [child.pid, *started]:
                    if "ray" in command_line(pid):
                        with contextlib.suppress(OSError):
                            os.kill(pid, signal.SIGKILL)


def descendants(pid: int) -> list[int]:
    """The processes that a process has started, and those that they have."""
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in map(int, path.read_text().split()):
                found += [child, *descendants(child)]
    return found


def command_line(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    return ""
