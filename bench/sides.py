"""Normals on the wrong side, in percent: `python -m bench.sides MESHES [--seed 1] [--output outputs/sides]`.

*flipped*: 5000 points of each mesh with normals, a quarter of them turned over in patches, to be repaired, axes kept.
*oneview*: each mesh as a depth camera sees it, and scenes as points alone, of which the sensor's place or the
direction from above is known, or which of two scans each point is of. "before" are the given signs, or those of
`pnu.normals(points)`, which knows no sensor; "cosine" turns each normal by itself to what saw it; "open3d" is its
consistent tangent planes, the better side of two, or its own normals turned to what saw them or upward. Of scans the
stray points, which have no normal, don't count.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import open3d

import pnu
from bench.scenes import corridor, land, rescanned_room, room, scanned_room, yard
from pnu.benchmark.cases import generator
from pnu.data import shapes
from pnu.data.scanner import KINDS, Scanner
from pnu.io import atomic_path, meshes_of, read_mesh, write_cloud
from pnu.runtime.provenance import provenance

NEIGHBORS = 16
COLUMNS = ("before", "cosine", "open3d", "pnu")


class Case(NamedTuple):
    name: str
    points: np.ndarray
    true: np.ndarray  # normals, NaN where a point has none
    given: np.ndarray | None = None
    viewpoint: np.ndarray | None = None  # (3,), or of each point
    up: np.ndarray | None = None
    scans: np.ndarray | None = None  # known instead of the viewpoint


def cases(meshes: Path, seed: int) -> Iterator[Case]:
    for name, path in meshes_of(meshes).items():
        scanner = Scanner(shapes.unit_mesh(read_mesh(path)))
        scan = KINDS["flipped"](scanner, generator(seed, name, "flipped"))
        yield Case(f"flipped {name}", scan.points, scan.clean[:, 3:], given=scan.normals)
        scan = KINDS["oneview"](scanner, generator(seed, name, "oneview"))
        true = np.where(scan.stray[:, None], np.nan, scan.clean[:, 3:])
        yield Case(f"oneview {name}", scan.points, true, viewpoint=scan.sensor[0])
    rng = np.random.default_rng(seed)
    for name, (points, true), sight in (
        ("land with houses, from the air", land(0.1), {"up": np.array([0.0, 0, 1])}),
        ("yard with houses, from its middle", yard(), {"viewpoint": np.array([0, 0, 1.6])}),
        ("scanned room, from inside", scanned_room(np.array([2, 2.4, 1.5])), {"viewpoint": np.array([2, 2.4, 1.5])}),
        ("room with a chest and a pillar, from inside", room(), {"viewpoint": np.array([0, -1, 1.5])}),
        ("corridor, from one end", corridor(), {"viewpoint": np.array([-3, 0, 0.2])}),
    ):
        yield Case(name, points + 0.01 * rng.normal(size=points.shape), true, **sight)
    points, true, places, scans = rescanned_room()
    points = points + 0.01 * rng.normal(size=points.shape)
    yield Case("room scanned twice, the scans told apart", points, true, viewpoint=places, scans=scans)


def by_cosine(case: Case, normals: np.ndarray) -> np.ndarray:
    way = case.up if case.viewpoint is None else case.viewpoint - case.points
    return normals * np.where((normals * way).sum(1) < 0, -1, 1)[:, None]


def by_open3d(case: Case) -> np.ndarray:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(case.points))
    if case.given is not None:
        cloud.normals = open3d.utility.Vector3dVector(case.given)
        cloud.orient_normals_consistent_tangent_plane(NEIGHBORS)
        found = np.asarray(cloud.normals)
        return -found if wrong(found, case.true) > 50 else found
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBORS))
    if case.viewpoint is None:
        cloud.orient_normals_to_align_with_direction(case.up)
        return np.asarray(cloud.normals)
    found = np.array(cloud.normals)
    for place in np.unique(np.atleast_2d(case.viewpoint), axis=0):
        cloud.orient_normals_towards_camera_location(place)
        found = np.where((case.viewpoint == place).all(-1, keepdims=True), np.asarray(cloud.normals), found)
    return found


def wrong(normals: np.ndarray, true: np.ndarray) -> float:
    """Percent of the normals that look to the other side than the true ones."""
    cosine = (normals * true).sum(1)
    return float(100 * (cosine[np.isfinite(cosine)] < 0).mean())


def measured(case: Case, folder: Path) -> dict[str, float]:
    before = pnu.normals(case.points) if case.given is None else case.given
    keys: dict[str, Any] = {"viewpoint": case.viewpoint, "up": case.up}
    if case.scans is not None:
        keys = {"scans": case.scans}
    ours = pnu.normals(case.points, case.given, **keys)
    for stage, normals in (("before", before), ("after", ours)):
        write_cloud(folder / f"{case.name.partition(',')[0].replace(' ', '_')}_{stage}.ply", case.points, normals)
    found = {
        "before": wrong(before, case.true),
        "pnu": wrong(ours, case.true),
        "open3d": wrong(by_open3d(case), case.true),
    }
    return found | ({} if case.given is not None else {"cosine": wrong(by_cosine(case, before), case.true)})


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.sides", description=__doc__)
    parser.add_argument("meshes", type=Path, help="folder of closed meshes, faces outward")
    parser.add_argument("--seed", type=int, default=1, help="of the scans")
    parser.add_argument("--output", type=Path, default=Path("outputs/sides"), help="folder for clouds and table")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    lines = [f"| cloud | points | {' | '.join(COLUMNS)} |", "|---|---:|" + "---:|" * len(COLUMNS)]
    for case in cases(arguments.meshes, arguments.seed):
        row = measured(case, arguments.output)
        values = (f"{row[column]:.2f}" if column in row else "" for column in COLUMNS)
        lines.append(f"| {case.name} | {len(case.points)} | {' | '.join(values)} |")
        print(lines[-1], flush=True)
    text = "\n".join([*lines, "", provenance([arguments.seed])]) + "\n"
    with atomic_path(arguments.output / "sides.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"\n{text}\n{arguments.output / 'sides.md'}")


if __name__ == "__main__":
    main()
