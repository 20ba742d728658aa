"""torchmetrics classes over `pnu.metrics.functional`: each is the mean over clouds of one value a cloud.

Their state is a sum and a count, both added over processes, so that the result is that of all clouds together: whatever
the number of processes, and when the last batch is smaller. Without any update they give NaN.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from pnu.extras import needed
from pnu.io import Mesh
from pnu.metrics import declared, functional
from pnu.metrics.functional import mean_compute, mean_update

with needed("measuring"):
    from torchmetrics import Metric


class CloudMean(Metric):
    """Mean over clouds of one value a cloud; subclasses say which in `update`."""

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self, *, size: tuple[int, ...] = (), **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("total", torch.zeros(size), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(()), dist_reduce_fx="sum")

    def _add(self, values: Tensor) -> None:
        """values (B,) or (B, size), or one value of a single cloud."""
        total, count = mean_update(values.reshape(-1, *self.total.shape).to(self.total))
        self.total += total
        self.count += count

    def compute(self) -> Any:
        """The mean over all clouds, NaN without any."""
        return mean_compute(self.total, self.count)


class ChamferDistance(CloudMean):
    """Chamfer distance with squared distances, see `functional.chamfer_sq`.

    Update: prediction (B, n, 3 or more), target (B, m, 3 or more).
    Compute: 0-d tensor, mean over clouds; unit: length squared.

    Example:
        >>> metric = ChamferDistance()
        >>> metric.update(torch.tensor([[[0.0, 0, 0], [1, 0, 0]]]), torch.zeros(1, 1, 3))
        >>> metric.compute()
        tensor(0.5000)
    """

    def update(self, prediction: Tensor, target: Tensor) -> None:
        self._add(functional.chamfer_sq(prediction, target))


class HausdorffDistance(CloudMean):
    """Hausdorff distance, see `functional.hausdorff_sq`.

    Args: squared: True for the squared distance (as in the tables), False for the plain one.
    Update: prediction (B, n, 3 or more), target (B, m, 3 or more).
    Compute: 0-d tensor, mean over clouds; unit: length, squared if `squared`.

    Example:
        >>> metric = HausdorffDistance(squared=False)
        >>> metric.update(torch.tensor([[[0.0, 0, 0], [2, 0, 0]]]), torch.zeros(1, 1, 3))
        >>> metric.compute()
        tensor(2.)
    """

    def __init__(self, squared: bool = True, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not isinstance(squared, bool):
            raise ValueError(f"squared: expected True or False, found {squared!r}")
        self.squared = squared

    def update(self, prediction: Tensor, target: Tensor) -> None:
        distance: Callable[..., Tensor] = functional.hausdorff_sq if self.squared else functional.hausdorff
        self._add(distance(prediction, target))


class NormalError(CloudMean):
    """Error of the predicted normals, see `functional.normal_error`.

    Args: kind: "unsigned" (0..90 degrees), "signed" (0..180 degrees) or "flipped" (share, 0..1).
    Update: prediction (B, n, 6), truth (B, m, 6) or one mesh a cloud.
    Compute: 0-d tensor, mean over clouds.

    Example:
        >>> metric = NormalError("signed")
        >>> metric.update(torch.tensor([[[0.0, 0, 0, 0, 0, -1]]]), torch.tensor([[[0.0, 0, 0, 0, 0, 1]]]))
        >>> metric.compute()
        tensor(180.)
    """

    KINDS = ("signed", "unsigned", "flipped")

    def __init__(self, kind: str = "unsigned", **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if kind not in self.KINDS:
            raise ValueError(f"kind: expected one of {', '.join(self.KINDS)}, found {kind!r}")
        self.kind = kind

    def update(self, prediction: Tensor, truth: Tensor | Sequence[Mesh]) -> None:
        place = self.KINDS.index(self.kind)
        if isinstance(truth, Tensor):
            self._add(functional.normal_error(prediction, truth)[place])
            return
        for cloud, mesh in zip(prediction, truth, strict=True):
            self._add(functional.normal_error(cloud, mesh)[place])


class PointToMesh(CloudMean):
    """P2F: mean distance of the points to the true mesh, see `functional.point_to_mesh`.

    Update: prediction (B, n, 3 or more), one mesh a cloud.
    Compute: 0-d tensor, mean over clouds; unit: length.

    Example:
        >>> import numpy as np
        >>> triangle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
        >>> metric = PointToMesh()
        >>> metric.update(torch.tensor([[[0.25, 0.25, 0.5]]]), [triangle])
        >>> metric.compute()
        tensor(0.5000)
    """

    def update(self, prediction: Tensor, meshes: Sequence[Mesh]) -> None:
        for cloud, mesh in zip(prediction, meshes, strict=True):
            self._add(functional.point_to_mesh(cloud, mesh))


class Spacing(CloudMean):
    """Evenness of the spacing of the points, see `functional.spacing_cv`.

    Update: prediction (B, n, 3 or more).
    Compute: 0-d tensor, mean over clouds; no unit, 0 is even.

    Example:
        >>> metric = Spacing()
        >>> metric.update(torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]]))
        >>> metric.compute()
        tensor(0.)
    """

    def update(self, prediction: Tensor) -> None:
        self._add(functional.spacing_cv(prediction))


class Uniformity(CloudMean):
    """Evenness of the density, PU-Net's coefficient, see `functional.uniformity`.

    Args: share: share of the surface in a disk, between 0 and 1.
    Update: prediction (B, n, 3 or more), target (B, m, 3 or more), a dense uniform sampling of the truth.
    Compute: 0-d tensor, mean over clouds; no unit, 0 is even.

    Example:
        >>> line = torch.stack([torch.arange(100.0), torch.zeros(100), torch.zeros(100)], dim=1)[None]
        >>> metric = Uniformity(share=0.1)
        >>> metric.update(line, line)
        >>> metric.compute()
        tensor(0.)
    """

    def __init__(self, share: float = 0.01, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not 0 < share < 1:
            raise ValueError(f"share: expected a share of the surface between 0 and 1, found {share}")
        self.share = share

    def update(self, prediction: Tensor, target: Tensor) -> None:
        self._add(functional.uniformity(prediction, target, share=self.share))


class EarthMoverDistance(CloudMean):
    """Exact earth mover's distance, see `functional.emd_exact`: at most 4096 points, equal sizes.

    Update: prediction (B, n, 3 or more), target (B, n, 3 or more).
    Compute: 0-d tensor, mean over clouds; unit: length.

    Example:
        >>> metric = EarthMoverDistance()
        >>> metric.update(torch.tensor([[[0.0, 0, 0], [1, 0, 0]]]), torch.tensor([[[1.0, 0, 0], [0, 0, 3]]]))
        >>> metric.compute()
        tensor(1.5000)
    """

    def update(self, prediction: Tensor, target: Tensor) -> None:
        self._add(functional.emd_exact(prediction, target))


class CloudMetrics(CloudMean):
    """All metrics of two clouds from one search, see `pnu.metrics.declared`: what training logs.

    Args:
        normals: whether prediction and target have normals whose error is wanted.
        metrics: those to choose from; what is for whole clouds, or needs a mesh, is left out.

    Update: prediction (B, n, 6), target (B, m, 6); 3 columns will do without `normals`.
    Compute: dict of 0-d tensors, means over clouds, by name.

    Example:
        >>> metric = CloudMetrics(normals=False)
        >>> metric.update(torch.tensor([[[0.0, 0, 0], [1, 0, 0]]]), torch.zeros(1, 1, 3))
        >>> metric.compute()
        {'chamfer_sq': tensor(0.5000), 'hausdorff_sq': tensor(1.), 'spacing_cv': tensor(0.)}
    """

    def __init__(
        self, normals: bool = True, metrics: Sequence[declared.Metric] = declared.METRICS, **kwargs: Any
    ) -> None:
        if not isinstance(normals, bool):
            raise ValueError(f"normals: expected True or False, found {normals!r}")
        has = {"target", "normals"} if normals else {"target"}
        chosen = [one for one in metrics if one.patches and has.issuperset(one.needs)]
        super().__init__(size=(len(chosen),), **kwargs)
        self.metrics, self.names = chosen, tuple(one.shown.name for one in chosen)

    def update(self, prediction: Tensor, target: Tensor) -> None:
        values = declared.measured(functional.Pair(prediction, target), self.metrics)
        if len(values) < len(self.names):
            raise ValueError(
                f"prediction, target: expected 6 columns for the normals' error, found {prediction.shape[-1]}"
                f" and {target.shape[-1]}; CloudMetrics(normals=False) leaves it out"
            )
        self._add(torch.stack([values[name] for name in self.names], dim=-1))

    def compute(self) -> dict[str, Tensor]:
        """Means over all clouds by name, NaN without any."""
        return dict(zip(self.names, mean_compute(self.total, self.count), strict=True))
