"""Work shared by several processes: the same bits for any number, errors in one line, nothing left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from torch import nn

from pnu.runtime.workers import InProcess, Processes
from pnu.upsamplers import APSS, surface_projection
from pnu.upsamplers import patches as procedure
from pnu.upsamplers.whole_clouds import upsample
from tests.runtime.test_parts import patches, sphere

CLOUD = np.arange(12.0).reshape(4, 3)
REPOSITORY = Path(__file__).resolve().parents[2]


def begin(network: nn.Module, cloud: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return partial(work, cloud)


def work(cloud: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The points of a part, and who did it; negative parts are mishaps."""
    if part[0] == -1:
        raise ValueError("model: is damaged")
    if part[0] == -2:
        raise RuntimeError("out of memory\nand more")
    if part[0] == -3:
        os._exit(9)
    return np.concatenate([cloud[part], np.full((1, 3), os.getpid())])


@pytest.mark.slow
def test_order_errors_and_end() -> None:
    parts = list(np.arange(4).reshape(4, 1))
    with Processes(nn.Identity(), ["cpu", "cpu"]) as workers:
        for cloud in (CLOUD, -CLOUD, CLOUD):
            found = list(workers.map(begin, cloud, parts))
            expected = list(InProcess(nn.Identity()).map(begin, cloud, parts))
            assert [f[:1].tolist() for f in found] == [e[:1].tolist() for e in expected]
        pids = {int(f[1, 0]) for f in found}
        assert os.getpid() not in pids
        for number, message in (
            (-1, "^model: is damaged$"),
            (-2, "^cpu: RuntimeError: out of memory$"),
            (-3, "^devices=2: a process ended amid its work; "),
        ):
            with pytest.raises(ValueError, match=message) as error:
                list(workers.map(begin, CLOUD, [*parts, np.array([number]), *parts]))
            assert "\n" not in str(error.value)
    assert not any(alive(pid) for pid in pids)


@pytest.mark.parametrize("devices", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("model", ["surface", pytest.param("patches", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_the_number_of_devices_does_not_matter(model: str, devices: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_projection, "BATCHES", 1)  # many parts
    monkeypatch.setattr(procedure, "BATCHES", 2)
    points, network = sphere(1000), "surface" if model == "surface" else patches(64)
    one, several = (
        upsample(points, points, ratio=2, model=network, device="cpu", devices=number) for number in (1, devices)
    )
    np.testing.assert_array_equal(one, several)


def test_what_cannot_be_shared() -> None:
    points = sphere(30)
    with pytest.raises(ValueError, match=r"^devices=2: APSS works in one process; leave devices=1$"):
        upsample(points, points, model=APSS(), devices=2)
    with pytest.raises(ValueError, match=r"^devices=0: expected a whole number >= 1$"):
        upsample(points, points, model="surface", devices=0)


SCRIPT = """
import sys
import torch
from pnu.upsamplers.whole_clouds import upsample
from tests.runtime.test_workers import sphere
def say(stage, done, total):
    if stage == "projection" and done:
        print("works", flush=True)
if __name__ == "__main__":
    points = sphere(60_000)
    upsample(points, points, model="surface", device="cpu", devices=2, progress=say)
"""


@pytest.mark.slow
@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_orphans(blow: signal.Signals, tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "script.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path,
        env=environment, start_new_session=True,
    ) as process:  # fmt: skip
        assert process.stdout
        assert process.stdout.readline() == "works\n"
        children = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
        assert len(children) >= 2
        if blow is signal.SIGINT:
            os.killpg(process.pid, blow)  # as a terminal does
        else:
            process.send_signal(blow)
        process.wait(60)
        deadline = time.monotonic() + 20
        while any(alive(pid) for pid in children) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not any(alive(pid) for pid in children)
        if blow is signal.SIGINT:
            assert process.stderr
            assert process.stderr.read().count("Traceback") == 1  # the caller's own


def alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"
