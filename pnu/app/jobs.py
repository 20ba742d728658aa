"""Work in processes of their own, which can be stopped, and whose crash leaves the server as it is."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

SHARES = {
    **{"reading": 4.0, "normals": 6.0, "seeds": 40.0, "spheres": 1.0, "shortlist": 11.0, "projection": 11.0},
    **{"thinning": 10.0, "even spacing": 1.0, "refinement": 13.0, "Poisson reconstruction": 20.0, "picture": 4.0},
}  # of the time, as they come; measured on 20000 points made 80000
AHEAD = 1.0  # seconds before which a time left is no more than a guess
STOPPED = "stopped"


class Job:
    """Something that a process does for a session: what it tells meanwhile, and its end.

    Args:
        process: that waits for an order, see `Worker`.
        order: what is to be done, as JSON.
        shares: of the stages that are expected, for the time left.
    """

    def __init__(self, process: "Worker", order: Mapping[str, Any], shares: Mapping[str, float]) -> None:
        self.process, self.shares = process, dict(shares)
        self.started = time.monotonic()
        self.stage, self.part = "starting", 0.0
        self.past: set[str] = set()
        self.lines: list[str] = []
        self.error: str | None = None
        self.result: Any = None
        self.ended = threading.Event()
        process.tell(order)
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for message in self.process.messages():
            if "line" in message:
                self.lines.append(message["line"])
            elif "stage" in message:
                self._reached(message["stage"], message["done"], message["total"])
            elif "error" in message:
                self.error = self.error or message["error"]
            else:
                self.result = message["result"]
        if self.result is None and self.error is None:
            self.error = "the computation ended without a result; perhaps the memory was not enough: take fewer points"
        self.ended.set()

    def _reached(self, stage: str, done: int, total: int) -> None:
        share = self.share_of(stage)
        if share != self.share_of(self.stage):
            self.past.add(self.share_of(self.stage))
        self.stage, self.part = stage, done / total if total else 0.0

    def share_of(self, stage: str) -> str:
        """The stage of the shares that a stage belongs to."""
        return next((name for name in self.shares if stage.startswith(name)), stage)

    def fraction(self) -> float:
        """How much of the work is done, about."""
        here = self.share_of(self.stage)
        names = list(self.shares)
        before = names[: names.index(here)] if here in names else []
        done = sum(self.shares[name] for name in {*before, *(self.past & set(names))} - {here})
        done += self.shares.get(here, 0.0) * self.part
        return min(done / max(sum(self.shares.values()), 1e-9), 1.0)

    def seconds_left(self) -> float | None:
        """About how many, or None where it is too early to say."""
        taken, fraction = time.monotonic() - self.started, self.fraction()
        if taken < AHEAD or fraction <= 0.02:
            return None
        return taken * (1 - fraction) / fraction

    def stop(self) -> None:
        """End it now."""
        if not self.ended.is_set():
            self.error = STOPPED
            self.process.end()


class Worker:
    """A process that has loaded what takes long, and waits for one order."""

    def __init__(self, command: Sequence[str]) -> None:
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # so that its own children end with it; elsewhere than on POSIX it says nothing
        )

    def tell(self, order: Mapping[str, Any]) -> None:
        """What to do. It does that alone, and ends."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):  # it is gone, and its silence says so
            self.process.stdin.write(json.dumps(order).encode() + b"\n")
            self.process.stdin.flush()

    def messages(self) -> Any:
        """What it tells, until it ends."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with contextlib.suppress(ValueError):
                yield json.loads(line)
        self.process.wait()

    def end(self) -> None:
        """End it and what it has started."""
        end_with_children(self.process)


def end_with_children(process: "subprocess.Popen[bytes]") -> None:
    """End a process that leads a session of its own, and those that it has started."""
    if process.poll() is None:
        if hasattr(os, "killpg"):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
        else:
            subprocess.run(["taskkill", "/T", "/F", "/PID", str(process.pid)], capture_output=True, check=False)
        process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


class WorkerPool:
    """Gives each job a process; the next one is loading already."""

    def __init__(self, command: Sequence[str] | None = None) -> None:
        self.command = command or [sys.executable, "-m", "pnu.commands._worker"]
        self.lock = threading.Lock()
        self.spare: Worker | None = Worker(self.command)
        self.running: list[Job] = []
        self.shares = dict(SHARES)

    def start(self, order: Mapping[str, Any], stages: Sequence[str], after: Callable[[Job], None]) -> Job:
        """Begin a job; `after` is called with it when it has ended.

        stages: that are expected, of `SHARES`.
        """
        with self.lock:
            worker, self.spare = self.spare or Worker(self.command), None
            job = Job(worker, order, {name: self.shares[name] for name in stages})
            self.running.append(job)
        threading.Thread(target=self._finish, args=(job, after), daemon=True).start()
        return job

    def _finish(self, job: Job, after: Callable[[Job], None]) -> None:
        job.ended.wait()
        job.process.end()
        with self.lock:
            if job not in self.running:  # all were ended
                return
            self.running.remove(job)
            if self.spare is None:
                self.spare = Worker(self.command)
        after(job)

    def end(self) -> None:
        """End all."""
        with self.lock:
            jobs, self.running = self.running, []
            spare, self.spare = self.spare, None
        for job in jobs:
            job.stop()
        if spare is not None:
            spare.end()
