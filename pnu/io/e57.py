"""Exchange format of laser scanners, all scans of a file in one place; needs pye57: pip install 'pnu[e57]'."""

import io
import subprocess
import sys
from pathlib import Path

import numpy as np

from pnu.extras import require
from pnu.io import e57_child
from pnu.io.scan_columns import columns_of_scans

SECONDS = 600
NAMES = {
    **{"cartesianX": "x", "cartesianY": "y", "cartesianZ": "z"},
    **{"colorRed": "red", "colorGreen": "green", "colorBlue": "blue"},
}


def read_e57(path: Path) -> dict[str, np.ndarray]:
    """Columns (n,): x y z float64 as the scans are placed, intensity, and red green blue, where all scans have them;
    and `columns_of_scans`."""
    require("pye57", f"{path}: reading e57")
    command = [sys.executable, "-I", e57_child.__file__, str(path)]
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=SECONDS)
        if done.returncode:
            lines = done.stderr.decode(errors="replace").strip().splitlines()
            raise ValueError(lines[-1][:80] if lines else f"its reader ended with {done.returncode}")
        found: dict[str, np.ndarray] = dict(np.load(io.BytesIO(done.stdout)).items())
    except (ValueError, OSError, subprocess.TimeoutExpired) as error:
        reason = " ".join(str(error).split())[:80]
        raise ValueError(f"{path}: is no e57 file that can be read ({reason}); export it again") from None
    of_scans = columns_of_scans(found.pop("sizes").tolist(), list(found.pop("places")))
    return of_scans | {NAMES.get(name, name): values for name, values in found.items()}
