"""The process that decompresses laz: `python -I las_child.py FILE POINTS`, the records to stdout, so many at a time.

On its own, and not a part of the program that calls it, because the decompressor ends its process where a damaged file
makes it ask for too much memory.
"""

import sys
from pathlib import Path

ROOM = 2**30  # bytes, for a small file


def main(source: str, points: str) -> None:
    """Write the records of a file to stdout."""
    import laspy

    _limit_memory(ROOM + 8 * Path(source).stat().st_size)
    with laspy.open(source) as file:
        for chunk in file.chunk_iterator(int(points)):
            sys.stdout.buffer.write(chunk.array.tobytes())


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
        main(*sys.argv[1:])
    except BaseException as error:  # a panic of the decompressor is no Exception
        sys.exit(f"{error}")
