"""Users of `pnu app`: each has a token, a folder, one scan and one job at a time; nobody sees another's."""

import math
import re
import secrets
import shutil
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pnu.app.jobs import STOPPED, Job, WorkerPool
from pnu.config.quoting import override, shell_line
from pnu.io import CLOUD_SUFFIXES, MESH_OUTPUTS, OUTPUT_SUFFIXES

FORGOTTEN = 12 * 3600.0  # seconds without a request after which a session ends
RESERVE = 200_000_000  # bytes of the disk that stay free
CHOICES = {  # keys of `pnu upsample` that the page sets, with what each may be
    "ratio": float,
    "spacing": float,
    "density": ("auto", "even", "follow"),
    "outliers": ("auto", "keep"),
    "normals": ("auto", "orient", "estimate", "keep"),
    "up": ("x", "y", "z", "-x", "-y", "-z"),
    "side": ("out", "in"),
    "holes": float,
}
DEFAULTS = {"ratio": 4.0, "density": "auto", "outliers": "auto", "normals": "auto"}
CLOUD_STAGES = ("normals", "seeds", "spheres", "shortlist", "projection", "thinning", "even spacing", "refinement")
MESH_STAGES = ("Poisson reconstruction",)


class Session:
    """One user.

    Args:
        folder: of its own, empty; removed with the session.
        workers: whose processes do the work.
    """

    def __init__(self, folder: Path, workers: WorkerPool) -> None:
        self.folder, self.workers = folder, workers
        self.lock = threading.RLock()
        self.seen = time.monotonic()
        self.clear()

    def clear(self) -> None:
        """As if nothing had happened."""
        self.scan: str | None = None
        self.job: Job | None = None
        self.phase = "empty"  # looking, ready, working, done
        self.error: str | None = None
        self.look: Any = None
        self.result: Any = None
        self.lines: list[str] = []
        self.command: list[str] = []
        self.files: dict[str, str] = {}  # what is made: kind -> name
        self.views: dict[int, str] = {}

    def new_view(self) -> tuple[int, str]:
        """A number and a name for a view to be written."""
        number = len(self.views) + 1
        self.views[number] = f".view_{secrets.token_hex(4)}.bin"
        return number, self.views[number]

    def take(self, name: str) -> Path:
        """Where an upload of that name goes; what was there before is forgotten.

        Raises:
            ValueError: a name that no file of points has.
        """
        plain = plain_name(name)
        suffix = Path(plain).suffix.lower()
        if suffix not in CLOUD_SUFFIXES:
            known = ", ".join(sorted(s[1:] for s in CLOUD_SUFFIXES))
            raise ValueError(f"{plain}: expected a point cloud, one of {known}")
        with self.lock:
            self.end_job()
            shutil.rmtree(self.folder, ignore_errors=True)
            self.folder.mkdir(mode=0o700)
            self.clear()
            self.scan = plain
        return self.folder / plain

    def start_look(self) -> None:
        """See what the scan is like."""
        with self.lock:
            number, view = self.new_view()
            order = {"folder": str(self.folder), "work": "look", "scan": self.scan, "view": view}
            self.phase, self.error = "looking", None

            def after(job: Job) -> None:
                with self.lock:
                    if job is self.job:
                        self.phase, self.error = ("empty", job.error) if job.error else ("ready", None)
                        self.look = job.result and job.result | {"number": number}

            self.job = self.workers.start(order, ("reading",), after)

    def start_making(self, wanted: Mapping[str, Any]) -> None:
        """Make what the form asks for: keys of `CHOICES`, and `surface`.

        Raises:
            ValueError: a value that cannot be, or there is no scan.
        """
        keys, surface = checked_keys(wanted), bool(wanted.get("surface"))
        with self.lock:
            if self.scan is None or self.look is None:
                raise ValueError("drop a scan first")
            if self.job is not None and not self.job.ended.is_set():
                raise ValueError("something is being made already; stop it first")
            number, view = self.new_view()
            stem = Path(self.scan).stem
            cloud, mesh, removed = f"{stem}_dense.ply", f"{stem}_surface.ply", f"{stem}_removed.ply"
            upsample = {"input": self.scan, "output": cloud} | keys
            if keys.get("outliers") != "keep":
                upsample["removed"] = removed
            commands = [("upsample", upsample)]
            if surface:
                commands.append(("reconstruct", {"input": cloud, "output": mesh}))
            order = {
                "folder": str(self.folder),
                "work": "make",
                "scan": self.scan,
                "view": view,
                "keys": keys,
                "cloud": cloud,
                "commands": [[verb, *map(override, given, given.values())] for verb, given in commands],
            } | ({"mesh": mesh} if surface else {})
            self.remove_made()
            self.command = [shell_line(verb, **given) for verb, given in commands]
            self.phase, self.error, self.result, self.files = "working", None, None, {}
            stages = (*CLOUD_STAGES, *(MESH_STAGES if surface else ()), "picture")

            def after(job: Job) -> None:
                with self.lock:
                    if job is not self.job:
                        return
                    self.lines = job.lines
                    if job.error:
                        self.remove_made()  # what is there is not whole
                    self.phase, self.error = ("ready", job.error) if job.error else ("done", None)
                    self.result = job.result and job.result | {"number": number}
                    made = {"cloud": cloud} | ({"mesh": mesh} if surface else {})
                    self.files = {} if job.error else made
                    if not job.error and (self.folder / removed).exists() and job.result["made"]["stray"]:
                        self.files["removed"] = removed

            self.job = self.workers.start(order, stages, after)

    def remove_made(self) -> None:
        """Remove all files but the scan and what is shown of it."""
        for path in self.folder.iterdir():
            if path.is_file() and path.name != self.scan and path.name not in self.views.values():
                path.unlink()

    def stop(self) -> None:
        """Stop what is being made."""
        with self.lock:
            if self.job is not None:
                self.job.stop()

    def end_job(self) -> None:
        """Stop, and do not hear of it again."""
        job, self.job = self.job, None
        if job is not None:
            job.stop()

    def file(self, name: str) -> Path:
        """A file to be downloaded, made in that format where it is not there yet.

        Raises:
            ValueError: there is none of that name, or it cannot be written in the format.
        """
        with self.lock:
            names = {made: kind for kind, made in self.files.items()}
            offered = {name for made, kind in names.items() for name in in_formats(made, kind)}
            stem = Path(self.scan or "").stem
            page = f"{stem}_view.html"
            if name not in offered | ({page} if self.files else set()):
                raise ValueError(f"{name}: is not here")
            path = self.folder / name
            if path.is_file():
                return path
            order: dict[str, Any] = {"folder": str(self.folder), "work": "write", "target": name}
            if name == page:
                order["shown"] = [str(self.scan), self.files["cloud"], *filter(None, [self.files.get("mesh")])]
            else:
                source = next(made for made in names if Path(made).stem == Path(name).stem)
                order |= {"source": source, "kind": names[source]}
            job = self.workers.start(order, ("reading",), lambda job: None)
        job.ended.wait()
        if job.error is not None:
            raise ValueError(job.error)
        return path

    def state(self) -> dict[str, Any]:
        """All that the page shows, as JSON."""
        with self.lock:
            job = self.job
            running = job is not None and not job.ended.is_set()
            progress = None
            if running and job is not None:
                left = job.seconds_left()
                progress = {"stage": job.stage, "fraction": job.fraction(), "left": left, "lines": job.lines[-6:]}
            files = {kind: in_formats(name, kind) for kind, name in self.files.items()}
            return {
                "phase": self.phase,
                "scan": self.scan,
                "error": self.error,
                "stopped": self.error == STOPPED,
                "progress": progress,
                "look": self.look,
                "result": self.result,
                "lines": self.lines,
                "command": self.command if self.phase == "done" else [],
                "files": files,
                "page": f"{Path(self.scan or '').stem}_view.html" if self.files else None,
            }

    def end(self) -> None:
        """Remove all that is its own."""
        with self.lock:
            self.end_job()
            shutil.rmtree(self.folder, ignore_errors=True)


class Sessions:
    """All users, by token.

    Args:
        root: folder for theirs.
        workers: of all.
    """

    def __init__(self, root: Path, workers: WorkerPool) -> None:
        self.root, self.workers = root, workers
        self.known: dict[str, Session] = {}
        self.lock = threading.Lock()

    def new(self) -> str:
        """The token of a new session; those that were left long ago end."""
        token = secrets.token_urlsafe(24)
        with self.lock:
            now = time.monotonic()
            for old in [token for token, session in self.known.items() if now - session.seen > FORGOTTEN]:
                self.known.pop(old).end()
            folder = self.root / secrets.token_hex(8)
            folder.mkdir(mode=0o700)
            self.known[token] = Session(folder, self.workers)
        return token

    def get(self, token: str) -> Session | None:
        """The session of a token."""
        with self.lock:
            session = self.known.get(token)
        if session is not None:
            session.seen = time.monotonic()
        return session

    def end(self, token: str) -> None:
        """End one."""
        with self.lock:
            session = self.known.pop(token, None)
        if session is not None:
            session.end()


def plain_name(name: str) -> str:
    """A file name without folders and without what file systems, or a hidden file, would mean by it."""
    last = re.split(r"[/\\\\]", name)[-1]
    plain = re.sub(r'[\x00-\x1f\x7f<>:"|?*]', "_", last).strip(" .")
    stem, suffix = Path(plain).stem[:80], Path(plain).suffix[:10]
    return f"{stem}{suffix}" or "scan"


def in_formats(name: str, kind: str) -> list[str]:
    """The names of a result in all formats, its own first."""
    suffixes = MESH_OUTPUTS if kind == "mesh" else OUTPUT_SUFFIXES - {".txt"}
    others = sorted(suffix for suffix in suffixes if suffix != Path(name).suffix)
    return [name, *(f"{Path(name).stem}{suffix}" for suffix in others)]


def checked_keys(wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of `pnu upsample` that a form means, without those that are the default.

    Raises:
        ValueError: a value that none may have.
    """
    keys: dict[str, Any] = {}
    for name, allowed in CHOICES.items():
        value = wanted.get(name)
        if value in (None, ""):
            continue
        if isinstance(allowed, tuple):
            if value not in allowed:
                raise ValueError(f"{name}={value}: expected one of {', '.join(allowed)}")
        else:
            try:
                value = float(value)
                if not math.isfinite(value):
                    raise ValueError
            except (TypeError, ValueError):
                raise ValueError(f"{name}={str(value)[:40]}: expected a number") from None
            value = int(value) if value.is_integer() else value
        if DEFAULTS.get(name) != value:
            keys[name] = value
    if "spacing" in keys:
        keys.pop("ratio", None)
    return keys
