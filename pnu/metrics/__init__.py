"""Distances between upsampled clouds and the truth: plain functions, and torchmetrics classes over them.

The functions need no torchmetrics; the classes are imported on first use, since torchmetrics takes seconds to import.
"""

from typing import TYPE_CHECKING, Any

from pnu.metrics.declared import METRICS, Metric, Shown, compare, compare_mesh, measured, with_own
from pnu.metrics.functional import (
    NormalErrors,
    Pair,
    chamfer_sq,
    emd_exact,
    hausdorff,
    hausdorff_sq,
    mean_compute,
    mean_update,
    normal_error,
    point_to_mesh,
    spacing_cv,
    uniformity,
)

if TYPE_CHECKING:
    from pnu.metrics.classes import (
        ChamferDistance,
        CloudMetrics,
        EarthMoverDistance,
        HausdorffDistance,
        NormalError,
        PointToMesh,
        Spacing,
        Uniformity,
    )

__all__ = [
    "METRICS",
    "ChamferDistance",
    "CloudMetrics",
    "EarthMoverDistance",
    "HausdorffDistance",
    "Metric",
    "NormalError",
    "NormalErrors",
    "Pair",
    "PointToMesh",
    "Shown",
    "Spacing",
    "Uniformity",
    "chamfer_sq",
    "compare",
    "compare_mesh",
    "emd_exact",
    "hausdorff",
    "hausdorff_sq",
    "mean_compute",
    "mean_update",
    "measured",
    "normal_error",
    "point_to_mesh",
    "spacing_cv",
    "uniformity",
    "with_own",
]


def __getattr__(name: str) -> Any:
    """Import the torchmetrics classes on first use."""
    if name in __all__:
        from pnu.metrics import classes

        return getattr(classes, name)
    raise AttributeError(f"module 'pnu.metrics' has no attribute {name!r}")
