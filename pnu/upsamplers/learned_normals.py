"""Normals of bare clouds as the surface model finds them, from those of plane fits."""

import numpy as np
from numpy.typing import NDArray

from pnu.cleaning import Character, is_noisy
from pnu.runtime.progress import Progress, silent
from pnu.upsamplers.context import Context
from pnu.upsamplers.inference import LoadedWeights, inferring
from pnu.upsamplers.surface_projection import SurfaceProjection, shows_noise

Floats = NDArray[np.float64]


def learned_normals(points: Floats, normals: Floats, progress: Progress = silent) -> Floats:
    """Unit normals at points (n, 3) of a cloud in the unit sphere, from rough ones (n, 3) whose sides agree: (n, 3).

    As `pnu upsample` has them where a cloud comes without: the shipped network sees each point's neighbors with their
    rough normals, then a few times with its own; in a noisy cloud also once its points lie nearer to the surface.
    """
    character: Character = "noisy" if is_noisy(points, normals) else "clean"
    network = LoadedWeights("surface").network(character=character, device="cpu")
    with inferring(network):
        upsampler, context = SurfaceProjection(network), Context(progress=progress)
        cloud = np.hstack([points, normals])
        cloud = upsampler.with_refined_normals(cloud, network.passes, context)
        found = (upsampler.smoothed if shows_noise(cloud) else upsampler.settled)(cloud, context)[:, 3:6]
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12))
