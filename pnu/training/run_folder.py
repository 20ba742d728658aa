"""One run, one folder: config.yaml, checkpoints/, tensorboard/, pictures/, metrics.json and run.json."""

import datetime
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pnu.config.quoting import shell_line, typed_line
from pnu.io import atomic_path, read_json, write_json
from pnu.runtime.provenance import git_revision

# status of a job that a sweep started again leaves alone, and what is said of it
ENDED = {"finished": "has finished before, skipped", "pruned": "was pruned before, skipped"}
INTERRUPTED = 130  # exit code of a program that Ctrl-C ends
PACKAGES = ("pnu", "torch", "lightning", "numpy", "scipy", "hydra-core")
# what a training makes in its folder
TRAINED = ("checkpoints", "tensorboard", "csv", "pictures", "metrics.json", "validations.json")
# keys that change where or how a run is told about, not what it computes
UNHASHED = ("run", "resume", "name", "quiet", "logger", "sweep", "objective", "metrics", "allow")
UNHASHED_DATA = ("quiet", "workers", "cache")


class RunFolder:
    """Paths of a run folder, and its record run.json."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.last = self.path / "checkpoints" / "last.ckpt"
        self.best = self.path / "checkpoints" / "best.ckpt"
        self.metrics = self.path / "metrics.json"
        self.validations = self.path / "validations.json"
        self.pictures = self.path / "pictures"
        self.record_path = self.path / "run.json"
        self.facts: dict[str, Any] = {}  # more that run.json shall tell
        self.allow: list[str] = []  # packages whose classes its config names
        self.skip = ""  # why nothing is to be done
        self.pruned = ""  # why its training was ended early
        self.lock: int | None = None  # descriptor of a lock, closed when the run ends

    def __str__(self) -> str:
        return str(self.path)

    @classmethod
    def create(cls, config: Mapping[str, Any]) -> "RunFolder":
        """The folder `config["run"]`, or a new one under outputs/<date>/, with its config.yaml.

        Raises:
            ValueError: there is a run in it already.
        """
        wanted = config.get("run")
        folder = cls(wanted or new_path(str(config["name"])))
        if folder.record_path.exists():
            status = read_json(folder.record_path).get("status")
            raise ValueError(
                f"run={folder}: holds a run ({status}); resume=true goes on with it, or choose another folder"
            )
        folder.prepare(config)
        return folder

    def prepare(self, config: Mapping[str, Any]) -> None:
        """Make what a run expects in its folder."""
        for name in ("checkpoints", "tensorboard", "pictures"):
            (self.path / name).mkdir(parents=True, exist_ok=True)
        self.write_config(config)

    def start_anew(self) -> None:
        """Remove what an earlier start left, which has no checkpoint to go on from, and say so."""
        made = [self.path / name for name in TRAINED]
        left = [path for path in made if path.is_file() or (path.is_dir() and any(path.iterdir()))]
        for path in left:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        if left:
            names = ", ".join(path.name for path in left)
            print(f"{self}: no checkpoint to go on from, starts anew; removed what was left: {names}", file=sys.stderr)

    def line(self, verb: str, **keys: Any) -> str:
        """The command line of a command on this run."""
        allow = {"allow": list(self.allow)} if self.allow else {}
        return shell_line(verb, **keys, run=self, **allow)

    @classmethod
    def existing(cls, path: str | Path | None) -> "RunFolder":
        """The run folder at `path`; ValueError if it isn't one."""
        if path is None:
            raise ValueError("resume=true needs run=FOLDER, the run to go on with")
        folder = cls(path)
        for file in (folder.config, folder.record_path):
            if not file.is_file():
                raise ValueError(f"run={path}: expected a run folder with {file.name}, found none")
        return folder

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write config.yaml."""
        from omegaconf import OmegaConf

        with atomic_path(self.config) as temporary:
            temporary.write_text(OmegaConf.to_yaml(OmegaConf.create(dict(config))), encoding="utf-8")

    def read_record(self) -> dict[str, Any]:
        """What run.json says; nothing where it is not there yet."""
        return read_json(self.record_path) if self.record_path.exists() else {}

    def add_metrics(self, section: str, results: Sequence[Mapping[str, float]]) -> None:
        """Put metrics under a section of metrics.json, such as "test"; their names lose their stage (test/...).

        results: what Lightning's trainer returns: one mapping for all data, or none where there were none.
        """
        if is_main_process():
            known = read_json(self.metrics) if self.metrics.exists() else {}
            values = {name.rpartition("/")[2]: float(value) for found in results for name, value in found.items()}
            write_json(self.metrics, {**known, section: values})

    @contextmanager
    def recorded(self, config: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        """run.json tells the state of what runs inside: running at once, then finished, pruned with the reason, or
        failed with the error.

        Gives the record; what the block adds to it is written at the end.
        """
        if not is_main_process():
            yield {}
            return
        before = self.read_record()
        self.allow = list(config.get("allow") or [])
        record = {
            "status": "running",
            "command": typed_line(),
            "started": before.get("started", now()),
            "resumed": [*before.get("resumed", []), *([now()] if before else [])],
            "pid": os.getpid(),
            "host": platform.node(),
            "versions": versions(),
            "git": git_revision(),
            "seed": config.get("seed"),
            "ratio": config.get("model", {}).get("ratio"),
            "config_hash": config_hash(config),
            **self.facts,
            "wall_s": before.get("wall_s", 0.0),
        }
        start = time.monotonic()
        write_json(self.record_path, record)
        try:
            yield record
            record |= {"status": "pruned", "pruned": self.pruned} if self.pruned else {"status": "finished"}
        except (KeyboardInterrupt, SystemExit):  # Lightning turns the first into the second
            record |= {"status": "failed", "error": "interrupted"}
            if "job" not in self.facts:  # a sweep tells at its end
                print(f"stopped; go on with: {self.line('train', resume=True)}", file=sys.stderr)
            sys.exit(INTERRUPTED)
        except BaseException as error:
            record |= {"status": "failed", "error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
            raise
        finally:
            record["ended"] = now()
            record["wall_s"] = round(before.get("wall_s", 0.0) + time.monotonic() - start, 3)
            write_json(self.record_path, record)
            self.unlock()

    def unlock(self) -> None:
        """Give the lock of a sweep's job back, if there is one."""
        if self.lock is not None:
            os.close(self.lock)
            self.lock = None


def new_path(name: str) -> Path:
    """outputs/<date>/<time>_<name>, which does not exist yet: two runs that start together get two folders."""
    day, clock = datetime.datetime.now().strftime("%Y-%m-%d %H-%M-%S").split()
    parent = Path("outputs") / day
    parent.mkdir(parents=True, exist_ok=True)
    for suffix in ("", *(f"_{i}" for i in range(2, 1000))):
        try:
            (path := parent / f"{clock}_{name}{suffix}").mkdir()
            return path
        except FileExistsError:
            continue
    raise ValueError(f"{parent}: holds 1000 runs of this second; give run=FOLDER")


def run_name(folder: str | Path) -> str:
    """What a run is called where it stands beside others: the name of its folder without the time before it."""
    name = Path(folder).resolve().name
    return re.sub(r"^\d\d-\d\d-\d\d_(?=.)", "", name)


def config_hash(config: Mapping[str, Any]) -> str:
    """Of what determines the result; the same for two runs that compute the same."""
    content = {key: value for key, value in config.items() if key not in UNHASHED}
    if content.get("weights") is None:  # a key that older runs lack
        content.pop("weights", None)
    if isinstance(content.get("data"), Mapping):
        content["data"] = {key: value for key, value in content["data"].items() if key not in UNHASHED_DATA}
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of Python and the packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def now() -> str:
    """The time, UTC, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def is_main_process() -> bool:
    """Whether this process is the first of a distributed run, or the only one."""
    return all(os.environ.get(name, "0") == "0" for name in ("LOCAL_RANK", "NODE_RANK", "RANK", "SLURM_PROCID"))
