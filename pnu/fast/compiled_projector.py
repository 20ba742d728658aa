"""The surface model's step for whole batches by compiled kernels, where they can stand for it."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from pnu import kernels
from pnu.networks.surface import Projector, Surface

Project = Callable[[Tensor, Tensor, Tensor], Tensor]
"""project(queries (m, 6), cloud (n, 6), their neighbors idx (m, k)) -> (m, 7): points, unit normals, logarithm of the
expected error; the first two in float64."""

LAYERS = ("first", "second", "context", "third", "head.0", "head.2", "out")
PARAMETERS = {f"{layer}.{part}" for layer in LAYERS for part in ("weight", "bias")} | {"attention.weight"}


def compiled_projection(network: Surface) -> Project | None:
    """`Surface.project` of one cloud without gradient; None where kernels are not ready or know another network.

    They know `Projector` as it is in float32 on the CPU, of any width, with and without sphere and attention.
    """
    projector = network.projector
    known = type(network).project is Surface.project and type(projector) is Projector
    if not (known and _compiled(projector.out.weight) and set(projector.state_dict()) == PARAMETERS):
        return None
    from pnu.kernels.projector import packed, project_queries

    parameters = {name: value.numpy() for name, value in projector.state_dict().items()}
    weights = packed(parameters, attention=projector.attend)

    def work(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
        result = np.empty((len(query), 7))
        project_queries(*_arrays(query, cloud, idx), projector.sphere, *weights, result)
        return torch.from_numpy(result).to(query.dtype)

    return work


def compiled_spheres(like: Tensor) -> Project | None:
    """Steps to the sphere that fits the neighbors (`local_frames.feet`) in the type of a tensor, and zeros."""
    if not _compiled(like):
        return None
    from pnu.kernels.frames import project_to_spheres

    def work(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
        result = np.zeros((len(query), 7))
        project_to_spheres(*_arrays(query, cloud, idx), result[:, :6])
        return torch.from_numpy(result).to(query.dtype)

    return work


def _compiled(like: Tensor) -> bool:
    return like.device.type == "cpu" and like.dtype == torch.float32 and kernels.ready()


def _arrays(query: Tensor, cloud: Tensor, idx: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return query.double().contiguous().numpy(), cloud.double().contiguous().numpy(), idx.contiguous().numpy()
