"""Sweeps that go on: the same command finds the same folder, and each job finds what is left of itself there.

    outputs/sweeps/<sweep>/multirun.yaml                 what was swept, by Hydra
                           <what differs>_<hash>/        a run folder for each job; the hash is that of its config

A job whose folder tells that it finished or was pruned, or that another process runs, is skipped; one that was
interrupted goes on from its last checkpoint, or starts again where it has none.
"""

import hashlib
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any, TextIO, cast

from pnu.config.compose import one_line, parse, variations
from pnu.config.quoting import shell_line, typed_line
from pnu.io import read_json, remove_leftovers, write_json
from pnu.training.run_folder import ENDED, INTERRUPTED, RunFolder, config_hash, now

UNNAMED = ("sweep", "quiet")  # keys that do not make another sweep


def sweep_name(overrides: Sequence[str], program: str) -> str:
    """The name of the sweep that a command line describes: the same for the same line."""
    values = {key: value for key, _, value in (override.partition("=") for override in overrides)}
    kept = sorted(f"{k}={v}" for k, v in values.items() if k not in UNNAMED and not k.startswith("hydra"))
    given = [values[key] for key in ("ablation", "hparams_search", "scale") if key in values]
    return "_".join([*(given or [program]), hashlib.sha256(" ".join(kept).encode()).hexdigest()[:6]])


def sweep_arguments(overrides: Sequence[str], program: str) -> list[str]:
    """What a sweep's command line gets added: its name, and which keys are the same in all jobs."""
    parsed = parse(list(overrides))
    added = []
    if "sweep" not in {override.key_or_group for override in parsed}:
        added.append(f"sweep={sweep_name(overrides, program)}")
    same = {o.key_or_group for o in parsed if not o.is_sweep_override()} | {"sweep"}
    added.append(f"hydra.job.config.override_dirname.exclude_keys=[{','.join(sorted(same))}]")
    return added


def check_job(config: Mapping[str, Any]) -> None:
    """Refuse what a job of a sweep cannot be.

    Raises:
        ValueError: more than one device, a run folder, or resume.
    """
    for key in ("run", "resume"):
        if config.get(key):
            raise ValueError(
                f"{key}={config[key]}: not in a sweep, whose jobs find their folders and go on by themselves"
            )
    sweep = config.get("sweep")
    if sweep and (not re.fullmatch(r"[\w.,=+-][\w.,=+ -]*", sweep) or set(sweep) == {"."}):
        raise ValueError(f"sweep={sweep}: expected the name of a folder below outputs/sweeps")
    trainer = config.get("trainer") or {}
    devices = trainer.get("devices", 1)
    several = str(devices) not in ("1", "None") and not (isinstance(devices, Sequence) and len(devices) == 1)
    if several or trainer.get("num_nodes", 1) != 1 or "ddp" in str(trainer.get("strategy")):
        raise ValueError(
            f"trainer.devices={devices}, trainer.strategy={trainer.get('strategy')}: a job of a sweep has one device;"
            " a distributed training starts the command line again for each device, and with it the whole sweep."
            " For several devices run several jobs at a time: hydra/launcher=joblib or submitit_slurm"
        )


def job_folder(config: Mapping[str, Any]) -> RunFolder:
    """The run folder of this job of a sweep, locked until the process ends; made empty where nothing can be kept.

    `folder.skip` tells why there is nothing to do: its run has finished, or another process is at it.
    """
    from hydra.core.hydra_config import HydraConfig

    hydra = HydraConfig.get()
    # not of the job's own idea of where it runs: a launcher's processes may have been started elsewhere
    sweep, digest = Path(hydra.runtime.cwd, hydra.sweep.dir, hydra.sweep.subdir), config_hash(config)
    label = label_of(str(hydra.job.override_dirname), str(hydra.runtime.choices.get("setting") or "")) or config["name"]
    found = [run for run in runs(sweep) if read_json(run.record_path).get("config_hash") == digest]
    folder = found[0] if found else RunFolder(sweep / f"{label}_{digest[:8]}")
    folder.path.mkdir(parents=True, exist_ok=True)
    try:
        folder.lock = locked(folder.path)
    except ValueError:
        folder.skip = "another process runs it, left alone"
        return folder
    remove_leftovers(folder.path)
    folder.skip = ENDED.get(folder.read_record().get("status", ""), "")
    if not folder.skip and not folder.last.exists():  # nothing to go on from
        folder.start_anew()
    choices = hydra.runtime.choices
    folder.facts = {"job": hydra.job.num, "setting": choices.get("setting"), "ablation": choices.get("ablation")}
    return folder


def weights_before(run: RunFolder) -> Path:
    """The run folder of the job before this one in its sweep, whose best weights it starts from.

    Raises:
        ValueError: there is none, or it has not finished.
    """
    number = run.facts.get("job")
    if not number:
        raise ValueError("weights=previous: means the job before in a sweep (-m), and there is none; give a run folder")
    before = [other for other in runs(run.path.parent) if other.read_record().get("job") == number - 1]
    if not before or before[0].read_record().get("status") != "finished":
        raise ValueError(
            f"weights=previous: job {number - 1}, which is before this one, has not finished; run one after the other"
        )
    return before[0].path


def label_of(overrides: str, setting: str = "") -> str:
    """A short name of what sets a job apart: "seed=0,setting=loss_terms/no_cd" becomes "no_cd_seed-0"; no sign in it
    wants quotes. setting: the one that all jobs of a command have, which is not among what is swept."""
    parts = []
    given = filter(None, overrides.split(","))
    for part in (f"setting={setting}", *given) if setting and "setting=" not in overrides else given:
        key, _, value = part.lstrip("+").partition("=")
        try:
            value = f"{float(value):.4g}"
        except ValueError:
            value = value.rpartition("/")[2]
        parts.append((key != "setting", value if key == "setting" else f"{key}-{value}"))
    named = "_".join(part for _, part in sorted(parts, key=lambda part: part[0]))
    return re.sub(r"[^\w.+-]", "-", named, flags=re.ASCII)[:100]


def locked(path: Path) -> int:
    """A lock on a folder that the system takes back when the process ends, however it ends."""
    try:
        import fcntl
    except ImportError:
        return _locked_file(path)
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise ValueError(f"{path}: another process runs this job; wait for it") from None
    except OSError:  # a file system without locks
        pass
    return descriptor


def _locked_file(path: Path) -> int:
    """`locked`, by a file in the folder, where folders cannot be locked: Windows."""
    import msvcrt

    descriptor = os.open(path / ".lock", os.O_RDWR | os.O_CREAT)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
    except OSError:
        os.close(descriptor)
        raise ValueError(f"{path}: another process runs this job; wait for it") from None
    return descriptor


def runs_elsewhere(run: RunFolder) -> bool:
    """Whether another process holds the lock of a run."""
    try:
        os.close(locked(run.path))
    except ValueError:
        return True
    return False


def parameters(overrides: Sequence[str], compose: Callable[..., Any]) -> list[str]:
    """The overrides that the config itself sweeps over, but for those that the command line sets."""
    given = {override.key_or_group for override in parse(list(overrides))}
    params = compose(next(variations(list(overrides))), True).hydra.sweeper.get("params") or {}
    return [f"{key}={value}" for key, value in params.items() if key not in given]


def failed(error: Exception) -> Exception:
    """What a job raises for Hydra, which ends the command with it after the other jobs; told at once on stderr."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import CompactHydraException

    job = HydraConfig.get().job
    text = one_line(error) if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: {one_line(error)}"
    print(f"job {job.num} ({job.override_dirname}) failed: {text}", file=sys.stderr, flush=True)
    return CompactHydraException(f"error: {text}")


def run(start: Callable[[], None], folder: Path) -> None:
    """Start a sweep; at its end tell how its jobs ended. Exit code 1 if any failed, 130 after Ctrl-C."""
    began = time.time() - 1
    code: Any = 0
    try:
        with redirect_stderr(cast(TextIO, WithoutEcho(sys.stderr))):
            start()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except SystemExit as stop:
        code = stop.code
    if code == INTERRUPTED:
        record_interruptions(folder)
    print(closing_line(folder), flush=True)
    if code == INTERRUPTED:
        print(f"stopped; go on with: {typed_line()}", file=sys.stderr, flush=True)
    ended = [run for run in runs(folder) if run.record_path.stat().st_mtime > began]
    broken = [run for run in ended if run.read_record().get("status") not in ENDED and not runs_elsewhere(run)]
    if code or broken:  # Optuna goes on without them
        sys.exit(code or 1)


def record_interruptions(folder: Path, patience: float = 10) -> None:
    """Say so in the records of jobs whose processes Ctrl-C has ended before they could."""
    deadline = time.monotonic() + patience  # a launcher's processes may still be ending
    while any(state(run) == "running" for run in runs(folder)) and time.monotonic() < deadline:
        time.sleep(0.1)
    for run in runs(folder):
        record = run.read_record()
        if record.get("status") == "running" and state(run) == "interrupted":
            write_json(run.record_path, record | {"status": "failed", "error": "interrupted", "ended": now()})


def state(run: RunFolder) -> str:
    """How a run's record ends: finished, pruned, failed, interrupted, running; "interrupted" too where the process of a
    record that says "running" is gone."""
    record = run.read_record()
    status = str(record.get("status", "no record"))
    if record.get("error") == "interrupted":
        return "interrupted"
    gone = status == "running" and record.get("host") == platform.node() and not runs_elsewhere(run)
    return "interrupted" if gone else status


class WithoutEcho:
    """A stream without what Hydra writes at the end of a sweep about a failed job, which was told when it failed."""

    ECHO = ("Error executing job with overrides:", "error: ", "\nSet the environment variable HYDRA_FULL_ERROR")

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Pass the text on, but for Hydra's lines; its length."""
        return len(text) if text.startswith(self.ECHO) else self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def runs(sweep: Path) -> list[RunFolder]:
    """The run folders of a sweep, in the order of its jobs."""
    folders = [RunFolder(path.parent) for path in sorted(sweep.glob("*/run.json"))]
    return sorted(folders, key=lambda run: read_json(run.record_path).get("job") or 0)


def closing_line(sweep: Path) -> str:
    """What a sweep prints at its end."""
    states = [state(run) for run in runs(sweep)]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    again = typed_line() if "finished" not in states else shell_line("report", sweep=sweep)
    return f"\nsweep folder: {sweep} ({counts})\nnext: {again}"
