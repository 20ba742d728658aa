"""Points where the predictions of overlapping patches agree that the surface is."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu import kernels
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import local_spacing
from pnu.networks.compiled_surface import compiled_feet
from pnu.runtime.threads import thread_count
from pnu.runtime.workers import InProcess, Work
from pnu.upsamplers.context import Context
from pnu.upsamplers.coverage import covering
from pnu.upsamplers.surface_projection import (
    by_neighbors,
    even_out,
    in_parts,
    queries_at_once,
    reject_worst,
    thin_between,
)

NEIGHBORS = 144  # predictions that a sphere fits: where four patches overlap, those of nine points of the cloud
ROUNDS = 2  # times that the points chosen first move to spheres
SURPLUS = 1.1  # points chosen of those wanted: the farthest ones lie off the surface, and close together once on it
RELAXATION = 2  # times that points spread, and move to spheres once more
REJECTED = 0.01  # share of those wanted that is made too many: of them the farthest go from the spheres that
MEASURED = 24  # points of the cloud fit
Floats = NDArray[np.float64]


def most_agreed(predicted: Floats, cloud: Floats, kept: Floats, count: int, context: Context, stage: str) -> Floats:
    """Points and unit normals (count, 6) where predictions (m, 6) of a cloud (n, 6) agree, both with unit normals.

    Farthest points of the predictions move to algebraic spheres through the predictions around them, are thinned out,
    and spread evenly on what these say; so errors across the surface, which differ from patch to patch, cancel. A few
    go that lie farthest off what the points of the cloud say. Where none comes to lie near a point of the cloud, the
    nearest does. Points kept (k, 6) leave the places around them free.
    """
    more = min(max(count, round(SURPLUS * count)), len(predicted))
    fit = InProcess(None)  # one for all, so that their tree is made once

    def moved(points: Floats, stage: str) -> Floats:
        return in_parts(agreeing_spheres, points, predicted, workers=fit, context=context, stage=stage)[0]

    chosen = thin_between(predicted, more, kept, partial(context.progress, stage))
    for number in range(1, ROUNDS + 1):
        chosen = moved(chosen, f"agreement {number}")
    chosen = thin_between(chosen, round((1 + REJECTED) * count), kept)
    for number in range(1, RELAXATION + 1):
        chosen = moved(even_out(chosen, 1, kept=kept), f"even spacing {number}")
    if len(chosen) > count:
        chosen = chosen[reject_worst(chosen[:, :3], off_spheres(chosen, cloud, context), count)]
    return covering(chosen, kept, cloud, lambda points, number: moved(points, f"places without points, {number}"))


def off_spheres(points: Floats, cloud: Floats, context: Context) -> Floats:
    """How far points (m, 6) lie from the spheres that the points of a cloud (n, 6) fit, in its spacings: (m,)."""
    begin = partial(agreeing_spheres, neighbors=MEASURED)
    feet = in_parts(begin, points, cloud, workers=InProcess(None), context=context, stage="distances from the cloud")[0]
    near = PointTree(cloud[:, :3]).nearest(points[:, :3], 1, threads=thread_count())[1][:, 0]
    apart = np.linalg.norm(feet[:, :3] - points[:, :3], axis=1)
    return np.asarray(apart / np.maximum(local_spacing(cloud)[near], 1e-300))


def agreeing_spheres(network: Any, predicted: Floats, neighbors: int = NEIGHBORS) -> Work:
    """Among predictions (m, 6): points with normals (n, 6) -> on the spheres that fit the nearest, and 0, (n, 7)."""
    if kernels.ready():
        return by_neighbors(compiled_feet, predicted, neighbors, None)
    import torch

    from pnu.upsamplers.network_projection import sphere_projections

    like = torch.empty(0, dtype=torch.float64)
    return sphere_projections(like, predicted, neighbors, partial(queries_at_once, batch_size=None))
