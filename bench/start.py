"""What each verb imports, and how long that takes: `python -m bench.start [VERB ...] [--rounds 3]`.

Each verb runs in processes of its own under `python -X importtime`: its help, a mistake that it refuses, and, where a
small input is enough, its work. Seconds are those of imports alone, the least of the rounds; a package has those of all
its modules without what they import in turn. The table goes to outputs/bench/start.md.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from bench.__main__ import facts
from pnu.__main__ import verbs
from pnu.io import atomic_path, write_cloud

LINE = re.compile(r"import time: +(\d+) \| +\d+ \| +([\w.]+)")
WORK = {  # on a small cloud; what is not named here wants a mesh, a training or a window
    "normals": ["input=cloud.ply", "output=out.ply"],
    "picture": ["inputs=[cloud.ply]", "output=out.png"],
    "reconstruct": ["input=cloud.ply", "output=mesh.ply"],
    "scan": ["input=cloud.ply", "output=out"],
    "upsample": ["input=cloud.ply", "output=out.ply"],
}
MOST = 6  # packages named


def imports(folder: Path, arguments: list[str]) -> tuple[Counter[str], int]:
    """Microseconds of each package that `pnu` with these arguments imports, and its exit code."""
    command = [sys.executable, "-X", "importtime", "-m", "pnu", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    found: Counter[str] = Counter()
    for time, module in LINE.findall(done.stderr):
        found[module.partition(".")[0]] += int(time)
    return found, done.returncode


def best(folder: Path, arguments: list[str], rounds: int) -> tuple[Counter[str], int]:
    """Of several rounds the one that took least."""
    return min((imports(folder, arguments) for _ in range(rounds)), key=lambda found: found[0].total())


def rows(names: list[str], rounds: int) -> list[str]:
    """A line for each verb and occasion, as Markdown."""
    lines = ["| verb | occasion | s | packages that take longest, s |", "|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as place:
        points = np.random.default_rng(0).normal(size=(200, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        write_cloud(Path(place) / "cloud.ply", points, points)
        for verb in names:
            occasions = {"help": ["--help"], "mistake": ["no_such_key=1"]}
            if verb in WORK:
                occasions["work"] = [*WORK[verb], "quiet=true"]
            for occasion, arguments in occasions.items():
                found, code = best(Path(place), [verb, *arguments], rounds)
                told = ", ".join(f"{package} {time / 1e6:.2f}" for package, time in found.most_common(MOST))
                failed = f" (exit code {code})" if occasion == "work" and code else ""
                lines.append(f"| {verb} | {occasion}{failed} | {found.total() / 1e6:.2f} | {told} |")
                print(lines[-1], flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.start", description=__doc__)
    parser.add_argument("verbs", nargs="*", help="default: all")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path("outputs/bench"))
    given = parser.parse_args()
    unknown = set(given.verbs) - set(verbs())
    if unknown:
        parser.error(f"no such verb: {' '.join(sorted(unknown))}")
    given.folder.mkdir(parents=True, exist_ok=True)
    text = "; ".join(f"{key}: {value}" for key, value in facts().items()) + "\n\n"
    text += "\n".join(rows(given.verbs or list(verbs()), given.rounds)) + "\n"
    with atomic_path(given.folder / "start.md") as path:
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
