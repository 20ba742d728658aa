"""Upsampling by learned projection: seeds around the points are moved onto the surface that the points sample.

There are no patches, hence no borders; the cost grows with the output; any ratio is possible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pnu.geometry.cloud_statistics import FAINT
from pnu.geometry.even_spacing import repel, tangent_discs
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.noise_level import LOUDER, is_louder_in_places, local_noise, noise_level
from pnu.geometry.point_tree import PointTree
from pnu.geometry.spacing import spacing
from pnu.geometry.spatial_blocks import along_curve
from pnu.kernels.compilation import compile_in_background
from pnu.networks.compiled_surface import CompiledSurface, Project, compiled_feet
from pnu.runtime import threads
from pnu.runtime.progress import Progress, Step, silent
from pnu.runtime.workers import Begin, InProcess, Work, Workers
from pnu.upsamplers.context import Context
from pnu.upsamplers.coverage import covering
from pnu.upsamplers.density import groups_of_like_spacing, point_counts

if TYPE_CHECKING:
    from torch import Tensor

    from pnu.networks.surface import Surface

Network: TypeAlias = "Surface | CompiledSurface"
Floats = NDArray[np.float64]
Index = NDArray[np.int64]
CloudT = TypeVar("CloudT", "Floats", "Tensor")

EVEN = 0.3  # standard deviation over mean of the nearest distance; 0.52 at random
STILL_EVEN = 0.4  # so much where points were smoothed
MOVED = 2.0  # smoothing moves points by so many times the noise at most, lest tips are drawn to the rest,
MOVED_ALONG = 3.0  # where it moves them along given normals
ROUNDS, ROUNDS_ALONG = 2, 8  # of smoothing
MORE = 2  # passes of normals where there is no noise
KEPT = 2**18  # queries whose projections are kept in one file
BATCH = 512  # queries at once on a CPU,
BATCHES = 32  # of which its threads share so many
AROUND = 8  # points of which one at most is dropped,
DOUBTFUL = 16  # looked for among so many for each point to drop
DISTANT, RISKY = 8.0, 1.5  # weight of the distance from an even cloud, in spacings, beside the error; limit of both
AT_REST = 0.015  # spacings that a point moves in a refinement after which it needs no other
ROOM = 0.7  # around a point that is kept, in spacings that evenly spread points would have
LONG = 10_000  # points made from which on a computation takes long enough to have kernels compiled beside it
MANY = 3, 2  # candidates and shortlist where points stay,
FEW = 2, 1.15  # where none do, or where the surface goes on beyond a part
CLOSE = 12  # neighbors of the sphere that candidates are first moved to


class SurfaceProjection:
    """The procedure for a network that projects: seeds, spheres, a shortlist projected, even spacing, rejection.

    Nothing is random. How many seeds, and so on, says the network. Clouds are arrays; what projects them is compiled
    kernels, without torch, or the network, wherever it lies.
    """

    parallel = True
    follows = keeps = True

    def __init__(self, network: Network) -> None:
        self.network = network

    def upsample_cloud(self, cloud: CloudT, count: int, context: Context) -> CloudT:
        """cloud (n, 6) -> (count, 6) with unit normals, an array or a tensor.

        The points of a cloud that is noisy beside their spacing are themselves projected first. Where they then lie
        evenly, new ones come between them, and they stay: so a place that was measured does not lie bare.
        """
        if not isinstance(cloud, np.ndarray):
            import torch

            found = self.upsample_cloud(cloud.detach().cpu().double().numpy(), count, context)
            return torch.from_numpy(found).to(cloud)
        if count >= LONG:
            compile_in_background()
        cloud = self.with_refined_normals(cloud, self.network.passes, context)
        measured = cloud[:, :6]
        staying = measured[:0]
        if context.smooth or shows_noise(cloud):
            cloud = self.smoothed(cloud, context)
            staying = cloud[:, :6] if count > len(cloud) and is_even(cloud, STILL_EVEN) else staying
        else:
            cloud = self.settled(cloud, context)
        places = cloud[:, :3]
        counts = point_counts(places, count, context.density)
        if counts is None:
            return self.spread(cloud, measured if context.keep else staying, len(cloud), count, context)
        found = []
        for number, (rows, some) in enumerate(groups_of_like_spacing(places, counts, count)):
            others = np.setdiff1d(np.arange(len(cloud)), rows)
            kept = measured[rows] if context.keep else measured[:0]
            named = partial(_named, context.progress, f"density {number + 1}, ")
            of_group = replace(context, progress=named, parts=context.parts.within(f"density_{number + 1}"))
            found.append(self.spread(cloud[np.concatenate([rows, others])], kept, len(rows), some, of_group, part=True))
        return np.concatenate(found)

    def spread(
        self, cloud: Floats, kept: Floats, first: int, count: int, context: Context, *, part: bool = False
    ) -> Floats:
        """Evenly spread points (count, 6) where the first of a cloud (n, 6 + messages) are the nearest of its points.

        Those that are `kept` (k, 6) come first, as they are but for their normals; others fill the places between.
        With `part` the cloud goes on at its borders, where others make points.
        """
        network, in_process = self.network, InProcess(self.network)
        new = count - len(kept)
        if new <= 0:
            return self.with_normals(kept[:count], cloud, context)

        def named(name: str, compute: Callable[[Step], Floats]) -> Floats:
            """A part by the name of its stage."""
            return context.parts.get(name, lambda: compute(partial(context.progress, name)))

        each = max(1, round(network.seeds * new / first))
        usual = MANY if len(kept) and not part else FEW
        shares = network.candidates or usual[0], network.shortlist or usual[1], 1 + network.reject
        candidates, some, more = (round(share * new) for share in shares)
        query = named("seeds", lambda step: seeds_around(cloud, each, candidates, step, first=first))
        if starts_on_spheres(network):
            to_sphere = partial(spheres, batch_size=context.batch_size)
            query = in_parts(to_sphere, query, cloud, workers=in_process, context=context, stage="spheres")[0]
        query = named("shortlist", lambda step: thin_between(query, some, kept, step))
        steps = [projections if left < network.fine else coarsely for left in range(network.refinements, -1, -1)]
        query, error = self.projected(query, cloud, context, "projection", steps[0])
        query = named("thinning", lambda step: thin_between(query, more, kept, step))
        if network.relaxation:
            query = named("even spacing", lambda step: even_out(query, network.relaxation, step, kept))
        query, error = self.refined(query, error, cloud, context, steps[1:])
        if len(kept) and not part and is_even(cloud):
            near = within_reach(query[:, :3], error, cloud[:, :3], new)
            query, error = query[near], error[near]
        query = query[reject_worst(query[:, :3], error, new)]
        if first == len(cloud):  # of a part others make what lies at its borders
            query = covering(query, kept, cloud, partial(self._nearer, cloud=cloud, context=context))
        return np.concatenate([self.with_normals(kept, cloud, context), query]) if len(kept) else query

    def refined(
        self, query: Floats, error: Floats, cloud: Floats, context: Context, steps: Sequence[Callable[..., Work]]
    ) -> tuple[Floats, Floats]:
        """Queries (m, 6) and their expected errors (m,) after each of the steps. Those that one leaves where they are
        have come to rest, and are not looked at again by the same network."""
        still, rows = AT_REST * spacing(cloud[:, :3]), np.arange(len(query))
        for i, step in enumerate(steps):
            if not len(rows):
                break
            some = query if len(rows) == len(query) else query[rows]
            found, errors = self.projected(some, cloud, context, f"refinement {i + 1}", step)
            found = slid(some, found, self.network.slide)
            moved = np.linalg.norm(found[:, :3] - some[:, :3], axis=1)
            if some is query:
                query, error = found, errors
            else:
                query[rows], error[rows] = found, errors
            rows = rows[moved > still] if step in steps[i + 1 : i + 2] else np.arange(len(query))
        return query, error

    def _nearer(self, moved: Floats, number: int, cloud: Floats, context: Context) -> Floats:
        """Points (k, 6) that came nearer to those that had none near, on the surface again."""
        return self.projected(moved, cloud, context, f"places without points, {number}")[0]

    def projected(
        self, query: Floats, cloud: Floats, context: Context, stage: str, begin: Callable[..., Work] | None = None
    ) -> tuple[Floats, Floats]:
        """Queries (m, 6) on the surface of a cloud (n, 6 + messages), and their expected errors' logarithm (m,)."""
        found, error = self._found(query, cloud, context, stage, begin or projections)
        return found[:, :6], error

    def _found(
        self, query: Floats, cloud: Floats, context: Context, stage: str, begin: Callable[..., Work]
    ) -> tuple[Floats, Floats]:
        """The same, but (m, 6 + messages)."""
        project, workers = partial(begin, batch_size=context.batch_size), context.workers or InProcess(self.network)
        return in_parts(project, query, cloud, workers=workers, context=context, stage=stage)

    def smoothed(self, cloud: Floats, context: Context) -> Floats:
        """A noisy cloud (n, 6 + messages) with its points projected, a few times: each time less noise is seen.

        None moves farther than noise may have moved it: a lone point at a tip is not drawn to the others. If the
        network finds normals they are found anew. Given ones stay, as they tell more of the surface than noisy points
        do, and points move along them alone.
        """
        anew = self.network.passes > 0
        limit = (MOVED if anew else MOVED_ALONG) * noise_there(cloud)[:, None]
        smooth = cloud
        for number in range(1, (ROUNDS if anew else ROUNDS_ALONG) + 1):
            which = f" {number}" if number > 1 else ""
            stage = f"smoothing{which}, the points are noisy"
            moved, _ = self._found(smooth[:, :6], smooth, context, stage, projections)
            if not anew:
                moved = slid(smooth[:, :6], np.hstack([moved[:, :3], smooth[:, 3:6]]), 0)
            smooth = np.hstack([no_farther(limit, cloud[:, :3], moved[:, :3]), smooth[:, 3:]])
            if anew:
                smooth[:, 3:] = moved[:, 3:]
                smooth = self._anew(smooth, context, f"normals of the smooth points{which and ','}{which}")
        return smooth

    def settled(self, cloud: Floats, context: Context) -> Floats:
        """A cloud without noise (n, 6 + messages), its normals, if the network finds them, found anew a few times more:
        they come nearer to the true ones, where those of a noisy cloud would rather follow its noise."""
        passes = self.network.passes
        return self.with_refined_normals(cloud, MORE, context, after=passes) if passes else cloud

    def with_refined_normals(self, cloud: Floats, passes: int, context: Context, *, after: int = 0) -> Floats:
        """A cloud (n, 6) with the normals that the network finds at its points, so many times one after the other, and
        with messages, (n, 6 + messages): without passes these alone."""
        for number in range(after + 1, after + passes + 1):
            cloud = self._anew(cloud, context, f"normals, pass {number}")
        if self.network.messages and not passes:
            cloud = np.hstack([cloud, self._anew(cloud, context, "what points tell")[:, 6:]])
        return cloud

    def _anew(self, cloud: Floats, context: Context, stage: str) -> Floats:
        """A cloud (n, 6 + messages) with the normals and the messages that the network finds at its points."""
        found, _ = self._found(cloud[:, :6], cloud, context, stage, projections)
        return np.hstack([cloud[:, :3], found[:, 3:]])

    def with_normals(
        self, kept: Floats, cloud: Floats, context: Context, stage: str = "normals of the points kept"
    ) -> Floats:
        """Points (k, 6) with the normals that the network finds at their places."""
        there, _ = self.projected(kept, cloud, context, stage)
        return np.hstack([kept[:, :3], there[:, 3:]])


def _named(progress: Progress, prefix: str, stage: str, done: int, total: int) -> None:
    progress(prefix + stage, done, total)


def in_parts(
    begin: Begin, query: Floats, cloud: Floats, *, workers: Workers, context: Context, stage: str
) -> tuple[Floats, Floats]:
    """query (m, 6) -> projected (m, 6 + messages) and logarithm of the expected error (m,)."""
    on_cpu = str(context.device) == "cpu"
    size = queries_at_once(on_cpu, context.batch_size) * (BATCHES if on_cpu else 1)
    order = along_curve(query[:, :3])

    def project(first: int) -> Floats:
        some = query.take(order[first : first + KEPT], 0)
        parts = [some[at : at + size] for at in range(0, len(some), size)]
        found = []
        for number, part in enumerate(workers.map(begin, cloud, parts), 1):
            found.append(part)
            context.progress(stage, min(first + number * size, len(query)), len(query))
        return np.concatenate(found)

    context.progress(stage, 0, len(query))
    projected, error = np.empty((0, 0)), np.empty(len(query))  # apart: who wants one need not keep both
    for first in range(0, len(query), KEPT):
        rows = order[first : first + KEPT]
        name = f"{stage}, {first} to {first + len(rows)} of {len(query)}"  # which an older version may cut otherwise
        found = context.parts.get(name, partial(project, first))
        if not first:
            projected = np.empty((len(query), found.shape[1] - 1))
        projected[rows, :6], error[rows], projected[rows, 6:] = found[:, :6], found[:, 6], found[:, 7:]
    context.progress(stage, len(query), len(query))
    return projected, error


def projections(network: Any, cloud: Floats, batch_size: int | None = None) -> Work:
    """Around a cloud (n, 6 + messages): queries (m, 6) -> projected, logarithm of the expected error, messages, (m, 7 +
    messages)."""
    cloud = cloud[along_curve(cloud[:, :3])]
    project = _compiled(network)
    if project is None:
        from pnu.upsamplers.network_projection import network_projections

        return network_projections(network, cloud, partial(queries_at_once, batch_size=batch_size))
    ranks = network.ranks(len(cloud))

    def chosen(query: Floats, cloud: Floats, idx: Index) -> Floats:
        return project(query, cloud, idx[:, ranks] if len(ranks) < idx.shape[1] else idx)

    return by_neighbors(chosen, cloud, network.reach, batch_size)


def coarsely(network: Any, cloud: Floats, batch_size: int | None = None) -> Work:
    """As `projections`, by the smaller network for the first of them, where there is one."""
    return projections(network if network.coarse is None else network.coarse, cloud, batch_size)


def spheres(network: Any, cloud: Floats, batch_size: int | None = None) -> Work:
    """As `projections`, but to the sphere that fits the nearest points, without network and expected error."""
    cloud = cloud[along_curve(cloud[:, :3])]
    if _compiled(network) is None:
        from pnu.upsamplers.network_projection import sphere_projections

        like = network.projector.out.weight
        return sphere_projections(like, cloud, CLOSE, partial(queries_at_once, batch_size=batch_size))
    return by_neighbors(compiled_feet, cloud, CLOSE, batch_size)


def _compiled(network: Any) -> Project | None:
    """The step of a network by compiled kernels, or None."""
    if isinstance(network, CompiledSurface):
        return network.project
    from pnu.fast.compiled_projector import compiled_projection

    return compiled_projection(network)


def by_neighbors(project: Project, cloud: Floats, k: int, batch_size: int | None) -> Work:
    """project(queries (m, 6), cloud (n, 6), their k nearest points as idx (m, k)), for queries in batches.

    Each thread works on batches of its own, so the result does not depend on their number.
    """
    tree, size = PointTree(cloud[:, :3]), queries_at_once(True, batch_size)

    def work(query: Floats) -> Floats:
        idx = tree.nearest_sq(query[:, :3], min(k, len(cloud)), threads=threads.thread_count(), ordered=True)[1]
        batches = [slice(start, start + size) for start in range(0, len(query), size)]
        return np.concatenate(threads.map_on_threads(lambda part: project(query[part], cloud, idx[part]), batches))

    return work


def starts_on_spheres(network: Any) -> bool:
    """Whether candidates are first moved to the sphere that fits their neighbors, as the network begins there."""
    return bool(network.sphere if isinstance(network, CompiledSurface) else network.projector.sphere)


def queries_at_once(on_cpu: bool, batch_size: int | None) -> int:
    """Queries that go through the network together."""
    return batch_size or (BATCH if on_cpu else 2**16)


def noise_in_spacings(cloud: Floats) -> float:
    """Noise of a cloud (n, 6) in units of the spacing of its points."""
    return noise_level(cloud[:, :3], cloud[:, 3:6]) / spacing(cloud[:, :3])


def noise_there(cloud: Floats) -> Floats:
    """Noise at each point of a cloud (n, 6), (n,): that of the whole, but in places that are louder theirs."""
    level = noise_level(cloud[:, :3], cloud[:, 3:6])
    if not is_louder_in_places(cloud[:, :3], cloud[:, 3:6], level):
        return np.full(len(cloud), level)
    there = local_noise(cloud[:, :3], cloud[:, 3:6])
    return np.where(there > LOUDER * level, there, level)


def shows_noise(cloud: Floats) -> bool:
    """Whether noise stands out from curvature in a cloud (n, 6), or in places of it."""
    level = noise_level(cloud[:, :3], cloud[:, 3:6])
    return level > FAINT * spacing(cloud[:, :3]) or is_louder_in_places(cloud[:, :3], cloud[:, 3:6], level)


def is_even(cloud: Floats, limit: float = EVEN) -> bool:
    """Whether the points of a cloud (n, 6) are evenly spread, as farthest points are: their spacing varies by less."""
    apart = PointTree(cloud[:, :3]).among_themselves(2, threads=threads.thread_count())[0][:, 0]
    return bool(apart.std(ddof=1) < limit * apart.mean())


def seeds_around(cloud: Floats, each: int, count: int, step: Step = silent, *, first: int | None = None) -> Floats:
    """Points of a cloud (n, 6) and `each` seeds around each, thinned to (count, 6), with the points' normals.

    With `first` those around the first points alone, and only where no other point is nearer.
    """
    step(0, 1)
    first = len(cloud) if first is None else first
    places = np.empty((first * (1 + each), 3))
    places[:first] = cloud[:first, :3]
    tangent_discs(cloud[:, :3], cloud[:, 3:6], each, first=first, out=places[first:].reshape(first, each, 3))
    owner = np.concatenate([np.arange(first, dtype=np.int32), np.arange(first, dtype=np.int32).repeat(each)])
    if first < len(cloud):
        own = _nearest(places, cloud[:, :3])[1] < first
        places, owner = places[own], owner[own]
    if len(places) <= count:
        kept = np.arange(len(places))
        step(1, 1)
    else:
        kept = farthest_points_large(places, count, step=step)
    seeds = np.empty((len(kept), 6))
    seeds[:, :3], seeds[:, 3:] = places.take(kept, 0), cloud[owner[kept], 3:6]
    return seeds


def no_farther(limit: float | Floats, points: Floats, moved: Floats) -> Floats:
    """Points (n, 3) on their way to where they are moved (n, 3), each there or as far as its limit, (n, 1) or one."""
    step = moved - points
    share = np.minimum(1, limit / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300))
    found: Floats = points + share * step
    return found


def slid(query: Floats, refined: Floats, share: float) -> Floats:
    """Queries (m, 6) moved as refined (m, 6), but along the surface only that share of the way; normals as refined."""
    if share == 1:
        return refined
    step, normals = refined[:, :3] - query[:, :3], refined[:, 3:]
    along = step - (step * normals).sum(1, keepdims=True) * normals
    return np.hstack([refined[:, :3] - (1 - share) * along, normals])


def within_reach(points: Floats, error: Floats, cloud: Floats, count: int) -> Index:
    """Indices, ascending, of at least `count` of the points (m, 3): some that lie far from all of a cloud are left out.

    The surface is nowhere farther than about a spacing from an even cloud (n, 3). What is as far, and what is nearer
    but has a high expected error (m,), lies between walls or beyond edges.
    """
    risk = error + DISTANT * _nearest(points, cloud)[0] / spacing(cloud)
    far = (-risk).argsort(kind="stable")[: len(points) - count]
    stays = np.ones(len(points), bool)
    stays[far[risk[far] > RISKY]] = False
    return np.flatnonzero(stays)


def reject_worst(points: Floats, error: Floats, count: int) -> Index:
    """Indices (count,), ascending, of the points (m, 3) that stay when those of the highest error (m,) are dropped.

    Of neighbors only the worst goes, as long as there are others to drop: a bad point without its surroundings would
    be a hole.
    """
    surplus = len(points) - count
    doubtful = (-error).argsort(kind="stable")[: DOUBTFUL * surplus]
    around = PointTree(points).nearest(points[doubtful], min(AROUND, len(points)), threads=threads.thread_count())[1]
    worst = error[doubtful] >= error[around].max(1)
    stays = np.ones(len(points), bool)
    stays[np.concatenate([doubtful[worst], doubtful[~worst]])[:surplus]] = False
    return np.flatnonzero(stays)


def even_out(cloud: Floats, steps: int, step: Step = silent, kept: Floats | None = None) -> Floats:
    """A cloud (m, 6) with points moved to an even spacing, between points (k, 6) that stay where they are."""
    everything = cloud if kept is None else np.concatenate([cloud, kept])
    moved = repel(everything[:, :3], everything[:, 3:], steps=steps, step=step, movable=len(cloud))
    return np.hstack([moved[: len(cloud)], cloud[:, 3:]])


def thin_between(cloud: Floats, count: int, kept: Floats, step: Step = silent) -> Floats:
    """Farthest points of a cloud (n, 6) that leave room around those kept (k, 6): (min(n, count), 6)."""
    if len(kept) and len(cloud) > count:
        even = spacing(kept[:, :3]) * (len(kept) / (len(kept) + count)) ** 0.5
        apart = _nearest(cloud[:, :3], kept[:, :3])[0]
        enough = np.partition(apart, len(apart) - count)[len(apart) - count]  # so many have to stay
        cloud = cloud[apart >= min(enough, ROOM * even)]
    return thin(cloud, count, step)


def thin(cloud: Floats, count: int, step: Step = silent) -> Floats:
    """Farthest points of a cloud (n, 6): (min(n, count), 6)."""
    if len(cloud) <= count:
        return cloud
    return cloud.take(farthest_points_large(cloud[:, :3], count, step=step), 0)


def _nearest(queries: Floats, points: Floats) -> tuple[Floats, Index]:
    """Distance of each query (m, 3) from the nearest of points (n, 3), (m,), and which that is, (m,)."""
    distance, row = PointTree(points).nearest(queries, 1, threads=threads.thread_count())
    return distance[:, 0], row[:, 0]
