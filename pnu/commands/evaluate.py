"""Measure a trained network, or a classical method, on whole clouds: `pnu evaluate run=FOLDER`."""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pnu.commands._entry import command
from pnu.commands._normal_task import evaluate_task
from pnu.commands._protocol import KEEP, KINDS, MERGE, protocol_source
from pnu.config.instantiate import find_metric
from pnu.config.quoting import shell_line
from pnu.config.schema import Group, doc
from pnu.runtime.progress import steps
from pnu.runtime.provenance import provenance

NORMALS = {"given": "as given", "estimate": "estimated"}
DEFAULT = "surface"  # without run= and method=
SETTINGS = ("ratio", "points", "truth_points", "merge", "keep", "normals", "search", "passes", "seed")


@dataclass
class Evaluate:
    """Upsample whole clouds of several kinds and measure them against the truth: tables. `model=NAME` is `run=NAME`."""

    also: ClassVar = {"model": "run"}
    commas: ClassVar = ("columns",)
    task: str = doc("upsampling; or normals: PCA, jets, pnu's estimate and a run of task=normals, on PCPNet's kinds")
    run: str | None = doc(
        "run folder, or name or file of weights; newest: the run that finished last; null: `method`, or surface"
    )
    method: str | None = doc(
        "upsampler without training instead of a run: apss, poisson, midpoint, lop, wlop, ear, l0, open3d (its chain)"
    )
    data: Group = doc(
        "Shapes: procedural, or of data=meshes data.root=FOLDER: meshes, pairs in clouds/ truth/ or input_N/ gt_N/"
    )
    part: str | None = doc("of the shapes: train, val, test, all; null: test of the procedural ones, all of a folder")
    shapes: list[str] | None = doc("names of the shapes to take; null: all of the part")
    protocol: Group = doc("Protocol: sampling, frame, definitions")
    kinds: list[str] | None = doc(KINDS)
    points: int | None = doc("points of an input cloud; null: the protocol's")
    truth_points: int | None = doc("points on the true surface to compare with; null: the protocol's")
    columns: str | None = doc(
        "of prepared pairs' text, or arrays without names: x,y,z,_,nx,ny,nz; null: by their names or the usual order"
    )
    ratio: float = doc("points out for each point in")
    passes: bool = doc("also where the network was trained for another ratio: by passes and farthest points")
    merge: str = doc(MERGE)
    keep: str = doc(KEEP)
    normals: str = doc("of the inputs: given, those of the shape; estimate: none, which run=surface has weights for")
    search: str = doc("for closest surface points. exact; open3d: as other scripts (differs in the faces at edges)")
    metrics: list[str] = doc("classes of metrics of your own, measured beside pnu's: [mylab.Roughness]")
    allow: list[str] = doc("packages of your own whose classes may be named, such as [mylab]")
    output: str | None = doc("folder for metrics.json and metrics.csv; null: evaluation/ in the run, or in outputs/")
    save: bool = doc("write the upsampled clouds too, in the frame of the comparison, to the folder's clouds/")
    patch_size: int | None = doc("points of a patch; null: what the network was made for")
    batch_size: int | None = doc("patches at once, bounds the memory; null: by the device")
    device: str = doc("auto, cpu, cuda, cuda:1 ...")
    seed: int = doc("of all that is drawn")
    quiet: bool = doc("print nothing but warnings and errors")


def evaluate(cfg: Any) -> None:
    """Measure one method on the shapes; tables, and files in the run folder."""
    _check_options(cfg)
    if cfg.task == "normals":
        evaluate_task(cfg)
        return
    from pnu import benchmark, io, metrics
    from pnu.geometry.mesh_sampling import closest_points
    from pnu.metrics import ray_casting
    from pnu.networks import checkpoints
    from pnu.training.run_folder import run_name
    from pnu.upsamplers import CLASSICAL, classical

    protocol, source = protocol_source(cfg)
    find = functools.partial(find_metric, allow=cfg.allow)
    chosen = protocol.metrics(metrics.with_own(cfg.metrics, find, benchmark.of_kinds(source.kinds)))
    subject = cfg.method or str(checkpoints.resolve(cfg.run or DEFAULT))
    if cfg.method not in (None, "open3d", *CLASSICAL):
        raise ValueError(f"method={cfg.method}: expected one of {', '.join(CLASSICAL)} or open3d")
    if cfg.method == "open3d":
        upsampler = benchmark.open3d_chain(cfg.ratio, cfg.seed)
    else:
        model = classical(subject) if cfg.method else benchmark.measured_network(subject, cfg.allow)
        upsampler = benchmark.network_upsampler(
            model, cfg.ratio, passes=cfg.passes, merge=cfg.merge, keep=cfg.keep, name=subject,
            patch_size=cfg.patch_size, batch_size=cfg.batch_size, device=cfg.device, seed=cfg.seed,
        )  # fmt: skip
    is_run = not cfg.method and Path(subject).is_dir()
    name = run_name(subject) if is_run else Path(subject).stem
    name += "_estimated" if cfg.normals == "estimate" and not is_run else ""
    default = Path(subject, "evaluation") if is_run else Path("outputs", "evaluation", name)
    within = subject if is_run and not cfg.output else None
    output = benchmark.result_folder(cfg.output or default / source.name, within)
    clouds = benchmark.result_folder(output / "clouds", within) if cfg.save else None

    def keep(case: benchmark.Case, method: str, cloud: Any) -> None:
        if clouds:
            io.write_cloud(clouds / f"{case.truth.shape}_{case.kind}.ply", cloud[:, :3], cloud[:, 3:])

    with steps(2 * len(source.shapes) * len(source.kinds), cfg.quiet) as step:
        closest = ray_casting.closest_points if cfg.search == "open3d" else closest_points
        rows = list(
            benchmark.evaluate(
                {name: upsampler},
                source.cases,
                ratio=cfg.ratio,
                seed=cfg.seed,
                closest=closest,
                keep=keep,
                step=step,
                metrics=chosen,
            )
        )
    made = provenance([1])
    head = {key: cfg[key] for key in SETTINGS} | {
        "protocol": protocol.said,
        "subject": subject,
        "data": source.name,
        "made": made,
    }
    benchmark.write_results(output, rows, head, chosen)
    if not cfg.quiet:
        benchmark.print_tables(rows, f"{subject}, normals of the input {NORMALS[cfg.normals]}. {made}", chosen)
        benchmark.print_published(protocol.published_rows(cfg.ratio))
        print(f"output: {output}/metrics.json, metrics.csv{', clouds/' if cfg.save else ''}")
        data = {"data": "meshes", "data.root": cfg.data.root} if cfg.data.get("root") else {}
        data |= {"columns": cfg.columns} if cfg.columns else {}
        rival = "poisson" if subject == "apss" else "apss"
        print(f"next:   {shell_line('compare', methods=[subject, rival], **data)}")


def _check_options(cfg: Any) -> None:
    """Refuse what can be refused before anything is loaded."""
    for key, known in (
        ("task", ("upsampling", "normals")),
        ("normals", tuple(NORMALS)),
        ("search", ("exact", "open3d")),
    ):
        if cfg[key] not in known:
            raise ValueError(f"{key}={cfg[key]}: expected {' or '.join(known)}")
    if cfg.run and cfg.method:
        raise ValueError(f"run={cfg.run} and method={cfg.method}: expected one of them; `pnu compare` takes several")
    if not 1 <= cfg.ratio < float("inf"):
        raise ValueError(f"ratio={cfg.ratio:g}: expected a number >= 1, the points out for each point in")


main = command(evaluate, Evaluate)

if __name__ == "__main__":
    main()
