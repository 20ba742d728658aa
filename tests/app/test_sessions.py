"""Sessions of `pnu app` without a browser: names, keys, files that are theirs, uploads, processes that end."""

import http.client
import json
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pnu.app.app_server import AppServer, app_server
from pnu.app.jobs import Job, WorkerPool
from pnu.app.sessions import Sessions, checked_keys, plain_name

LOOK = {"points": 3, "proposal": {}, "made": {"stray": 0}}
WORKER = f"""
import json, pathlib, sys, time
order = json.loads(sys.stdin.readline())
folder = pathlib.Path(order["folder"])
print(json.dumps({{"stage": "normals", "done": 1, "total": 2}}), flush=True)
if "slow" in order.get("scan", ""):
    time.sleep(60)
if "crash" in order.get("scan", ""):
    sys.exit(3)
if "bad" in order.get("scan", ""):
    print(json.dumps({{"error": "bad.ply: is damaged"}}), flush=True)
else:
    for name in filter(None, [order.get("view"), order.get("cloud"), order.get("mesh"), order.get("target")]):
        (folder / name).write_text(name)
    print(json.dumps({{"result": {LOOK}}}), flush=True)
"""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[AppServer]:
    """The app, with processes that only say that they did it."""
    workers = WorkerPool([sys.executable, "-ISc", WORKER])
    server = app_server(0, Sessions(tmp_path, workers), 1000)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()
    workers.end()


def asked(server: AppServer, method: str, path: str, body: bytes | None = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    connection.request(method, path, body)
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def user(server: AppServer, scan: str = "scan.ply") -> str:
    """The path of a session whose scan has been looked at."""
    path = f"/s/{json.loads(asked(server, 'POST', '/sessions')[1])['token']}"
    assert asked(server, "PUT", f"{path}/scan?name={scan}", b"ply")[0] == 200
    finished(server, path)
    return path


def finished(server: AppServer, path: str) -> dict[str, Any]:
    """The state once the job has ended."""
    session = server.sessions.get(path.split("/")[2])
    assert session is not None
    assert session.job is not None
    assert session.job.ended.wait(20)
    for _ in range(200):
        state: dict[str, Any] = json.loads(asked(server, "GET", f"{path}/state")[1])
        if state["phase"] not in ("looking", "working"):
            return state
    raise AssertionError(state)


def test_a_name_is_a_name_and_no_path() -> None:
    assert plain_name("../../etc/passwd.ply") == "passwd.ply"
    assert plain_name("C:\\scans\\a.ply") == "a.ply"
    assert plain_name(".hidden.ply") == "hidden.ply"
    assert plain_name('a:b|"c".ply') == "a_b__c_.ply"
    assert plain_name("..") == "scan"


def test_keys_that_are_the_default_are_left_out() -> None:
    assert checked_keys({"ratio": "4", "normals": "auto", "holes": None, "surface": True}) == {}
    assert checked_keys({"ratio": 2.5, "holes": "0.1", "up": "z"}) == {"ratio": 2.5, "up": "z", "holes": 0.1}
    assert checked_keys({"spacing": "0.01", "ratio": "8"}) == {"spacing": 0.01}
    refused = (
        {"normals": "x,run=evil"},
        {"ratio": "4 run=x"},
        {"density": ["even"]},
        {"ratio": "nan"},
        {"holes": "inf"},
    )
    for wanted in refused:
        with pytest.raises(ValueError, match="expected"):
            checked_keys(wanted)


def test_a_result_is_downloaded_by_its_user_alone(server: AppServer) -> None:
    one, two = user(server), user(server)
    assert asked(server, "POST", f"{one}/make", b'{"ratio": 2, "surface": true}')[0] == 200
    state = finished(server, one)
    assert state["phase"] == "done"
    assert state["command"][0].startswith("pnu upsample input=scan.ply output=scan_dense.ply ratio=2")
    assert asked(server, "GET", f"{one}/file/scan_dense.ply") == (200, b"scan_dense.ply")
    assert asked(server, "GET", f"{one}/file/scan_surface.obj") == (200, b"scan_surface.obj")  # written when asked for
    assert asked(server, "GET", f"{two}/file/scan_dense.ply")[0] == 400
    for name in ("scan.ply", "..%2F..%2Fetc%2Fpasswd", "%2Fetc%2Fpasswd", "scan_dense.exe", ""):
        assert asked(server, "GET", f"{one}/file/{name}")[0] == 400, name
    assert asked(server, "GET", "/s/guess/state")[0] == 404
    assert asked(server, "POST", f"{one}/end", b"{}")[0] == 200
    assert asked(server, "GET", f"{one}/state")[0] == 404
    assert len(list(server.sessions.root.iterdir())) == 1


def test_uploads_have_a_limit_and_a_kind(server: AppServer) -> None:
    path = user(server)
    status, text = asked(server, "PUT", f"{path}/scan?name=big.ply", bytes(1001))
    assert (status, json.loads(text)["error"][:26]) == (400, "big.ply: has 0 MB, at most")
    status, text = asked(server, "PUT", f"{path}/scan?name=a.exe", b"x")
    assert (status, json.loads(text)["error"][:37]) == (400, "a.exe: expected a point cloud, one of")
    assert json.loads(asked(server, "GET", f"{path}/state")[1])["scan"] == "scan.ply"


def test_a_damaged_scan_is_a_line_and_so_is_a_crash(server: AppServer) -> None:
    assert finished(server, user(server, "bad.ply"))["error"] == "bad.ply: is damaged"
    assert "ended without a result" in finished(server, user(server, "crash.ply"))["error"]


def test_a_job_is_stopped_and_how_far_it_is_is_known() -> None:
    workers = WorkerPool([sys.executable, "-ISc", WORKER])
    ended: list[Job] = []
    done = threading.Event()

    def after(job: Job) -> None:
        ended.append(job)
        done.set()

    job = workers.start({"folder": ".", "scan": "slow"}, ("normals", "seeds"), after)
    for _ in range(2000):
        if job.stage == "normals":
            break
        job.ended.wait(0.01)
    assert job.fraction() == pytest.approx(0.5 * 6 / 46)
    job.stop()
    assert done.wait(20)
    assert (ended, job.error) == ([job], "stopped")
    assert job.process.process.poll() is not None
    workers.end()
