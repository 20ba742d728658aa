"""What pnu reads of each file of a folder, and what it says of it, as a table: `python -m bench.cases FOLDER`.

Markdown on stdout: the file, what was read, and the lines that the commands print, or the one line of the refusal.
"""

import argparse
import sys
from pathlib import Path

from pnu.geometry.cloud_statistics import describe_cloud
from pnu.io import CLOUD_SUFFIXES, Cloud, files_of, read_cloud


def contents(cloud: Cloud) -> str:
    scalars = [name for name in cloud.attributes if name != "colors"]
    parts = [f"{len(cloud.points)} points", *(["normals"] if cloud.normals is not None else [])]
    return ", ".join([*parts, *(["colors"] if "colors" in cloud.attributes else []), *scalars])


def row(path: Path, name: str) -> str:
    try:
        cloud = read_cloud(path)
        read, said = contents(cloud), [*cloud.notes, *describe_cloud(cloud.points, cloud.normals).warnings()]
    except (ValueError, OSError) as error:
        read, said = "refused", [str(error).removeprefix(f"{path}: ")]
    return f"| {name} | {read} | {'<br>'.join(said).replace('|', '/')} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="whose files are read, those of its folders too")
    folder = parser.parse_args().folder
    files = files_of(folder, CLOUD_SUFFIXES, below=True)
    if not files:
        sys.exit("error: no point clouds there")
    print("| file | read | said |\n|---|---|---|")
    for path in files:
        print(row(path, path.relative_to(folder).as_posix()), flush=True)


if __name__ == "__main__":
    main()
