"""Whether the normals that come with a cloud are worse than those that the surface model finds.

Such normals are often planes fitted to each point's neighbors, which round off edges and follow noise, or those of
single measurements. The network for bare clouds, shown the points with these normals, finds its own. Plane fits with
some number of neighbors are then nearer to those given than the network's are. True normals lie nearer to the
network's than to any plane fits. Rough ones are farther from plane fits than the network's, true ones about as far.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.fitted_planes import FittedPlanes
from pnu.geometry.point_tree import PointTree
from pnu.geometry.unit_sphere import unit_sphere_frame
from pnu.runtime.threads import thread_count
from pnu.upsamplers.context import Context
from pnu.upsamplers.inference import LoadedWeights, inferring
from pnu.upsamplers.surface_projection import SurfaceProjection

SOME = 400  # points that are looked at
FITS = (6, 8, 10, 12, 16, 20, 24, 32, 48)  # neighbors of plane fits, the point among them
FEWEST = 64  # points of a cloud that can be judged
NEARER = 1.1  # normals of plane fits lie no farther from these, times what they lie from the network's
ROUGHER = 1.75  # rough ones lie so many times as far from them as the network's, a quarter of all places left out,
AT_LEAST = 8.0  # and so many degrees from the network's at most places
EXACT, FLAT = 0.3, 0.5  # degrees that count as none: angles on flat places are tiny
Floats = NDArray[np.float64]


def poor_axes(points: Floats, normals: Floats) -> str:
    """Why the axes of unit normals (n, 3) at points (n, 3) are better found anew, in words; empty: they are good.

    Their sides agree; NaN where there is none.
    """
    known = np.isfinite(normals).all(1)
    if known.sum() < FEWEST:
        return ""
    order = np.lexsort(points[known].T)
    xyz, given = points[known][order], normals[known][order]
    some = np.unique(np.linspace(0, len(xyz) - 1, SOME).round().astype(np.int64))
    network = _judge()
    near = PointTree(xyz).nearest(xyz[some], max(*FITS, network.reach), threads=thread_count())[1]
    around, rows = np.unique(near, return_inverse=True)
    cloud = np.hstack([unit_sphere_frame(xyz[around]).to_unit(xyz[around]), given[around]])
    near, here = rows.reshape(near.shape), np.searchsorted(around, some)
    with inferring(network):
        found = SurfaceProjection(network).with_normals(cloud[here], cloud, Context())[:, 3:]
    given = cloud[here, 3:]
    planes = [FittedPlanes.of(cloud[near[:, :k], :3]).axes[:, :, 0] for k in FITS]
    apart = _degrees(given, found)
    if min(_degrees(given, fit).mean() for fit in planes) + EXACT < NEARER * apart.mean():
        return "no better than planes fitted to neighbors"
    rough, smooth = (min(np.quantile(_degrees(axes, fit), 0.25) for fit in planes) + FLAT for axes in (given, found))
    return "rough" if rough > ROUGHER * smooth and np.median(apart) > AT_LEAST else ""


@cache
def _judge() -> Any:
    """The network for clouds without normals, read once."""
    return LoadedWeights("surface").network(device="cpu")


def _degrees(one: Floats, other: Floats) -> Floats:
    """Angles between axes (n, 3), (n,)."""
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    cosine = np.abs((one * other).sum(1)) / np.maximum(lengths, 1e-12)
    angles: Floats = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    return angles
