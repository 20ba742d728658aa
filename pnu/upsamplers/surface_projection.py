"""Upsampling by learned projection: seeds around the points are moved onto the surface that the points sample.

There are no patches, hence no borders; the cost grows with the output; any ratio is possible.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from pnu.fast.compiled_projector import compiled_projection, compiled_spheres
from pnu.geometry.cloud_statistics import FAINT
from pnu.geometry.even_spacing import repel, tangent_discs
from pnu.geometry.local_frames import feet
from pnu.geometry.neighbor_search import Search, knn, nearest
from pnu.geometry.noise_level import noise_level
from pnu.geometry.sampling import farthest_points_large
from pnu.geometry.spacing import spacing
from pnu.geometry.spatial_blocks import along_curve
from pnu.kernels.compilation import compile_in_background
from pnu.networks.surface import Surface
from pnu.runtime import threads
from pnu.runtime.progress import Progress, Step, silent
from pnu.runtime.workers import Begin, InProcess, Work, Workers
from pnu.upsamplers.context import Context
from pnu.upsamplers.density import groups_of_like_spacing, point_counts

EVEN = 0.3  # standard deviation over mean of the nearest distance; 0.52 at random
SMOOTH = 0.1  # noise in spacings from which on a cloud is smoothed first
KEPT = 2**19  # queries whose projections are kept in one file
BATCH = 512  # queries at once on a CPU,
BATCHES = 32  # of which its threads share so many
AROUND = 8  # points of which one at most is dropped,
DOUBTFUL = 16  # looked for among so many for each point to drop
ROOM = 0.7  # around a point that is kept, in spacings that evenly spread points would have
LONG = 10_000  # points made from which on a computation takes long enough to have kernels compiled beside it
SPACED = 6  # neighbors whose mean distance is the spacing at a point of the cloud,
COVERED = 0.5  # of which so much may lie between it and the nearest point made;
NEARER, APPROACHES = 0.9, 3  # that comes to this share of it, again where another lost its own
CLOSE = 12  # neighbors of the sphere that candidates are first moved to


class SurfaceProjection:
    """The procedure for a network that projects: seeds, spheres, a shortlist projected, even spacing, rejection.

    Nothing is random. How many seeds, and so on, says the network.
    """

    parallel = True
    follows = True

    def __init__(self, network: Surface) -> None:
        self.network = network

    @torch.no_grad()
    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6) with unit normals.

        The points of a cloud that is noisy beside their spacing are themselves projected first.
        """
        if count >= LONG and cloud.device.type == "cpu":
            compile_in_background()
        cloud = self.with_refined_normals(cloud, self.network.passes, context)
        if noise_in_spacings(cloud) > SMOOTH:
            smooth, _ = self.projected(cloud, cloud, context, "smoothing, the points are noisy")
            measured, cloud = cloud, smooth
        else:
            measured = cloud
        places = cloud[:, :3].cpu().numpy()
        counts = point_counts(places, count, context.density)
        if counts is None:
            return self.spread(cloud, cloud[:0] if not context.keep else measured, len(cloud), count, context)
        found = []
        for number, (rows, some) in enumerate(groups_of_like_spacing(places, counts, count)):
            others = np.setdiff1d(np.arange(len(cloud)), rows)
            kept = measured[rows] if context.keep else measured[:0]
            named = partial(_named, context.progress, f"density {number + 1}, ")
            part = replace(context, progress=named, parts=context.parts.within(f"density_{number + 1}"))
            found.append(self.spread(cloud[np.concatenate([rows, others])], kept, len(rows), some, part))
        return torch.cat(found)

    def spread(self, cloud: Tensor, kept: Tensor, first: int, count: int, context: Context) -> Tensor:
        """Evenly spread points (count, 6) where the first points of a cloud (n, 6) are the nearest of its points.

        Those that are `kept` (k, 6) come first, as they are but for their normals; others fill the places between.
        """
        network, in_process = self.network, InProcess(self.network)
        new = count - len(kept)
        if new <= 0:
            return self.with_normals(kept[:count], cloud, context)

        def named(name: str, compute: Callable[[Step], Tensor]) -> Tensor:
            """A part by the name of its stage, on the cloud's device."""
            stage = partial(context.progress, name)
            return context.parts.get(name, lambda: compute(stage)).to(cloud)

        each = max(1, round(network.seeds * new / first))
        candidates, some, more = (
            round(share * new) for share in (network.candidates, network.shortlist, 1 + network.reject)
        )
        query = named("seeds", lambda step: seeds_around(cloud, each, candidates, step, first=first))
        if network.projector.sphere:
            to_sphere = partial(spheres, batch_size=context.batch_size)
            query, _ = in_parts(to_sphere, query, cloud, workers=in_process, context=context, stage="spheres")
        query = named("shortlist", lambda step: thin_between(query, some, kept, step))
        query, error = self.projected(query, cloud, context, "projection")
        query = named("thinning", lambda step: thin_between(query, more, kept, step))
        if network.relaxation:
            query = named("even spacing", lambda step: even_out(query, network.relaxation, step, kept))
        for i in range(network.refinements):
            query, error = self.projected(query, cloud, context, f"refinement {i + 1}")
        query = query[reject_worst(query[:, :3], error, new)]
        if first == len(cloud):  # of a part others make what lies at its borders
            query = self.covering(query, kept, cloud, context)
        return torch.cat([self.with_normals(kept, cloud, context), query]) if len(kept) else query

    def covering(self, query: Tensor, kept: Tensor, cloud: Tensor, context: Context) -> Tensor:
        """Points (m, 6) of which one lies within half a spacing of each point of a cloud (n, 6).

        Where neither they nor those that are kept do, the nearest of them comes so near.
        """
        for number in range(1, APPROACHES + 1):
            rows, places = approached(query[:, :3], kept[:, :3], cloud[:, :3])
            if not len(rows):
                break
            moved = torch.cat([places, query[rows, 3:]], 1)
            query = query.clone()
            query[rows], _ = self.projected(moved, cloud, context, f"places without points, {number}")
        return query

    def projected(self, query: Tensor, cloud: Tensor, context: Context, stage: str) -> tuple[Tensor, Tensor]:
        """Queries (m, 6) on the surface of a cloud (n, 6), and the logarithm of their expected error (m,)."""
        project = partial(projections, batch_size=context.batch_size)
        return in_parts(
            project, query, cloud, workers=context.workers or InProcess(self.network), context=context, stage=stage
        )

    def with_refined_normals(self, cloud: Tensor, passes: int, context: Context) -> Tensor:
        """A cloud (n, 6) with the normals that the network finds at its points, so many times one after the other."""
        for number in range(1, passes + 1):
            cloud = self.with_normals(cloud, cloud, context, f"normals, pass {number}")
        return cloud

    def with_normals(
        self, kept: Tensor, cloud: Tensor, context: Context, stage: str = "normals of the points kept"
    ) -> Tensor:
        """Points (k, 6) with the normals that the network finds at their places."""
        there, _ = self.projected(kept, cloud, context, stage)
        return torch.cat([kept[:, :3], there[:, 3:]], 1)


def _named(progress: Progress, prefix: str, stage: str, done: int, total: int) -> None:
    progress(prefix + stage, done, total)


def in_parts(
    begin: Begin, query: Tensor, cloud: Tensor, *, workers: Workers, context: Context, stage: str
) -> tuple[Tensor, Tensor]:
    """query (m, 6) -> projected (m, 6) and logarithm of the expected error (m,)."""
    size = queries_at_once(cloud, context.batch_size) * (BATCHES if cloud.device.type == "cpu" else 1)
    order = along_curve(query[:, :3])
    query = query[order]

    def project(first: int) -> Tensor:
        parts = torch.split(query[first : first + KEPT], size)
        found = []
        for number, part in enumerate(workers.map(begin, cloud, parts), 1):
            found.append(part.to(cloud))
            context.progress(stage, min(first + number * size, len(query)), len(query))
        return torch.cat(found)

    context.progress(stage, 0, len(query))
    everything = torch.empty(len(query), 7, dtype=query.dtype, device=query.device)
    for first in range(0, len(query), KEPT):
        found = context.parts.get(f"{stage}, {first} of {len(query)}", partial(project, first))
        everything[order[first : first + KEPT]] = found.to(everything)
    context.progress(stage, len(query), len(query))
    return everything[:, :6], everything[:, 6]


def projections(network: Surface, cloud: Tensor, batch_size: int | None = None) -> Work:
    """Around a cloud (n, 6): queries (m, 6) -> projected and logarithm of the expected error, (m, 7)."""
    ranks = network.ranks(len(cloud))
    compiled = compiled_projection(network)

    def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
        if len(ranks) < idx.shape[1]:
            idx = idx[:, ranks]
        if compiled:
            return compiled(query, cloud, idx)
        projected, log_error, spacing = network.project(query[None], cloud[None], idx[None])
        return torch.cat([projected[0], (log_error[0] + spacing[0].log()).to(projected)[:, None]], 1)

    return by_neighbors(project, cloud.to(network.projector.out.weight.device), network.reach, batch_size)


def spheres(network: Surface, cloud: Tensor, batch_size: int | None = None) -> Work:
    """As `projections`, but to the sphere that fits the nearest points, without network and expected error."""
    like = network.projector.out.weight
    compiled = compiled_spheres(like)

    def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
        if compiled:
            return compiled(query, cloud, idx)
        near = cloud[idx]
        offsets = near[..., :3] - query[:, None, :3]
        step, normal = (x.to(query) for x in feet(*(x.to(like) for x in (offsets, near[..., 3:], query[:, 3:]))))
        return torch.cat([query[:, :3] + step, normal, torch.zeros_like(step[:, :1])], 1)

    return by_neighbors(project, cloud.to(like.device), CLOSE, batch_size)


def by_neighbors(
    project: Callable[[Tensor, Tensor, Tensor], Tensor], cloud: Tensor, k: int, batch_size: int | None
) -> Work:
    """project(queries (m, 6), cloud (n, 6), their k nearest points as idx (m, k)), for queries in batches.

    On the CPU each thread works on batches of its own, so the result does not depend on their number.
    """
    cloud = cloud[along_curve(cloud[:, :3])]
    search, size, on_cpu = Search(cloud[:, :3]), queries_at_once(cloud, batch_size), cloud.device.type == "cpu"

    def work(query: Tensor) -> Tensor:
        query = query.to(cloud)
        idx = search.knn(query[:, :3], min(k, len(cloud)), ordered=True).idx
        batches = [slice(start, start + size) for start in range(0, len(query), size)]

        def batch(part: slice) -> Tensor:
            return project(query[part], cloud, idx[part])

        return torch.cat(threads.map_on_threads(batch, batches) if on_cpu else [batch(part) for part in batches])

    return work


def queries_at_once(cloud: Tensor, batch_size: int | None) -> int:
    """Queries that go through the network together."""
    return batch_size or (BATCH if cloud.device.type == "cpu" else 2**16)


def noise_in_spacings(cloud: Tensor) -> float:
    """Noise of a cloud (n, 6) in units of the spacing of its points."""
    return noise_level(cloud[:, :3], cloud[:, 3:]) / spacing(cloud[:, :3].cpu().numpy())


def is_clean_and_even(cloud: Tensor) -> bool:
    """Whether the points of a cloud (n, 6) are evenly spread, as farthest points are, and show no noise."""
    nearest_sq = knn(cloud[None, :, :3], cloud[None, :, :3], 2).dist_sq[0, :, 1]
    apart = nearest_sq.sqrt()
    return bool(apart.std() < EVEN * apart.mean()) and noise_in_spacings(cloud) < FAINT


def seeds_around(cloud: Tensor, each: int, count: int, step: Step = silent, *, first: int | None = None) -> Tensor:
    """Points of a cloud (n, 6) and `each` seeds around each, thinned to (count, 6), with the points' normals.

    With `first` those around the first points alone, and only where no other point is nearer.
    """
    step(0, 1)
    first = len(cloud) if first is None else first
    discs = tangent_discs(cloud[:, :3], cloud[:, 3:], each, first=first)
    places = torch.cat([cloud[:first, :3], discs.flatten(0, 1)])
    owner = torch.cat([torch.arange(first), torch.arange(first).repeat_interleave(each)]).to(cloud.device)
    del discs
    if first < len(cloud):
        own = nearest(places[None], cloud[None, :, :3]).idx[0] < first
        places, owner = places[own], owner[own]
    if len(places) <= count:
        kept = torch.arange(len(places), device=cloud.device)
        step(1, 1)
    else:
        kept = torch.from_numpy(farthest_points_large(places, count, step=step)).to(cloud.device)
    return torch.cat([places[kept], cloud[owner[kept], 3:]], 1)


def reject_worst(points: Tensor, error: Tensor, count: int) -> Tensor:
    """Indices (count,), ascending, of the points (m, 3) that stay when those of the highest error (m,) are dropped.

    Of neighbors only the worst goes, as long as there are others to drop: a bad point without its surroundings would
    be a hole.
    """
    surplus = len(points) - count
    doubtful = error.argsort(descending=True, stable=True)[: DOUBTFUL * surplus]
    around = knn(points[None, doubtful], points[None], min(AROUND, len(points))).idx[0]
    worst = error[doubtful] >= error[around].amax(1)
    stays = torch.ones_like(error, dtype=torch.bool)
    stays[torch.cat([doubtful[worst], doubtful[~worst]])[:surplus]] = False
    return stays.nonzero()[:, 0]


def approached(cloud: Tensor, kept: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (k,) of a cloud (m, 3) to be moved, and where to (k, 3), for points (n, 3) that have none of it near.

    Near is half of the spacing of the points; none of those that are kept (l, 3) lies there either. Each row moves
    once, for the barest point.
    """
    around = knn(points[None], points[None], min(SPACED + 1, len(points))).dist_sq[0, :, 1:]
    reach = COVERED * around.sqrt().mean(1)
    found = nearest(points[None], torch.cat([cloud, kept])[None])
    apart, row = found.dist_sq[0].sqrt(), found.idx[0]
    share = apart / reach.clamp_min(1e-300)
    bare = share.argsort(descending=True, stable=True)[: int((share > 1).sum())]
    bare = bare[row[bare] < len(cloud)]  # what is kept does not move
    _, barest = np.unique(row[bare].cpu().numpy(), return_index=True)
    bare = bare[torch.from_numpy(np.sort(barest)).to(bare.device)]
    to_point = points[bare] - cloud[row[bare]]
    step = (apart[bare] - NEARER * reach[bare]) / apart[bare].clamp_min(1e-300)
    return row[bare], cloud[row[bare]] + step[:, None] * to_point


def even_out(cloud: Tensor, steps: int, step: Step = silent, kept: Tensor | None = None) -> Tensor:
    """A cloud (m, 6) with points moved to an even spacing, between points (k, 6) that stay where they are."""
    everything = cloud if kept is None else torch.cat([cloud, kept])
    moved = repel(everything[:, :3], everything[:, 3:], steps=steps, step=step, movable=len(cloud))
    return torch.cat([moved[: len(cloud)], cloud[:, 3:]], 1)


def thin_between(cloud: Tensor, count: int, kept: Tensor, step: Step = silent) -> Tensor:
    """Farthest points of a cloud (n, 6) that leave room around those kept (k, 6): (min(n, count), 6)."""
    if len(kept) and len(cloud) > count:
        even = spacing(kept[:, :3].cpu().numpy()) * (len(kept) / (len(kept) + count)) ** 0.5
        apart = nearest(cloud[None, :, :3], kept[None, :, :3]).dist_sq[0].sqrt()
        enough = apart.sort(descending=True).values[count - 1]  # so many have to stay
        cloud = cloud[apart >= torch.minimum(enough, apart.new_tensor(ROOM * even))]
    return thin(cloud, count, step)


def thin(cloud: Tensor, count: int, step: Step = silent) -> Tensor:
    """Farthest points of a cloud (n, 6): (min(n, count), 6)."""
    if len(cloud) <= count:
        return cloud
    return cloud[torch.from_numpy(farthest_points_large(cloud[:, :3], count, step=step)).to(cloud.device)]
