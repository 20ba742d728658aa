"""Clouds made from simulated scans, against the truth: `python -m bench.scans MESHES [--kinds ...] [--methods ...]`.

Each mesh of the folder, brought to the unit sphere, is scanned in every way of `pnu.data.scanner`; each method makes a
cloud of four times as many points of the scan. "pnu" is `pnu.upsample` as it is called by default; "pnu, as it is" the
same without cleaning; "open3d" what users of Open3D do: statistical outlier removal, normals, consistent tangent
planes, Poisson, the least dense 3 % trimmed, Poisson-disk samples. The clouds go to OUTPUT/METHOD/SHAPE_KIND.ply,
the scans to OUTPUT/scans, the places on the surface that they mean to OUTPUT/true.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from pnu.benchmark.cases import generator, seen_samples
from pnu.benchmark.open3d_chain import open3d_chain
from pnu.data import shapes
from pnu.data.mesh_scene import MeshScene
from pnu.data.scanner import KINDS, Scanner, SimulatedScan
from pnu.geometry.mesh_sampling import sample_poisson_disk
from pnu.io import atomic_path, meshes_of, read_mesh, write_cloud
from pnu.metrics.scan_scores import COLUMNS, LEGEND, scan_scores
from pnu.runtime.provenance import provenance
from pnu.upsamplers.whole_clouds import upsample


def pnu_default(scan: SimulatedScan) -> np.ndarray:
    return upsample(scan.points, scan.normals)


def pnu_as_it_is(scan: SimulatedScan) -> np.ndarray:
    return upsample(scan.points, scan.normals, outliers="keep", lines="keep", noise="keep", density="even", keep=False)


def open3d_default(scan: SimulatedScan) -> np.ndarray:
    return open3d_chain(4)(scan.points, scan.normals)


METHODS: dict[str, Callable[[SimulatedScan], np.ndarray]] = {
    "pnu": pnu_default, "pnu, as it is": pnu_as_it_is, "open3d": open3d_default,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.scans", description=__doc__)
    parser.add_argument("meshes", type=Path, help="folder of closed meshes, faces outward")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--seed", type=int, default=1, help="of the scans")
    parser.add_argument("--output", type=Path, default=Path("outputs/scans"), help="folder for clouds and table")
    arguments = parser.parse_args()
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    names = meshes_of(arguments.meshes)
    for name, path in names.items():
        mesh = shapes.unit_mesh(read_mesh(path))
        scanner, scene = Scanner(mesh), MeshScene([mesh])
        truth = sample_poisson_disk(mesh, 10000, np.random.default_rng(0))[:, :3]
        for kind in arguments.kinds:
            scan = KINDS[kind](scanner, generator(arguments.seed, name, kind))
            seen = seen_samples(truth, scan, kind)
            true = scan.clean[np.isfinite(scan.clean[:, 0])]
            for part, points, normals in (("scans", scan.points, scan.normals), ("true", true[:, :3], true[:, 3:])):
                (arguments.output / part).mkdir(parents=True, exist_ok=True)
                write_cloud(arguments.output / part / f"{name}_{kind}.ply", points, normals)
            for method in arguments.methods:
                started = time.perf_counter()
                dense = METHODS[method](scan)
                seconds = time.perf_counter() - started
                folder = arguments.output / method.replace(", ", "_").replace(" ", "_")
                folder.mkdir(parents=True, exist_ok=True)
                write_cloud(folder / f"{name}_{kind}.ply", dense[:, :3], dense[:, 3:])
                places = torch.from_numpy(dense[None, :, :3])
                closest, normals = (x[0].numpy() for x in scene.closest(places, torch.tensor([0])))
                scores = scan_scores(dense, seen, closest, normals) | {"seconds": seconds}
                found.setdefault((kind, method), []).append(scores)
                print(f"{name} {kind} {method}: " + " ".join(f"{k} {v:.3g}" for k, v in scores.items()), flush=True)
    lines = [f"| kind | method | {' | '.join(COLUMNS)} | s |", "|---|---|" + "---:|" * (len(COLUMNS) + 1)]
    for (kind, method), rows in found.items():
        means = [np.mean([row[column] for row in rows]) for column in (*COLUMNS, "seconds")]
        lines.append(f"| {kind} | {method} | " + " | ".join(f"{value:.3g}" for value in means) + " |")
    note = f"{LEGEND} Means over {len(names)} shapes. {provenance([arguments.seed])}"
    text = "\n".join([*lines, "", note]) + "\n"
    with atomic_path(arguments.output / "scans.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"\n{text}\n{arguments.output / 'scans.md'}")


if __name__ == "__main__":
    main()
