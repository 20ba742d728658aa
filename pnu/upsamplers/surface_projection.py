"""Upsampling by learned projection: seeds around the points are moved onto the surface that the points sample.

There are no patches, hence no borders; the cost grows with the output; any ratio is possible.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from pnu.geometry.even_spacing import repel, tangent_discs
from pnu.geometry.local_frames import feet
from pnu.geometry.neighbor_search import Search, knn
from pnu.geometry.noise_level import noise_level
from pnu.geometry.sampling import farthest_points_large
from pnu.geometry.spacing import spacing
from pnu.geometry.spatial_blocks import along_curve
from pnu.networks.surface import Surface
from pnu.runtime import threads
from pnu.runtime.progress import Step, silent
from pnu.runtime.workers import Begin, InProcess, Work, Workers
from pnu.upsamplers.context import Context

SMOOTH = 0.1  # noise in spacings from which on a cloud is smoothed first
KEPT = 2**19  # queries whose projections are kept in one file
BATCH = 512  # queries at once on a CPU,
BATCHES = 32  # of which its threads share so many
AROUND = 8  # points of which one at most is dropped,
DOUBTFUL = 16  # looked for among so many for each point to drop
CLOSE = 12  # neighbors of the sphere that candidates are first moved to


class SurfaceProjection:
    """The procedure for a network that projects: seeds, spheres, a shortlist projected, even spacing, rejection.

    Nothing is random. How many seeds, and so on, says the network.
    """

    parallel = True

    def __init__(self, network: Surface) -> None:
        self.network = network

    @torch.no_grad()
    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6) with unit normals.

        The points of a cloud that is noisy beside their spacing are themselves projected first.
        """
        network, parts, in_process = self.network, context.parts, InProcess(self.network)
        project = partial(projections, batch_size=context.batch_size)
        run = partial(in_parts, project, workers=context.workers or in_process, context=context)

        def step(stage: str) -> Step:
            return partial(context.progress, stage)

        if noise_in_spacings(cloud) > SMOOTH:
            cloud, _ = run(cloud, cloud, stage="smoothing, the points are noisy")
        each = max(1, round(network.seeds * count / len(cloud)))
        candidates, some = round(network.candidates * count), round(network.shortlist * count)
        more = round((1 + network.reject) * count)
        query = parts.get("seeds", lambda: seeds_around(cloud, each, candidates, step("seeds"))).to(cloud)
        if network.projector.sphere:
            to_sphere = partial(spheres, batch_size=context.batch_size)
            query, _ = in_parts(to_sphere, query, cloud, workers=in_process, context=context, stage="spheres")
        query = parts.get("shortlist", lambda: thin(query, some, step("shortlist"))).to(cloud)
        query, error = run(query, cloud, stage="projection")
        query = parts.get("thinned", lambda: thin(query, more, step("thinning"))).to(cloud)
        if network.relaxation:
            query = parts.get("even", lambda: even_out(query, network.relaxation, step("even spacing"))).to(cloud)
        for i in range(network.refinements):
            query, error = run(query, cloud, stage=f"refinement {i + 1}")
        return query[reject_worst(query[:, :3], error, count)]


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

    def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
        projected, log_error, spacing = network.project(query[None], cloud[None], idx[None, :, ranks])
        return torch.cat([projected[0], (log_error[0] + spacing[0].log()).to(projected)[:, None]], 1)

    return by_neighbors(project, cloud.to(network.projector.out.weight.device), network.reach, batch_size)


def spheres(network: Surface, cloud: Tensor, batch_size: int | None = None) -> Work:
    """As `projections`, but to the sphere that fits the nearest points, without network and expected error."""
    like = network.projector.out.weight

    def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
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
        idx = search.knn(query[:, :3], min(k, len(cloud))).idx
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


def seeds_around(cloud: Tensor, each: int, count: int, step: Step = silent) -> Tensor:
    """Points of a cloud (n, 6) and `each` seeds around each, thinned to (count, 6), with the points' normals."""
    step(0, 1)
    discs = tangent_discs(cloud[:, :3], cloud[:, 3:], each)
    places = torch.cat([cloud[:, :3], discs.flatten(0, 1)])
    del discs
    if len(places) <= count:
        kept = torch.arange(len(places), device=cloud.device)
        step(1, 1)
    else:
        kept = torch.from_numpy(farthest_points_large(places, count, step=step)).to(cloud.device)
    owner = torch.where(kept < len(cloud), kept, (kept - len(cloud)) // each)
    return torch.cat([places[kept], cloud[owner, 3:]], 1)


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


def even_out(cloud: Tensor, steps: int, step: Step = silent) -> Tensor:
    """A cloud (m, 6) with points moved to an even spacing."""
    return torch.cat([repel(cloud[:, :3], cloud[:, 3:], steps=steps, step=step), cloud[:, 3:]], 1)


def thin(cloud: Tensor, count: int, step: Step = silent) -> Tensor:
    """Farthest points of a cloud (n, 6): (min(n, count), 6)."""
    if len(cloud) <= count:
        return cloud
    return cloud[torch.from_numpy(farthest_points_large(cloud[:, :3], count, step=step)).to(cloud.device)]
