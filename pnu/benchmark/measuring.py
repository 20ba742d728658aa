"""Run upsamplers on cases and measure what comes out."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from torch import nn

from pnu import upsamplers
from pnu.benchmark.cases import SCANS, Case, Truth, generator
from pnu.benchmark.cost import Cost
from pnu.geometry.mesh_sampling import closest_points, sample_poisson_disk
from pnu.geometry.normal_estimation import complete_normals
from pnu.metrics import METRICS, Metric, Pair, measured
from pnu.metrics.functional import ClosestPoints
from pnu.metrics.scan_scores import SCAN_METRICS, SHARED
from pnu.networks import checkpoints
from pnu.upsamplers import whole_clouds

Row = dict[str, Any]
"""shape, kind, frame, truth_points, method, points_in, points_out, and the metrics; lengths in the frame of the truth,
not x 1e3."""

Method = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
"""points (n, 3), normals (n, 3) or None -> cloud (m, 6)."""


def evaluate(
    methods: Mapping[str, Method],
    cases: Iterable[Case],
    *,
    ratio: float,
    seed: int = 0,
    closest: ClosestPoints = closest_points,
    keep: Callable[[Case, str, np.ndarray], None] | None = None,
    step: Callable[[str], None] = lambda text: None,
    metrics: Sequence[Metric] = METRICS,
) -> Iterator[Row]:
    """Rows for each case: every method, then two to judge them by.

    "input" is the input itself. "floor" is another Poisson-disk sampling of the true mesh with as many points as a
    method gives: what perfect points on the true surface would score; simulated scans have none.
    `keep` gets every cloud; `step` is told what comes next.
    ValueError, naming method and shape, if a method gives another number of points than round(ratio n).
    """
    chosen = {True: [m for m in metrics if is_of_scans(m)], False: [m for m in metrics if m not in SCAN_METRICS]}
    floors: dict[tuple[str, int], Row] = {}
    for case in cases:
        truth, shown = case.truth, chosen[case.kind in SCANS]
        head = {"shape": truth.shape, "kind": case.kind, "frame": truth.frame, "truth_points": len(truth.samples)}
        wanted = round(ratio * len(case.points))
        for name, upsample in methods.items():
            step(f"{truth.shape}, {case.kind}: {name}")
            with Cost() as cost:
                cloud = upsample(case.points, case.normals)
            if len(cloud) != wanted:
                raise ValueError(f"{name}: gave {len(cloud)} points for {truth.shape}, expected {wanted}")
            if keep:
                keep(case, name, cloud)
            counts = {"method": name, "points_in": len(case.points), "points_out": wanted}
            yield head | counts | measure(cloud, truth, closest, shown) | cost.values
        step(f"{truth.shape}, {case.kind}: references")
        if truth.mesh is not None and case.kind not in SCANS:  # no perfect points would lie where nothing was seen
            key = truth.shape, wanted
            if key not in floors:
                other = sample_poisson_disk(truth.mesh, wanted, generator(seed, truth.shape, f"floor {wanted}"))
                floors[key] = measure(other, truth, closest, shown)
            yield head | {"method": "floor", "points_in": 0, "points_out": wanted} | floors[key]
        cloud = np.hstack([case.points, normals_of(case)])
        counts = {"method": "input", "points_in": len(cloud), "points_out": len(cloud)}
        yield head | counts | measure(cloud, truth, closest, shown)


def is_of_scans(metric: Metric) -> bool:
    """Whether a metric is measured of clouds made from scans: theirs, some of the usual ones, and one's own."""
    return metric not in METRICS or isinstance(metric, SHARED)


def of_kinds(kinds: Iterable[str]) -> tuple[Metric, ...]:
    """The metrics to measure for inputs of these kinds: those of scans too, where there are some."""
    return (*METRICS, *(SCAN_METRICS if set(kinds) & set(SCANS) else ()))


def measure(
    cloud: np.ndarray, truth: Truth, closest: ClosestPoints = closest_points, metrics: Sequence[Metric] = METRICS
) -> dict[str, float]:
    """All metrics of a cloud (m, 3 or 6) by name; those that the truth cannot tell are left out."""
    found = measured(Pair(cloud, truth.samples, truth.mesh, closest=closest, unit=truth.unit), metrics)
    return {name: float(value) for name, value in found.items()}


def normals_of(case: Case) -> np.ndarray:
    """The normals of a case's input, or None where it has none."""
    return np.asarray(complete_normals(case.points, case.normals))


def measured_network(name: str, allow: Sequence[str] = ()) -> nn.Module | str:
    """The network of a run folder or of weights; "surface" by its name, which means the weights that fit a cloud."""
    return name if name == "surface" else checkpoints.load(name, allow)


def network_upsampler(
    model: nn.Module | upsamplers.Upsampler | str,
    ratio: float,
    *,
    passes: bool = False,
    keep: bool | str = "auto",
    name: str = "run",
    **options: Any,
) -> Method:
    """A network, or a classical method, as an upsampler: through `pnu.upsample`, as users call it.

    Raises:
        ValueError: the network was trained for another ratio, and `passes` does not allow to reach this one by several
            passes or by leaving points out; or `keep` is true, and the method does not keep the points given.
    """
    trained = getattr(model, "ratio", None)
    patches = not isinstance(model, str) and isinstance(upsamplers.upsampler_of(model), upsamplers.Patches)
    if patches and trained != ratio and not passes:
        raise ValueError(
            f"ratio={ratio:g}: {name} was trained for {trained}; give ratio={trained}, or passes=true to "
            f"reach {ratio:g} by passes and farthest points"
        )
    if not patches:  # what is compared beside networks of patches has none to merge
        options.pop("merge", None)
    kept: Any = {"true": True, "false": False}.get(str(keep).lower(), keep)
    if kept is True and not isinstance(model, str) and not getattr(upsamplers.upsampler_of(model), "keeps", False):
        raise ValueError(f"keep=true: {name} spreads all points anew; leave it out")

    def upsampler(points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
        return whole_clouds.upsample(points, normals, ratio=ratio, model=model, keep=kept, **options)

    return upsampler
