"""Compare trained networks and classical methods on one page: `pnu compare methods=[FOLDER,apss]`."""

import functools
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pnu.commands._entry import command, warn
from pnu.commands._protocol import KEEP, KINDS, MERGE, protocol_source
from pnu.config.instantiate import find_metric
from pnu.config.quoting import quoted, typed_line
from pnu.config.schema import Group, doc
from pnu.runtime.progress import steps
from pnu.runtime.provenance import provenance

if TYPE_CHECKING:
    from pnu.benchmark import Case, CaseSource, Method


@dataclass
class Compare:
    """Evaluate several methods on the same clouds; write a page with tables, surfaces and 3D views. Trains nothing."""

    commas: ClassVar = ("columns",)
    methods: list[str] = doc(
        "run folders, folders of a sweep, weights, and apss, poisson, midpoint, lop, wlop, ear, l0, open3d (its usual "
        "chain); NAME:FOLDER gives a run another name"
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
    passes: bool = doc("also networks that were trained for another ratio: by passes and farthest points")
    merge: str = doc(MERGE)
    keep: str = doc(KEEP)
    normals: str = doc("of the inputs: given, those of the shape; estimate: none, which surface has weights for")
    metrics: list[str] = doc("classes of metrics of your own, measured beside pnu's: [mylab.Roughness]")
    allow: list[str] = doc("packages of your own whose classes may be named, such as [mylab]")
    output: str | None = doc("folder for index.html, metrics.json, metrics.csv, figures/; null: in outputs/comparison/")
    surfaces: list[str] | None = doc("kinds of input whose clouds are made surfaces too; null: the first; []: none")
    shown: int = doc("shapes in the figures and 3D views, the first ones; the tables have all")
    picture: str | None = doc(
        "webp to write too, all shapes shown in one: their surfaces and errors, or with surfaces=[] clouds by normals"
    )
    page_mb: float = doc("size that the page should not exceed by much, in MB: fewer points of each cloud are shown")
    colormap: str = doc("of errors. error: red = zero to blue = high, as the paper; perceptual: dark to light")
    up: str = doc("figures: axis that points up: x, y or z")
    azimuth: float = doc("figures: degrees that the shape is turned about the axis up=")
    elevation: float = doc("figures: degrees that the camera looks from above")
    size: int = doc("figures: pixels of a panel's side")
    batch_size: int | None = doc("patches at once, bounds the memory; null: by the device")
    device: str = doc("auto, cpu, cuda, cuda:1 ...")
    seed: int = doc("of all that is drawn")
    quiet: bool = doc("print nothing but warnings and errors")


def compare(cfg: Any) -> None:
    """Run the methods on the shapes and write the page."""
    _check_options(cfg)
    from pnu import benchmark, metrics
    from pnu.report import comparison_page
    from pnu.report.comparison_tables import print_surfaces
    from pnu.training.run_folder import versions

    protocol, source = protocol_source(cfg)
    find = functools.partial(find_metric, allow=cfg.allow)
    chosen = protocol.metrics(metrics.with_own(cfg.metrics, find, benchmark.of_kinds(source.kinds)))
    rebuilt_kinds = source.kinds[:1] if cfg.surfaces is None else list(cfg.surfaces)
    if unknown := [kind for kind in rebuilt_kinds if kind not in source.kinds]:
        raise ValueError(f"surfaces={unknown[0]}: expected some of the kinds of input, {', '.join(source.kinds)}")
    methods = upsamplers(cfg)
    seen = seen_in_training(cfg, source)
    for text in seen:
        warn(text)
    output = benchmark.result_folder(cfg.output or Path("outputs", "comparison", source.name))
    shown: dict[tuple[str, str], comparison_page.ShownCase] = {}

    def keep(case: "Case", method: str, cloud: Any) -> None:
        if case.truth.shape in source.shapes[: cfg.shown]:
            one = shown.setdefault((case.truth.shape, case.kind), comparison_page.ShownCase.of(case))
            one.clouds[method] = cloud.astype("float32")

    with steps(len(source.shapes) * len(source.kinds) * (len(methods) + 1), cfg.quiet) as step:
        options = {"ratio": cfg.ratio, "seed": cfg.seed, "keep": keep, "step": step, "metrics": chosen}
        rows = list(benchmark.evaluate(methods, source.cases, **options))
    if not cfg.quiet:
        benchmark.print_tables(rows, f"{', '.join(methods)} on {source.name}", chosen)
        benchmark.print_over_seeds(rows, chosen)
        benchmark.print_published(protocol.published_rows(cfg.ratio))
    with steps(len(shown), cfg.quiet) as step:
        written = comparison_page.write_comparison(
            output,
            rows,
            list(shown.values()),
            title=f"Point cloud upsampling, {cfg.ratio:g} times: {', '.join(methods)}",
            head=[benchmark.legend(rows, chosen), *seen, f"Made by: {typed_line()}", provenance([1])],
            settings={key: cfg[key] for key in SETTINGS}
            | {
                "kinds": source.kinds,
                "protocol": protocol.said,
                "data": source.name,
                "versions": versions(),
                "made": provenance([1]),
            },
            rebuilt_kinds=rebuilt_kinds,
            look=comparison_page.Look(cfg.up, cfg.azimuth, cfg.elevation, cfg.size, cfg.colormap),
            page_mb=cfg.page_mb,
            picture=cfg.picture,
            metrics=chosen,
            seed=cfg.seed,
            step=step,
        )
    for text in written.notes:
        warn(text)
    if not cfg.quiet:
        print_surfaces(written.surfaces)
        print(f"{provenance([1])}\n" + f"picture: {cfg.picture}\n" * (cfg.picture is not None))
        print(f"output: {output}/index.html ({written.size / 1e6:.1f} MB), metrics.json, metrics.csv, figures/")
        print(f"next:   open {output}/index.html in a browser")


SETTINGS = ("methods", "points", "truth_points", "ratio", "merge", "keep", "normals", "seed")


def upsamplers(cfg: Any) -> dict[str, "Method"]:
    """The methods by name. ValueError for one that is neither a run folder nor a classical method, or named twice."""
    from pnu import benchmark, weights
    from pnu.networks import checkpoints
    from pnu.training.run_folder import run_name
    from pnu.upsamplers import CLASSICAL, classical

    found: dict[str, Method] = {}
    names = Counter(run_name(method) for method in cfg.methods if Path(method).is_dir())
    for method in with_runs_of_sweeps(cfg.methods):
        name, _, folder = ("", "", method) if Path(method).exists() else method.rpartition(":")
        model: Any
        if folder in (*CLASSICAL, "open3d"):
            model, name = None if folder == "open3d" else classical(folder), name or folder
        elif Path(folder).is_dir():
            own = run_name(folder)  # the time tells two runs of one name apart
            name = name or (own if names[own] < 2 else Path(folder).resolve().name)
            model = checkpoints.load(folder, cfg.allow)
        elif weights.find(folder):
            model, name = benchmark.measured_network(folder, cfg.allow), name or Path(folder).stem
        else:
            known = ", ".join([*CLASSICAL, "open3d", *weights.shipped_names()])
            raise ValueError(f"methods={method}: expected a run folder, or one of {known}; found neither")
        if name in found or name in ("input", "floor", "truth"):
            cure = quoted("methods", [f"NAME:{folder}"])
            raise ValueError(f"methods={method}: the name {name} is taken; give another one, {cure}")
        if model is None:
            found[name] = benchmark.open3d_chain(cfg.ratio, cfg.seed)
            continue
        found[name] = benchmark.network_upsampler(
            model,
            cfg.ratio,
            passes=cfg.passes,
            merge=cfg.merge,
            keep=cfg.keep,
            name=method,
            batch_size=cfg.batch_size,
            device=cfg.device,
            seed=cfg.seed,
        )
    return found


def seen_in_training(cfg: Any, source: "CaseSource") -> list[str]:
    """A line for each network that has seen some of the shapes in its training: those rows are no test of it."""
    from pnu.benchmark.trained_shapes import trained_on
    from pnu.upsamplers import CLASSICAL

    lines = []
    procedural = not cfg.data.get("root")
    for method in with_runs_of_sweeps(cfg.methods):
        name, _, folder = ("", "", method) if Path(method).exists() else method.rpartition(":")
        if folder in (*CLASSICAL, "open3d"):
            continue
        trained = trained_on(folder)
        if found := trained.of(source.shapes, procedural):
            listed = ", ".join(found[:8]) + (f" and {len(found) - 8} more" if len(found) > 8 else "")
            of = f"{len(found)} of the {len(source.shapes)} shapes" + ("" if procedural else ", by their names,")
            lines.append(f"{name or folder}: was trained on {of} and is not tested by them: {listed}")
        elif trained.unknown:
            lines.append(f"{name or folder}: whether these shapes were in its training is not known; {trained.unknown}")
    return lines


def with_runs_of_sweeps(methods: Iterable[str]) -> list[str]:
    """The methods, the folder of a sweep replaced by its runs.

    Runs of several sweeps that have one name but for the seed are called NAME_seed-N, as those of one sweep are.
    """
    from pnu.networks.checkpoints import run_config

    methods = list(methods)
    listed = {method: runs_of_sweep(method) for method in methods}
    names = [name for found in listed.values() for name, _, _ in (run.partition(":") for run in found)]
    stems = Counter(name.rpartition("_seed-")[0] or name for name in names)

    def told_apart(run: str) -> str:
        name, _, folder = run.partition(":")
        config = Path(folder, "config.yaml")
        if "_seed-" in name or stems[name] < 2 or not config.is_file():
            return run
        return f"{name}_seed-{run_config(Path(folder)).get('seed', 0)}:{folder}"

    return [one for method in methods for one in ([told_apart(run) for run in listed[method]] or [method])]


def runs_of_sweep(method: str) -> list[str]:
    """NAME:FOLDER of each finished run of a sweep; none if `method` is no sweep's folder. The name has no hash."""
    from pnu.training.sweeps import runs

    if not Path(method).is_dir() or Path(method, "config.yaml").exists():
        return []
    finished = [run for run in runs(Path(method)) if run.read_record().get("status") == "finished"]
    return [f"{run.path.name.rpartition('_')[0]}:{run.path}" for run in finished]


def _check_options(cfg: Any) -> None:
    """Refuse what can be refused before anything is loaded."""
    from pnu.io import check_writable
    from pnu.rendering.colors import COLORMAPS

    for key, known in (("normals", ("given", "estimate")), ("colormap", tuple(COLORMAPS)), ("up", ("x", "y", "z"))):
        if cfg[key] not in known:
            raise ValueError(f"{key}={cfg[key]}: expected {' or '.join(known)}")
    if not cfg.methods:
        raise ValueError("methods=[]: expected run folders or classical methods, such as methods=[apss,poisson]")
    if not 1 <= cfg.ratio < float("inf"):
        raise ValueError(f"ratio={cfg.ratio:g}: expected a number >= 1, the points out for each point in")
    for key, least, most in (("shown", 1, 1000), ("page_mb", 1, 1000), ("size", 64, 2048)):
        if not least <= cfg[key] <= most:
            raise ValueError(f"{key}={cfg[key]:g}: expected a number from {least} to {most}")
    if cfg.picture is not None:
        if Path(cfg.picture).suffix.lower() != ".webp":
            raise ValueError(f"picture={cfg.picture}: expected a name that ends in .webp")
        check_writable(cfg.picture)


main = command(compare, Compare)

if __name__ == "__main__":
    main()
