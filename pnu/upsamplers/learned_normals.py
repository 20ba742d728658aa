"""Normals of bare clouds as the surface model finds them, from those of plane fits."""

from typing import Any

import torch
from torch import Tensor

from pnu.fast import accelerated
from pnu.networks import checkpoints
from pnu.runtime.parts import Parts
from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.context import Context
from pnu.upsamplers.surface_projection import SurfaceProjection

WEIGHTS = "surface_estimated"
PASSES = 2  # a third changes little


@torch.no_grad()
def learned_normals(points: Tensor, normals: Tensor, progress: Progress = silent) -> Tensor:
    """Unit normals at points (n, 3) of a cloud in the unit sphere, from rough ones (n, 3) whose sides agree: (n, 3).

    As `pnu upsample` has them where a cloud comes without: the shipped network sees each point's neighbors with their
    rough normals, then with its own.
    """
    network: Any = checkpoints.load(WEIGHTS)
    context = Context(torch.device("cpu"), None, torch.Generator(), progress, Parts())
    with accelerated(list(network.modules())):
        found = SurfaceProjection(network).with_refined_normals(torch.cat([points, normals], 1), PASSES, context)
    return torch.nn.functional.normalize(found[:, 3:].double(), dim=1)
