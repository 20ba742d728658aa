"""`pnu evaluate task=normals`: estimates of normals on clouds of PCPNet's kinds."""

from pathlib import Path
from typing import Any

from pnu.config.quoting import shell_line
from pnu.runtime.progress import steps
from pnu.runtime.provenance import provenance

POINTS = 5000  # of a cloud, where points= says nothing
SETTINGS = ("task", "run", "method", "seed")


def evaluate_task(cfg: Any) -> None:
    """Measure PCA, jets and pnu, a run beside them, or the one that `method` names; tables, and a file in a folder."""
    from pnu import benchmark
    from pnu.benchmark import normal_task
    from pnu.benchmark.case_sources import shape_makers
    from pnu.data.normal_patches import NORMAL_KINDS
    from pnu.io import write_json
    from pnu.networks import checkpoints
    from pnu.training.run_folder import run_name

    methods = normal_task.estimators()
    if cfg.run:
        subject = str(checkpoints.resolve(cfg.run))
        network = checkpoints.load(subject, cfg.allow)
        methods |= {run_name(subject): normal_task.network_estimator(network, subject)}
    elif cfg.method is not None:
        if cfg.method not in methods:
            raise ValueError(f"method={cfg.method}: expected {', '.join(methods)} with task=normals")
        methods = {cfg.method: methods[cfg.method]}
    points = POINTS if cfg.points is None else cfg.points
    if points < 64:
        raise ValueError(f"points={points}: expected at least 64")
    name, makers = shape_makers(cfg.data, cfg.part, cfg.shapes)
    kinds = list(NORMAL_KINDS if cfg.kinds is None else cfg.kinds)
    cases = normal_task.normal_cases(makers, kinds, points=points, seed=cfg.seed)
    output = benchmark.result_folder(cfg.output or Path("outputs", "evaluation", "normals", name))
    with steps(len(makers) * len(kinds) * len(methods), cfg.quiet) as step:
        rows = list(normal_task.evaluate_normals(methods, cases, step))
    head = {key: cfg[key] for key in SETTINGS} | {"points": points, "data": name, "made": provenance([1])}
    write_json(output / "metrics.json", {**head, "rows": rows, "summary": normal_task.mean_rows(rows)})
    if not cfg.quiet:
        normal_task.print_normal_tables(rows)
        print(f"output: {output}/metrics.json")
        print(f"next:   {shell_line('normals', input='cloud.ply', output='with_normals.ply')}")
