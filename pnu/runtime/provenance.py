"""What a table says of its making: revision of the program, machine, number of seeds. No name of a host, no path."""

import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from pnu import __version__


def machine() -> str:
    """Processor, threads, and the GPU where torch sees one."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    torch = sys.modules.get("torch")  # whose import takes seconds
    threads = torch.get_num_threads() if torch else os.cpu_count() or 1
    gpu = [torch.cuda.get_device_name()] if torch and torch.cuda.is_available() else []
    processor = models[0] if models else platform.processor() or platform.machine()
    return ", ".join([processor, f"{threads} thread{'s' * (threads > 1)}", *gpu])


def revision() -> str:
    """Short, with "+" where the tree has changes; outside a checkout the version."""
    found = git_revision()
    return f"version {__version__}" if found is None else short_revision(found)


def git_revision() -> str | None:
    """Of the checkout that the package runs from, None outside one; with "+" if it has changes, or files under pnu/ or
    conf/ that git does not know."""
    here = Path(__file__).resolve().parents[2]
    if not (here / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        run = subprocess.run(["git", *arguments], cwd=here, capture_output=True, text=True, timeout=10, check=True)
        return str(run.stdout)

    try:
        revision = git("rev-parse", "HEAD").strip()
        lines = git("status", "--porcelain", "-uall").splitlines()
    except (OSError, subprocess.SubprocessError):
        return None
    changes = [line for line in lines if not line.startswith("??") or re.match(r'\?\? "?(pnu|conf)/', line)]
    return revision + "+" * bool(changes)


def short_revision(revision: str) -> str:
    """The first ten digits, with the mark of changes."""
    return revision[:10] + "+" * revision.endswith("+")


def provenance(
    seeds: Iterable[int], revisions: Iterable[str] | None = None, machines: Iterable[str] | None = None
) -> str:
    """The line of a table.

    Args:
        seeds: numbers of seeds behind its figures.
        revisions, machines: of the runs that it shows; None: this one's.
    """
    counts = list(seeds)
    least, most = min(counts), max(counts)
    repeated = "single seeds" if most == 1 else f"{most} seeds" if least == most else f"{least} to {most} seeds"
    told = " and ".join(dict.fromkeys([revision()] if revisions is None else map(short_revision, revisions)))
    where = " and ".join(dict.fromkeys([machine()] if machines is None else machines))
    return f"Revision {told or 'unknown'}; {where or 'machine unknown'}; {repeated}."
