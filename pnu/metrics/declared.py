"""What a metric is, and all that are shown: each with its function, its names, its unit and its form in one place.

Training, TensorBoard, report, evaluate and compare take them from `METRICS`, and from what `metrics=[...]` adds.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np  # noqa: F401  the examples
from numpy.typing import ArrayLike
from torch import Tensor

from pnu.geometry.mesh_sampling import closest_points
from pnu.io import Mesh
from pnu.metrics import functional
from pnu.metrics.functional import ClosestPoints, Pair


class Shown(NamedTuple):
    """How a value is named and printed, wherever it is shown.

    name: its key, in files and curves. title: with factor and unit, in words. head: of a narrow column; "": the title.
    factor: a printed number is the value times this. unit: of the value itself. form: of the printed number. better:
    "lower" or "higher".
    """

    name: str
    title: str
    head: str = ""
    factor: float = 1.0
    unit: str = ""
    form: str = ".3f"
    better: str = "lower"

    def text(self, value: float | None, sign: str = "") -> str:
        """The number as it is printed; "-" for none. sign: "+" to show it always."""
        return "-" if value is None or value != value else format(self.factor * value, sign + self.form)

    @classmethod
    def read(cls, name: str, found: Any) -> "Shown":
        """From a record that may be another program's: what is missing or no fit is as for an unknown metric."""
        known = found if isinstance(found, Mapping) else {}
        kept = {
            field: type(default)(known[field])
            for field, default in cls._field_defaults.items()
            if isinstance(known.get(field), int | float if isinstance(default, float) else str)
        }
        return cls(name, str(known.get("title", name)), **kept)


class Metric:
    """One value for each cloud. A metric of one's own is a subclass with `shown` and `__call__`.

    needs: what a comparison must have: "target" points, the true "mesh", "normals" of both. patches: whether training
    measures it too, on each patch; False for what is slow or means something on whole clouds alone.

    >>> class Reach(Metric):
    ...     shown = Shown("reach", "greatest coordinate x 1e3", factor=1e3)
    ...     needs = ()
    ...
    ...     def __call__(self, pair: Pair) -> Tensor:
    ...         return pair.prediction[..., :3].abs().amax((1, 2))
    >>> float(measured(Pair([[0.0, 2.0, 1.0]]), [Reach()])["reach"])
    2.0
    """

    shown: Shown
    needs: ClassVar[Sequence[str]] = ("target",)
    patches: ClassVar[bool] = True
    words: str = ""  # for the legend of a table

    def __call__(self, pair: Pair) -> Tensor:
        """Values (B,) of a batch of clouds."""
        raise NotImplementedError


class ChamferSq(Metric):
    """Chamfer distance: mean squared nearest distances, both ways added."""

    shown = Shown("chamfer_sq", "CD x 1e3", "CD", 1e3, "length squared", ".4f")
    words = "CD: mean squared distances, both directions added"

    def __call__(self, pair: Pair) -> Tensor:
        return functional.chamfer_sq(pair)


class HausdorffSq(Metric):
    """Hausdorff distance, squared: the larger of both maxima."""

    shown = Shown("hausdorff_sq", "HD (squared) x 1e3", "HD", 1e3, "length squared")
    words = "HD: largest squared distance"

    def __call__(self, pair: Pair) -> Tensor:
        return functional.hausdorff_sq(pair)


class P2F(Metric):
    """Mean distance to the true mesh."""

    shown = Shown("p2f", "P2F x 1e3", "P2F", 1e3, "length")
    words = "P2F: mean distance to the true mesh"
    needs = ("mesh",)

    def __call__(self, pair: Pair) -> Tensor:
        return functional.point_to_mesh(pair)


class NormalDeg(Metric):
    """Mean angle to the true normal, 0 to 180 degrees."""

    shown = Shown("normal_deg", "normal error, signed (deg)", "normal", unit="degrees", form=".2f")
    needs = ("normals",)

    def __call__(self, pair: Pair) -> Tensor:
        return functional.normal_error(pair).signed_deg


class NormalUnsignedDeg(Metric):
    """Mean angle between the lines of the normals, 0 to 90 degrees."""

    shown = Shown("normal_unsigned_deg", "normal error, unsigned (deg)", "unsigned", unit="degrees", form=".2f")
    needs = ("normals",)

    def __call__(self, pair: Pair) -> Tensor:
        return functional.normal_error(pair).unsigned_deg


class Flipped(Metric):
    """Share of normals more than 90 degrees off."""

    shown = Shown("flipped", "normals flipped (%)", "flipped", 100.0, "share", ".2f")
    needs = ("normals",)

    def __call__(self, pair: Pair) -> Tensor:
        return functional.normal_error(pair).flipped


class SpacingCV(Metric):
    """Variation of the distance to the nearest point."""

    shown = Shown("spacing_cv", "spacing, variation", "spacing")
    needs = ()

    def __call__(self, pair: Pair) -> Tensor:
        return functional.spacing_cv(pair.prediction)


class UniformityCV(Metric):
    """Variation of the number of points on equal areas."""

    shown = Shown("uniformity", "density, variation", "uniform.")
    patches = False

    def __call__(self, pair: Pair) -> Tensor:
        assert pair.target is not None
        return functional.uniformity(pair.prediction, pair.target)


METRICS: tuple[Metric, ...] = (
    *(ChamferSq(), HausdorffSq(), P2F(), NormalDeg(), NormalUnsignedDeg(), Flipped(), SpacingCV(), UniformityCV()),
)
"""In the order of the tables."""


def with_own(
    names: Iterable[str], find: Callable[[str], type], metrics: Sequence[Metric] = METRICS
) -> tuple[Metric, ...]:
    """The metrics, and those of the classes with these dotted names.

    Args:
        find: gives the class of a dotted name, and decides whose code may run.

    Raises:
        ValueError: no subclass of `Metric`, or one whose name in files is taken.
    """
    found = list(metrics)
    for name in names:
        cls = find(name)
        if not (issubclass(cls, Metric) and isinstance(getattr(cls, "shown", None), Shown)):
            raise ValueError(f"metrics={name}: expected a subclass of pnu.metrics.Metric that says how it is shown")
        if cls.shown.name in {metric.shown.name for metric in found}:
            raise ValueError(f"metrics={name}: the name {cls.shown.name} is taken; give it another one in `shown`")
        found.append(cls())
    return tuple(found)


def measured(pair: Pair, metrics: Iterable[Metric] = METRICS) -> dict[str, Tensor]:
    """The metrics for which the pair has what they need, by name: 0-d tensors of one cloud, else (B,)."""
    found = {}
    for metric in metrics:
        if pair.has.issuperset(metric.needs):
            values = metric(pair).reshape(-1)
            if len(values) != len(pair.prediction):
                raise ValueError(f"{metric.shown.name}: expected a value for each cloud, found {len(values)}")
            found[metric.shown.name] = pair.result(values)
    return found


def compare(prediction: Tensor | ArrayLike, target: Tensor | ArrayLike) -> dict[str, Tensor]:
    """The metrics of two clouds that training measures, from one search in each direction and one for the spacing.

    Those of the normals, against the normal of the nearest target point, where both clouds have normals.

    >>> sorted(compare(np.eye(3), np.eye(3)))
    ['chamfer_sq', 'hausdorff_sq', 'spacing_cv']
    """
    return measured(Pair(prediction, target), (metric for metric in METRICS if metric.patches))


def compare_mesh(
    prediction: Tensor | ArrayLike, mesh: Mesh, *, closest: ClosestPoints = closest_points
) -> dict[str, Tensor]:
    """The metrics of a cloud against a mesh that one search for the closest points of its surface can give.

    Returns `p2f`, and where the cloud has normals `normal_deg`, `normal_unsigned_deg` and `flipped`, against the normal
    of the closest face. Where several faces share the closest point (a point outside a sharp edge), the search chooses
    which of them counts: `closest` exchanges the search; `pnu.metrics.ray_casting.closest_points` is the one that
    public scripts use.

    >>> sorted(compare_mesh(np.eye(3), Mesh(np.eye(3), np.array([[0, 1, 2]]))))
    ['p2f']
    """
    wanted = (metric for metric in METRICS if {"mesh", "normals"} & set(metric.needs))
    return measured(Pair(prediction, mesh=mesh, closest=closest), wanted)
