"""WLOP and EAR beside CGAL's, on pairs: `python -m bench.classical PAIRS --cgal PYTHON [--noise 0.01] [--ratio 4]`.

PYTHON is an interpreter of a virtual environment of its own that has the wheel `cgal` and numpy, no dependency of pnu.
Both get the same points and normals, CGAL with its own defaults, ours with ours. WLOP: as many points as the input has,
all of them projected. EAR: upsampling, ours after its resampling away from the edges.
"""

import argparse
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from pnu.benchmark import case_source, measure
from pnu.geometry.normal_estimation import complete_normals
from pnu.upsamplers import classical, whole_clouds

CGAL = """
import sys, numpy as np
from CGAL import CGAL_Point_set_processing_3 as processing
from CGAL.CGAL_Kernel import Point_3, Vector_3
from CGAL.CGAL_Point_set_3 import Point_set_3
source, target, name, count = sys.argv[1:]
cloud, made, out = np.load(source), Point_set_3(), Point_set_3()
made.add_normal_map()
for row in cloud:
    made.insert(Point_3(*map(float, row[:3])), Vector_3(*map(float, row[3:])))
if name == "wlop":
    processing.wlop_simplify_and_regularize_point_set(made, out, 100)
    found = [(p.x(), p.y(), p.z()) for p in out.points()]
else:
    processing.edge_aware_upsample_point_set(made, 25, 0, -1, int(count))
    points, normals = list(made.points()), [made.normal(i) for i in made.indices()]
    found = [(p.x(), p.y(), p.z(), v.x(), v.y(), v.z()) for p, v in zip(points, normals)]
np.save(target, np.array(found))
"""


def by_cgal(python: str, cloud: np.ndarray, name: str, count: int) -> np.ndarray:
    """What CGAL makes of a cloud (n, 6); WLOP's points get the normals of the nearest given ones' planes."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "in.npy"), Path(folder, "out.npy")
        np.save(source, cloud)
        subprocess.run([python, "-c", CGAL, source, target, name, str(count)], check=True)
        return np.load(target)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", type=Path)
    parser.add_argument("--cgal", required=True)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--ratio", type=float, default=4)
    arguments = parser.parse_args()
    print("shape, method: CD, HD, P2F x 1e3, unsigned normal error, seconds")
    totals: dict[str, list[np.ndarray]] = {}
    for case in case_source({"root": str(arguments.pairs)}, warn=lambda text: None).cases:
        points = case.points + arguments.noise * np.random.default_rng(0).normal(size=case.points.shape)
        given = None if arguments.noise else case.normals
        cloud = np.hstack([points, complete_normals(points, given)])
        for name, ratio in (("wlop", 1.0), ("ear", arguments.ratio)):
            count = round(ratio * len(cloud))
            for who in ("pnu", "cgal"):
                started = time.perf_counter()
                if who == "pnu":
                    dense = whole_clouds.upsample(cloud, ratio=ratio, model=classical(name), outliers="keep")
                else:
                    dense = by_cgal(arguments.cgal, cloud, name, count)
                seconds = time.perf_counter() - started
                found = measure(dense, case.truth)
                row = [1e3 * found[key] for key in ("chamfer_sq", "hausdorff_sq", "p2f")]
                values = np.array([*row, found.get("normal_unsigned_deg", np.nan), seconds])
                totals.setdefault(f"{name} {who}", []).append(values)
                print(f"{case.truth.shape:10s} {name} {who:5s}" + "".join(f"{v:9.3f}" for v in values), flush=True)
    for key, rows in totals.items():
        print(f"{'mean':10s} {key:10s}" + "".join(f"{v:9.3f}" for v in np.mean(rows, axis=0)))


if __name__ == "__main__":
    main()
