"""All slow tests from start to end, and a summary: `make nightly`, or `python -m tests.nightly [arguments of pytest]`.

The summary goes to outputs/nightly.md too. Exit code 0 where all that ran passed, else pytest's.
"""

import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from pnu.runtime.provenance import provenance

PARTS = {
    "test_soak.py": "killed at random moments, and on with it",
    "test_cli.py": "several processes train as one",
    "test_fuzz.py": "damaged and forged files",
    "test_docs.py": "every documented command",
    "test_sweep.py": "sweeps, launchers, searches, Ctrl-C",
}
OTHERS = "all others"
LONGEST = 3600  # seconds of a test; one that takes longer hangs


class Summary:
    """What pytest tells of each test, counted by part."""

    def __init__(self) -> None:
        self.counts: dict[str, Counter[str]] = {}
        self.seconds: Counter[str] = Counter()
        self.failed: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        part = PARTS.get(Path(report.nodeid.partition("::")[0]).name, OTHERS)
        self.seconds[part] += report.duration
        if report.when == "call" or report.outcome != "passed":
            self.counts.setdefault(part, Counter())[report.outcome] += 1
        if report.outcome == "failed":
            self.failed.append(report.nodeid)

    def lines(self) -> list[str]:
        lines = ["| slow tests | passed | failed | skipped | minutes |", "|---|---:|---:|---:|---:|"]
        for part in [*PARTS.values(), OTHERS]:
            found = self.counts.get(part, Counter())
            counts = " | ".join(str(found[outcome]) for outcome in ("passed", "failed", "skipped"))
            lines.append(f"| {part} | {counts} | {self.seconds[part] / 60:.1f} |")
        return [*lines, *(f"- failed: {name}" for name in self.failed)]


def main(arguments: list[str]) -> int:
    summary, started = Summary(), time.monotonic()
    code = int(pytest.main(["-m", "slow", "-o", f"faulthandler_timeout={LONGEST}", *arguments], plugins=[summary]))
    if code == pytest.ExitCode.INTERRUPTED:
        summary.failed.append("interrupted, the rest did not run")
    total = f"{(time.monotonic() - started) / 60:.0f} minutes in all"
    text = "\n".join([*summary.lines(), "", f"{provenance([1])} {total}."]) + "\n"
    folder = Path("outputs")
    folder.mkdir(exist_ok=True)
    (folder / "nightly.md").write_text(text, encoding="utf-8")
    print(f"\n{text}")
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
