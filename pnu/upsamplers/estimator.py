"""`pnu.upsample` as an object, for many clouds: its settings are given once, and its weights are read once."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, Self, overload

import numpy as np

from pnu.cleaning import Treatment
from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.context import Merge, Upsampler
from pnu.upsamplers.density import Density
from pnu.upsamplers.inference import LoadedWeights
from pnu.upsamplers.whole_clouds import CloudT, Model, upsample

if TYPE_CHECKING:
    from torch import Tensor, nn


class PointCloudUpsampler:
    """Densifies one cloud after the other, in the manner of scikit-learn: `fit` loads weights, `transform` uses them.

    Nothing is learned from clouds; networks are trained by `pnu train`.

    Args:
        ratio: as all others, what `pnu.upsample` says.

    Raises:
        ValueError: by `fit`, the model is not there; by `transform`, what `pnu.upsample` raises.

    Example:
        >>> import numpy as np
        >>> import pnu
        >>> upsampler = pnu.PointCloudUpsampler(ratio=2).fit()
        >>> clouds = np.random.default_rng(0).normal(size=(2, 100, 3))
        >>> clouds /= np.linalg.norm(clouds, axis=2, keepdims=True)
        >>> [upsampler.transform(cloud).shape for cloud in clouds]
        [(200, 6), (200, 6)]
    """

    def __init__(
        self,
        *,
        ratio: float = 4,
        spacing: float | None = None,
        model: nn.Module | Upsampler | str | PathLike[str] = "surface",
        patch_size: int | None = None,
        merge: Merge = "farthest",
        density: Density = "auto",
        keep: bool | Literal["auto"] = "auto",
        outliers: Treatment = "auto",
        lines: Treatment = "auto",
        noise: Treatment = "auto",
        signs: Treatment = "auto",
        holes: float | None = None,
        device: str = "auto",
        devices: int = 1,
        batch_size: int | None = None,
        seed: int = 0,
        progress: Progress = silent,
    ) -> None:
        self.ratio, self.spacing, self.model, self.patch_size = ratio, spacing, model, patch_size
        self.merge, self.density, self.keep, self.holes = merge, density, keep, holes
        self.outliers, self.lines, self.noise, self.signs = outliers, lines, noise, signs
        self.device, self.devices, self.batch_size = device, devices, batch_size
        self.seed, self.progress = seed, progress

    def fit(self, points: object = None, normals: object = None) -> Self:
        """Load the weights of `model`; both arguments are there for pipelines, and not looked at."""
        self.loaded_: Model = self.model
        if isinstance(self.model, str | PathLike):
            self.loaded_ = weights = LoadedWeights(self.model)
            weights.network(np.empty((0, 3)), device=self.device)
        return self

    @overload
    def transform(self, points: CloudT, normals: np.ndarray | Tensor | None = None) -> CloudT: ...
    @overload
    def transform(
        self, points: np.ndarray | Sequence[Sequence[float]], normals: np.ndarray | Tensor | None = None
    ) -> np.ndarray: ...
    def transform(self, points: Any, normals: np.ndarray | Tensor | None = None) -> Any:
        """The denser cloud, of the kind of the given one; see `pnu.upsample`."""
        if not hasattr(self, "loaded_"):
            self.fit()
        return upsample(points, normals, **self.get_params() | {"model": self.loaded_})

    @overload
    def fit_transform(self, points: CloudT, normals: np.ndarray | Tensor | None = None) -> CloudT: ...
    @overload
    def fit_transform(
        self, points: np.ndarray | Sequence[Sequence[float]], normals: np.ndarray | Tensor | None = None
    ) -> np.ndarray: ...
    def fit_transform(self, points: Any, normals: np.ndarray | Tensor | None = None) -> Any:
        """`fit`, then `transform`."""
        return self.fit().transform(points, normals)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The settings by name."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    def set_params(self, **settings: Any) -> Self:
        """Change settings; another `model` is loaded when it is next used.

        Raises:
            ValueError: there is no such setting.
        """
        for name, value in settings.items():
            if name not in (known := self.get_params()):
                raise ValueError(f"{name}: expected one of {', '.join(known)}")
            setattr(self, name, value)
        if "model" in settings and hasattr(self, "loaded_"):
            del self.loaded_
        return self

    def __repr__(self) -> str:
        defaults = inspect.signature(type(self)).parameters
        changed = (f"{k}={v!r}" for k, v in self.get_params().items() if v is not defaults[k].default)
        return f"{type(self).__name__}({', '.join(changed)})"
