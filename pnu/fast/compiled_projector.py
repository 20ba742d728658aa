"""The surface model's step for whole batches by compiled kernels, where they can stand for a network of torch."""

import torch
from torch import Tensor

from pnu import kernels
from pnu.networks.compiled_surface import Project, compiled_feet, compiled_step, is_known
from pnu.networks.surface import Projector, Surface


def compiled_projection(network: Surface) -> Project | None:
    """`Surface.project` of one cloud without gradient; None where kernels are not ready or know another network.

    They know `Projector` as it is in float32 on the CPU, of any width, with and without sphere and attention.
    """
    projector = network.projector
    known = type(network).project is Surface.project and type(projector) is Projector
    if not (known and _compiled(projector.out.weight) and is_known(projector.state_dict())):
        return None
    parameters = {name: value.numpy() for name, value in projector.state_dict().items()}
    return compiled_step(parameters, sphere=projector.sphere, attention=projector.attend)


def compiled_spheres(like: Tensor) -> Project | None:
    """Steps to the sphere that fits the neighbors, where those of a tensor's type and place are compiled."""
    return compiled_feet if _compiled(like) else None


def _compiled(like: Tensor) -> bool:
    return like.device.type == "cpu" and like.dtype == torch.float32 and kernels.ready()
