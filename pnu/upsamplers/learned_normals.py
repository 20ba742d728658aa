"""Normals of bare clouds as the surface model finds them, from those of plane fits."""

import numpy as np
from numpy.typing import NDArray

from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.context import Context
from pnu.upsamplers.inference import LoadedWeights, inferring
from pnu.upsamplers.surface_projection import SurfaceProjection

WEIGHTS = "surface_estimated"
PASSES = 2  # a third changes little
Floats = NDArray[np.float64]


def learned_normals(points: Floats, normals: Floats, progress: Progress = silent) -> Floats:
    """Unit normals at points (n, 3) of a cloud in the unit sphere, from rough ones (n, 3) whose sides agree: (n, 3).

    As `pnu upsample` has them where a cloud comes without: the shipped network sees each point's neighbors with their
    rough normals, then with its own.
    """
    network = LoadedWeights(WEIGHTS).network(device="cpu")
    with inferring(network):
        upsampler, cloud = SurfaceProjection(network), np.hstack([points, normals])
        found = upsampler.with_refined_normals(cloud, PASSES, Context(progress=progress))[:, 3:]
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12))
