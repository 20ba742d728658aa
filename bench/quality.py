"""How good upsampled clouds are: `python -m bench.quality [FOLDER] [--settings given noise_1 ...] [--methods ...]`.

FOLDER holds pairs, clouds/NAME.xyz with normals and truth/NAME.ply with truth/NAME_<count>.npy; without it the test
part of the procedural shapes is drawn. Each setting changes these inputs in one way; all methods get the same points,
and where a setting gives no normals the same estimated ones, but for "surface", which finds its own. --surfaces
measures Poisson surfaces of the input, of its dense versions and of the truth's own samples. Every setting is kept in
OUTPUT/quality_<setting>.json, and OUTPUT/quality.md has the tables of all.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import nn

from pnu import metrics, reconstruction
from pnu.benchmark import Case, Row, case_source, columns, summarize
from pnu.benchmark.cases import generator
from pnu.benchmark.result_tables import row_cell
from pnu.cleaning import Treatment
from pnu.geometry.mesh_topology import vertex_normals
from pnu.geometry.normal_estimation import estimate_normals
from pnu.io import atomic_path, read_json, write_cloud, write_json, write_mesh
from pnu.metrics.ray_casting import closest_points
from pnu.networks import checkpoints
from pnu.runtime.provenance import provenance
from pnu.upsamplers import CLASSICAL, Upsampler, classical
from pnu.upsamplers.whole_clouds import upsample


class Setting(NamedTuple):
    """What is made of an input: some of its points at random, Gaussian noise in units of the radius, the ratio."""

    title: str
    given: bool = False  # with the normals of the file,
    planes: int = 0  # or with those of planes fitted to so many neighbors, on the right side, as files often have them
    points: int | None = None
    noise: float = 0.0
    ramp: float = 0.0  # noise that grows with the square of x, from none at the one end to this at the other
    ratio: float = 4


SETTINGS = {
    "given": Setting("normals given", given=True),
    "points": Setting("points only"),
    "noise_0.5": Setting("points only, noise 0.5 %", noise=0.005),
    "noise_1": Setting("points only, noise 1 %", noise=0.01),
    "given_noise_0.5": Setting("normals given, noise 0.5 %", given=True, noise=0.005),
    "noise_0_2": Setting("points only, noise from 0 to 2 %", ramp=0.02),
    "given_noise_0_2": Setting("normals given, noise from 0 to 2 %", given=True, ramp=0.02),
    "planes": Setting("plane fits given as normals", planes=16),
    "planes_noise_0.5": Setting("plane fits given as normals, noise 0.5 %", planes=16, noise=0.005),
    "planes_2048": Setting("plane fits given as normals, 2048 points", planes=16, points=2048),
    "given_2048": Setting("normals given, 2048 points", given=True, points=2048),
    "2048": Setting("points only, 2048 points", points=2048),
    "given_625": Setting("normals given, 625 points", given=True, points=625),
    "625": Setting("points only, 625 points", points=625),
    "x2": Setting("normals given, x2", given=True, ratio=2),
    "x7.3": Setting("normals given, x7.3", given=True, ratio=7.3),
    "x8": Setting("normals given, x8", given=True, ratio=8),
    "x16": Setting("normals given, x16", given=True, ratio=16),
}
METHODS = ("surface", *CLASSICAL)
COLUMNS = ("chamfer_sq", "hausdorff_sq", "p2f", "normal_unsigned_deg", "flipped", "spacing_cv")
ERRORS = ("to_truth_mean", "to_truth_rms", "to_truth_max", "from_truth_mean", "from_truth_max", "normal_deg_mean")
LEGEND = (
    "CD: mean squared distances, both directions added; HD: largest squared distance; P2F: mean distance to the true "
    "mesh; all x 1e3, in the unit sphere of the truth. Normals: mean unsigned angle in degrees, and % of them flipped. "
    "Spacing: standard deviation over mean of the nearest distance. Means over {shapes} shapes."
)


def inputs(cases: Iterator[Case], setting: Setting, seed: int) -> Iterator[Case]:
    """The cases as a setting wants them, always with normals: true ones or estimated."""
    for case in cases:
        rng = generator(seed, case.truth.shape, setting.title)
        points, normals = case.points, case.normals
        if setting.points is not None and setting.points < len(points):
            kept = rng.choice(len(points), setting.points, replace=False)
            points, normals = points[kept], normals[kept] if normals is not None else None
        if setting.noise:
            points = points + setting.noise * rng.standard_normal(points.shape)
        if setting.ramp:
            along = (points[:, :1] - points[:, 0].min()) / np.ptp(points[:, 0])
            points = points + setting.ramp * along**2 * rng.standard_normal(points.shape)
        if setting.planes and normals is not None:
            planes = estimate_normals(points, setting.planes, orient=False)
            normals = np.where((planes * normals).sum(1, keepdims=True) < 0, -planes, planes)
        elif not setting.given:
            normals = estimate_normals(points)
        if normals is None:
            raise ValueError(f"{case.truth.shape}: has no normals, which the setting '{setting.title}' needs")
        yield Case(setting.title, points, normals, case.truth)


def network(method: str) -> nn.Module | Upsampler | str:
    """A classical method, or weights or a run; "surface" by its name, which means the weights that fit a cloud."""
    if method in CLASSICAL:
        return classical(method)
    return method if method == "surface" else checkpoints.load(method)


def normals_for(method: str, case: Case, setting: Setting) -> np.ndarray | None:
    """Those that a method gets: "surface" finds missing ones by itself, as for users."""
    return case.normals if setting.given or setting.planes or method != "surface" else None


def clouds(cases: list[Case], setting: Setting, methods: list[str], seed: int, folder: Path) -> Iterator[Row]:
    """Metrics of each method on each case; its cloud is written to folder/<method>/<shape>.ply."""
    for method in methods:
        model = network(method)
        for case in cases:
            normals = normals_for(method, case, setting)
            # all others get the same normals, also where better ones could be found
            signs: Treatment = "auto" if method == "surface" else "keep"
            dense = upsample(case.points, normals, ratio=setting.ratio, model=model, signs=signs, seed=seed)
            (folder / Path(method).name).mkdir(parents=True, exist_ok=True)
            write_cloud(folder / Path(method).name / f"{case.truth.shape}.ply", dense[:, :3], dense[:, 3:])
            values = metrics.compare(dense, case.truth.samples)
            if case.truth.mesh is not None:
                values |= metrics.compare_mesh(dense, case.truth.mesh, closest=closest_points)
            head = {"shape": case.truth.shape, "kind": setting.title, "method": Path(method).name}
            yield head | {"points_in": len(case.points)} | {name: float(value) for name, value in values.items()}


def poisson(cases: list[Case], setting: Setting, methods: list[str], seed: int, folder: Path) -> Iterator[Row]:
    """Errors of the Poisson surfaces of inputs, dense versions and samples of the truth, over the true radius."""
    for case in cases:
        assert case.normals is not None
        assert case.truth.mesh is not None
        found = {"input": np.hstack([case.points, case.normals])}
        if case.truth.samples.shape[1] == 6:
            found["samples of the truth"] = case.truth.samples  # what no upsampling beats at as many points
        for method in methods:
            if method != "poisson":
                found[Path(method).name] = upsample(
                    case.points,
                    normals_for(method, case, setting),
                    ratio=setting.ratio,
                    model=network(method),
                    seed=seed,
                )
        for method, cloud in found.items():
            mesh = reconstruction.reconstruct(cloud[:, :3], cloud[:, 3:], name=case.truth.shape).mesh
            errors = reconstruction.surface_errors(mesh, case.truth.mesh, rng=np.random.default_rng(seed))
            (folder / method).mkdir(parents=True, exist_ok=True)
            write_mesh(
                folder / method / f"{case.truth.shape}_surface.ply", mesh, vertex_normals=vertex_normals(mesh),
                quality=errors.distance,
            )  # fmt: skip
            summary = errors.summary()
            head = {"shape": case.truth.shape, "kind": setting.title, "method": method}
            yield head | {name: value for name, value in summary.items() if name in ERRORS}


def cloud_lines(rows: list[Row]) -> list[str]:
    shown = [one for one in columns(rows) if one.name in COLUMNS]
    heads = [one.head for one in shown]
    lines = [f"| input | method | {' | '.join(heads)} |", "|---|---|" + "---|" * len(shown)]
    for summary in summarize(rows):
        cells = (row_cell(summary, one) for one in shown)
        lines.append(f"| {summary['kind']} | {summary['method']} | {' | '.join(cells)} |")
    return lines


def surface_lines(rows: list[Row]) -> list[str]:
    heads = ("mean", "RMS", "max", "truth to it: mean", "max", "normals, degrees")
    lines = [f"| Poisson surface of | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
    groups = list(dict.fromkeys((row["kind"], row["method"]) for row in rows))
    for kind, method in groups:
        mine = [row for row in rows if (row["kind"], row["method"]) == (kind, method)]
        means = [np.mean([row[name] for row in mine]) * (1 if "normal" in name else 1e3) for name in ERRORS]
        lines.append(f"| {kind}: {method} | {' | '.join(f'{value:.2f}' for value in means)} |")
    return lines


def written(output: Path) -> str:
    """The tables of all settings that were measured."""
    found = [read_json(path) for name in SETTINGS if (path := output / f"quality_{name}.json").is_file()]
    rows = [row for content in found for row in content["rows"]]
    meshes = [row for content in found for row in content["surfaces"]]
    lines = [*cloud_lines(rows), "", LEGEND.format(shapes=len({row["shape"] for row in rows}))] if rows else []
    if meshes:
        lines += ["", *surface_lines(meshes), "", "Distances in 1/1000 of the true radius."]
    made = dict.fromkeys(content["made"] for content in found if "made" in content)
    return "\n".join([*lines, "", *made]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.quality", description=__doc__)
    parser.add_argument("folder", nargs="?", help="with clouds/ and truth/; default: procedural shapes")
    parser.add_argument("--settings", nargs="+", default=list(SETTINGS), choices=list(SETTINGS), metavar="SETTING")
    parser.add_argument(
        "--methods", nargs="*", default=list(METHODS), help="surface apss poisson midpoint, weights, runs"
    )
    parser.add_argument("--surfaces", action="store_true", help="measure Poisson surfaces instead of clouds")
    parser.add_argument("--shapes", nargs="+", help="names of the shapes to take; default: all")
    parser.add_argument("--output", type=Path, default=Path("outputs/quality"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    data = {"root": arguments.folder} if arguments.folder else {"kinds": ["organic", "cad"]}
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.settings:
        setting = SETTINGS[name]
        found = case_source(data, ["random"], only=arguments.shapes, seed=arguments.seed, warn=lambda text: None)
        cases = list(inputs(found.cases, setting, arguments.seed))
        path = arguments.output / f"quality_{name}.json"
        content = read_json(path) if path.is_file() else {"rows": [], "surfaces": []}
        part, measure = ("surfaces", poisson) if arguments.surfaces else ("rows", clouds)
        new = list(measure(cases, setting, arguments.methods, arguments.seed, arguments.output / name))
        kept = [row for row in content[part] if row["method"] not in {row["method"] for row in new}]
        order = [*METHODS, "input"]
        content[part] = sorted(new + kept, key=lambda row: order.index(row["method"]) if row["method"] in order else -1)
        write_json(path, content | {"data": found.name, "seed": arguments.seed, "made": provenance([1])})
        print("\n".join((surface_lines if arguments.surfaces else cloud_lines)(new)), flush=True)
    with atomic_path(arguments.output / "quality.md") as path:
        path.write_text(written(arguments.output), encoding="utf-8")
    print(f"output: {arguments.output}/quality.md")


if __name__ == "__main__":
    main()
