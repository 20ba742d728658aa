"""The README's picture: `python -m bench.turning [OUTPUT.webp] [--shape horse] [--frames 36]`.

A simulated photogrammetric scan of a procedural shape, 3 % of its points stray; what `pnu scan` makes of it; a turn of
all three by `pnu picture`.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from pnu.commands.picture import main as picture
from pnu.commands.scan import main as scan
from pnu.data import shapes
from pnu.data.scanner import KINDS, Scanner
from pnu.io import write_cloud


def main() -> None:
    """Scan, clean, densify, reconstruct, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", nargs="?", default="docs/scan.webp")
    parser.add_argument("--shape", default="horse", choices=shapes.names(), metavar="NAME")
    parser.add_argument("--frames", type=int, default=36)
    parser.add_argument("--size", type=int, default=300)
    arguments = parser.parse_args()
    measured = KINDS["photo"](Scanner(shapes.make(arguments.shape)), np.random.default_rng(1))
    with tempfile.TemporaryDirectory() as folder:
        files = {name: str(Path(folder) / f"{name}.ply") for name in ("scan", "dense", "mesh")}
        write_cloud(files["scan"], measured.points)
        scan([f"input={files['scan']}", f"cloud={files['dense']}", f"output={files['mesh']}"])
        picture(
            [
                f"inputs=[{','.join(files.values())}]",
                f"output={arguments.output}",
                "captions=[scan,dense cloud with normals,surface]",
                *("fit=2", "up=z", "elevation=12"),
                *(f"frames={arguments.frames}", f"size={arguments.size}"),
            ]
        )


if __name__ == "__main__":
    main()
