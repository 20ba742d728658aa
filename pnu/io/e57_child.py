"""The process that reads e57: `python -I e57_child.py FILE`, the columns of all scans to stdout, as npz, and the scans'
"sizes" and "places".

On its own, and not a part of the program that calls it, because the library ends its process on some damaged files.
"""

import io
import sys
from pathlib import Path
from typing import Any

ROOM = 2**30  # bytes, for a small file
MOST = 100  # points that a byte of the file may hold
COLUMNS = ("cartesianX", "cartesianY", "cartesianZ", "intensity", "colorRed", "colorGreen", "colorBlue")


def main(source: str) -> None:
    """Write the columns of a file's scans to stdout."""
    import numpy as np
    import pye57

    _limit_memory(ROOM + 8 * Path(source).stat().st_size)
    file = pye57.E57(source)
    scans, places = [], []
    for number in range(file.scan_count):
        head = file.get_header(number)
        if head.point_count > MOST * Path(source).stat().st_size:
            raise ValueError(f"its header promises {head.point_count} points, more than it has room for")
        known = set(head.point_fields)
        scans.append(
            file.read_scan(
                number, intensity="intensity" in known, colors="colorRed" in known, ignore_missing_fields=True
            )
        )
        places.append(head.translation)
    if not scans:
        raise ValueError("it holds no scan")
    common = [name for name in COLUMNS if all(name in scan for scan in scans)]
    columns: dict[str, Any] = {name: np.concatenate([scan[name] for scan in scans]) for name in common}
    columns["sizes"], columns["places"] = [len(scan["cartesianX"]) for scan in scans], places
    np.savez(buffer := io.BytesIO(), **columns)
    sys.stdout.buffer.write(buffer.getvalue())


def _limit_memory(more: int) -> None:
    """Let this process take so many bytes more, where the system has such a limit."""
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_DATA, (used + more, used + more))
    except (ImportError, OSError, ValueError):
        pass


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except BaseException as error:
        sys.exit(" ".join(str(error).split()) or type(error).__name__)
