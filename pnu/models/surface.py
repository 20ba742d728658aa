"""Learned surface projection: seeds around the input points are moved onto the surface that the points sample.

A seed sees its nearest input points with their normals in a local frame (`pnu.ops.frames`). An algebraic sphere gives
a first foot and normal; a small network shared by all neighbours, with maximum and attention pooling, corrects both.
There are no patches, hence no borders; the cost grows with the output; any ratio is possible.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, normalize

from pnu.ops.blocks import along_curve
from pnu.ops.frames import FEATURES, feet, local_frames
from pnu.ops.grouping import gather
from pnu.ops.nearest import Search, knn
from pnu.ops.noise import noise_level
from pnu.ops.sampling import farthest_points, farthest_points_large
from pnu.ops.spacing import spacing
from pnu.ops.spread import repel, tangent_discs
from pnu.runtime import threads
from pnu.runtime.parts import Keep, forget
from pnu.runtime.progress import Progress, Step, silent
from pnu.runtime.workers import Here, Work, Workers

EACH = 3  # seeds of a point, in training, before they are thinned out
PUSH = 0.1  # between rounds of training, beside the way from its point to a seed
SMOOTH = 0.1  # noise in spacings from which on a cloud is smoothed first
KEPT = 2**19  # queries whose projections are kept in one file
BATCH = 512  # queries at once on a CPU,
BATCHES = 32  # of which its threads share so many
AROUND = 8  # points of which one at most is dropped,
DOUBTFUL = 16  # looked for among so many for each point to drop
CLOSE = 12  # neighbours of the sphere that candidates are first moved to
DENSE = 16  # neighbours that are all looked at; farther ones are thinned out


class Projector(nn.Module):
    """One step onto the surface, for queries (m, 3) with rough normals, from their k nearest points and normals."""

    def __init__(self, width: int = 64, *, sphere: bool = True, attention: bool = True) -> None:
        super().__init__()
        self.sphere, self.attend = sphere, attention
        self.first, self.second = nn.Linear(FEATURES, width), nn.Linear(width, width)
        self.context = nn.Linear(2 * width + 1, width)
        self.third = nn.Linear(width, width)
        self.attention = nn.Linear(width, width + 2, bias=False)  # a bias changes no share
        self.head = nn.Sequential(nn.Linear(3 * width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width), nn.ReLU())
        self.out = nn.Linear(width, 7)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, offsets: Tensor, normals: Tensor, hint: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Neighbours relative to the query (m, k, 3), their normals, the query's rough normal (m, 3) ->

        step (m, 3), unit normal (m, 3), logarithm of the expected error in spacings (m,), spacing (m, 1)."""
        with torch.no_grad():
            frame = local_frames(offsets, normals, hint, sphere=self.sphere)
        y = self.second(self.first(frame.features).relu_()).relu_()
        context = self.context(torch.cat([y.amax(1), self.weighed(y.clone(), y), frame.height], -1))
        # the bias is added to the few contexts, not to the many neighbours
        y = linear(y, self.third.weight).add_((context + self.third.bias)[:, None]).relu_()
        of_features, of_choices = self.attention.weight.split([y.shape[-1], 2])
        seen = self.weighed(linear(y, of_features), y)
        choice = self.shares(linear(y, of_choices))
        out = self.out(self.head(torch.cat([y.amax(1), seen, context], -1)))
        # beside what the network finds freely, it chooses among the neighbours' normals and their bent planes
        bent = (choice[..., 1] * frame.features[..., 7]).sum(1)
        step = torch.cat([out[:, :2], (out[:, 2] + 0.5 * bent)[:, None]], 1)
        normal = (choice[..., :1] * frame.features[..., 3:6]).sum(1) + out[:, 3:6]
        step, normal = ((v[:, None] @ frame.axes)[:, 0] for v in (step, normal))
        return frame.base + frame.spacing * step, normalize(normal, dim=-1), out[:, 6], frame.spacing

    def weighed(self, logits: Tensor, y: Tensor) -> Tensor:
        """Sum of y (m, k, c) over the neighbours, by their `shares`: (m, c). Without gradient it overwrites logits."""
        if torch.is_grad_enabled() or not self.attend:
            return (self.shares(logits) * y).sum(1)
        shares = logits.sub_(logits.amax(1, keepdim=True)).exp_()
        total = shares.sum(1)
        return shares.mul_(y).sum(1).div_(total)

    def shares(self, logits: Tensor) -> Tensor:
        """Weights of the neighbours, for each of the features (m, k, c); all alike without attention."""
        return logits.softmax(1) if self.attend else torch.full_like(logits, 1 / logits.shape[1])


class Surface(nn.Module):
    """Upsampling by learned projection: seeds, spheres, projection of a shortlist, even spacing, projection, rejection.

    Args:
        ratio: points out for each point in, where none is asked for (`upsample_cloud` takes any count).
        neighbours: input points that a seed looks at.
        reach: rank of the farthest of them; beyond the 16 nearest they are thinned out evenly.
        width: of the network.
        rounds: projections in training; at work there are 1 + `refinements`.
        seeds: seeds for each point wanted.
        candidates: of them, after thinning out to an even spacing; each moves to a sphere.
        shortlist: of those, thinned out again; the network projects these, and farthest points of them stay.
        relaxation: steps of even spacing.
        refinements: projections after it; one more is nearer to the surface and a little less even.
        reject: share of the points that is made too many; the worst of
            their surroundings by expected error are dropped in the end.
        queries: seeds of a crop, in training.
        sphere: start from the sphere that fits the neighbours (algebraic point set surface), not from the seed.
        attention: weigh the neighbours; without it all count alike.
    """

    predicts_normals = True
    patch_size = 1024

    def __init__(
        self, ratio: int = 4, neighbours: int = 24, reach: int = 24, width: int = 64, rounds: int = 2,
        seeds: float = 4, candidates: float = 2, shortlist: float = 1.15,
        relaxation: int = 2, refinements: int = 2, reject: float = 0.003,
        queries: int = 64, sphere: bool = True, attention: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        self.ratio, self.neighbours, self.reach, self.rounds = ratio, neighbours, reach, rounds
        self.seeds, self.candidates, self.shortlist = seeds, candidates, shortlist
        self.relaxation, self.refinements, self.reject, self.queries = relaxation, refinements, reject, queries
        if not 4 <= neighbours <= reach:
            raise ValueError(
                f"model.reach={reach}: expected at least model.neighbours={neighbours}, which is at least 4"
            )
        if reject < 0:
            raise ValueError(f"model.reject={reject}: expected a share of the points, 0 or more")
        for name in ("rounds", "seeds", "candidates", "shortlist", "refinements"):
            if getattr(self, name) < 1:  # too few seeds would be too few points
                raise ValueError(f"model.{name}={getattr(self, name)}: expected at least 1")
        self.projector = Projector(width, sphere=sphere, attention=attention)

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """Training: a seed for each of the first `queries` points of patches (B, n, 6), projected `rounds` times.

        "query" and "projected" (rounds, B, queries, 6) before and after each round, "log_error" and "spacing"
        (rounds, B, queries); "prediction" is the last of "projected". A query has no gradient.
        """
        query, outward = self.training_seeds(patch)
        found: list[tuple[Tensor, ...]] = []
        for _ in range(self.rounds):
            projected, log_error, spacing = self.project(query, patch)
            found.append((query, projected, log_error, spacing))
            query = projected.detach() + outward
        names = ("query", "projected", "log_error", "spacing")
        outputs = dict(zip(names, (torch.stack(values) for values in zip(*found, strict=True)), strict=True))
        return outputs | {"prediction": outputs["projected"][-1]}

    def training_seeds(self, patch: Tensor) -> tuple[Tensor, Tensor]:
        """Seeds around the first points of patches (B, n, 6), (B, queries, 6), and a push of each, (B, queries, 6).

        As at work seeds are thinned out, so that many lie in holes and beyond edges, and pushed on between rounds.
        """
        count = self.queries
        discs = torch.stack([tangent_discs(p[:, :3], p[:, 3:], EACH, first=count) for p in patch])
        parents = patch[:, :count, None].expand(-1, -1, EACH, -1)
        seeds = torch.cat([discs, parents[..., 3:]], -1).flatten(1, 2)
        push = torch.cat([PUSH * (discs - parents[..., :3]), torch.zeros_like(discs)], -1).flatten(1, 2)
        kept = farthest_points(seeds[..., :3], count)
        return gather(seeds, kept), gather(push, kept)

    def project(self, query: Tensor, clouds: Tensor, idx: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """query (B, m, 6), clouds (B, n, 6) -> projected (B, m, 6), log error (B, m), spacing (B, m).

        idx: their `neighbors`, where they are known.
        """
        batch, m, _ = query.shape
        like = self.projector.out.weight
        idx = self.neighbors(query, clouds) if idx is None else idx
        near = clouds[torch.arange(batch, device=idx.device)[:, None, None], idx]
        offsets = (near[..., :3] - query[:, :, None, :3]).flatten(0, 1).to(like)
        step, normal, log_error, spacing = self.projector(
            offsets, near[..., 3:].flatten(0, 1).to(like), query[..., 3:].flatten(0, 1).to(like)
        )
        moved = query[..., :3] + step.view(batch, m, 3).to(query)
        return (
            torch.cat([moved, normal.view(batch, m, 3).to(query)], -1),
            log_error.view(batch, m),
            spacing.view(batch, m),
        )

    def neighbors(self, query: Tensor, clouds: Tensor) -> Tensor:
        """Points of clouds (B, n, 6) that queries (B, m, 6) look at: (B, m, k)."""
        n = clouds.shape[1]
        return knn(query[..., :3], clouds[..., :3], min(self.reach, n)).idx[..., self.ranks(n)]

    def ranks(self, n: int) -> list[int]:
        """Ranks of the neighbours that are looked at, of those that a cloud of n points has."""
        far = torch.linspace(DENSE, self.reach - 1, max(self.neighbours - DENSE, 0)).round().long().tolist()
        return [rank for rank in [*range(min(DENSE, self.neighbours)), *far] if rank < n]

    def forward(self, patch: Tensor) -> Tensor:
        """patch (B, n, 6) -> (B, ratio n, 6)."""
        count = self.ratio * patch.shape[1]
        return torch.stack([self.upsample_cloud(cloud, count) for cloud in patch])

    @torch.no_grad()
    def upsample_cloud(
        self,
        cloud: Tensor,
        count: int,
        *,
        batch_size: int | None = None,
        generator: torch.Generator | None = None,
        progress: Progress = lambda stage, done, total: None,
        keep: Keep = forget,
        workers: Workers | None = None,
    ) -> Tensor:
        """cloud (n, 6) -> (count, 6) with unit normals. Nothing is random.

        The points of a cloud that is noisy beside their spacing are themselves projected first. batch_size: queries at
        once; keep: what takes finished parts; workers: who projects, with `projections`.
        """
        workers = workers or Here(partial(self.projections, batch_size=batch_size))
        run = partial(self.in_parts, workers=workers, batch_size=batch_size, progress=progress, keep=keep)
        if noise_in_spacings(cloud) > SMOOTH:
            cloud, _ = run(cloud, cloud, stage="smoothing, the points are noisy")
        each = max(1, round(self.seeds * count / len(cloud)))
        query = keep(
            "seeds", lambda: seeds_around(cloud, each, round(self.candidates * count), partial(progress, "seeds"))
        ).to(cloud)
        if self.projector.sphere:
            here = Here(partial(self.spheres, batch_size=batch_size))
            query, _ = run(query, cloud, workers=here, stage="spheres")
        some, more = round(self.shortlist * count), round((1 + self.reject) * count)
        query = keep("shortlist", lambda: thin(query, some, partial(progress, "shortlist"))).to(cloud)
        query, error = run(query, cloud, stage="projection")
        query = keep("thinned", lambda: thin(query, more, partial(progress, "thinning"))).to(cloud)
        if self.relaxation:
            query = keep("even", lambda: evened(query, self.relaxation, partial(progress, "even spacing"))).to(cloud)
        for i in range(self.refinements):
            query, error = run(query, cloud, stage=f"refinement {i + 1}")
        return query[spared(query[:, :3], error, count)]

    def in_parts(
        self,
        query: Tensor,
        cloud: Tensor,
        *,
        workers: Workers,
        batch_size: int | None,
        progress: Progress,
        keep: Keep,
        stage: str,
    ) -> tuple[Tensor, Tensor]:
        """query (m, 6) -> projected (m, 6) and logarithm of the expected error (m,)."""
        size = self.batch(cloud, batch_size) * (BATCHES if cloud.device.type == "cpu" else 1)
        order = along_curve(query[:, :3])
        query = query[order]

        def kept(first: int) -> Tensor:
            parts = query[first : first + KEPT].split(size)
            found = []
            for number, part in enumerate(workers.map(cloud, parts), 1):
                found.append(part.to(cloud))
                progress(stage, min(first + number * size, len(query)), len(query))
            return torch.cat(found)

        progress(stage, 0, len(query))
        starts = range(0, len(query), KEPT)
        everything = torch.empty(len(query), 7, dtype=query.dtype, device=query.device)
        for first in starts:
            everything[order[first : first + KEPT]] = keep(
                f"{stage}, {first} of {len(query)}", partial(kept, first)
            ).to(everything)
        progress(stage, len(query), len(query))
        return everything[:, :6], everything[:, 6]

    def projections(self, cloud: Tensor, batch_size: int | None = None) -> Work:
        """Around a cloud (n, 6): queries (m, 6) -> projected and logarithm of the expected error, (m, 7)."""
        ranks = self.ranks(len(cloud))

        def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
            projected, log_error, spacing = self.project(query[None], cloud[None], idx[None, :, ranks])
            return torch.cat([projected[0], (log_error[0] + spacing[0].log()).to(projected)[:, None]], 1)

        return self.by_neighbors(project, cloud, self.reach, batch_size)

    def spheres(self, cloud: Tensor, batch_size: int | None = None) -> Work:
        """As `projections`, but to the sphere that fits the nearest points, without network and expected error."""

        def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
            near, like = cloud[idx], self.projector.out.weight
            offsets = near[..., :3] - query[:, None, :3]
            step, normal = (x.to(query) for x in feet(*(x.to(like) for x in (offsets, near[..., 3:], query[:, 3:]))))
            return torch.cat([query[:, :3] + step, normal, torch.zeros_like(step[:, :1])], 1)

        return self.by_neighbors(project, cloud, CLOSE, batch_size)

    def by_neighbors(
        self, project: Callable[[Tensor, Tensor, Tensor], Tensor], cloud: Tensor, k: int, batch_size: int | None
    ) -> Work:
        """project(queries (m, 6), cloud (n, 6), their k nearest points as idx (m, k)), for queries in batches.

        On the CPU each thread works on batches of its own, so the result does not depend on their number.
        """
        cloud = cloud[along_curve(cloud[:, :3])].to(self.projector.out.weight.device)
        search, size, on_cpu = Search(cloud[:, :3]), self.batch(cloud, batch_size), cloud.device.type == "cpu"

        def work(query: Tensor) -> Tensor:
            query = query.to(cloud)
            idx = search.knn(query[:, :3], min(k, len(cloud))).idx
            batches = [slice(start, start + size) for start in range(0, len(query), size)]

            def batch(part: slice) -> Tensor:
                return project(query[part], cloud, idx[part])

            return torch.cat(threads.spread(batch, batches) if on_cpu else [batch(part) for part in batches])

        return work

    @staticmethod
    def batch(cloud: Tensor, batch_size: int | None) -> int:
        """Queries at once."""
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


def spared(points: Tensor, error: Tensor, count: int) -> Tensor:
    """Indices (count,), ascending, of the points (m, 3) that stay when those of the highest error (m,) are dropped.

    Of neighbours only the worst goes, as long as there are others to drop: a bad point without its surroundings would
    be a hole.
    """
    surplus = len(points) - count
    doubtful = error.argsort(descending=True, stable=True)[: DOUBTFUL * surplus]
    around = knn(points[None, doubtful], points[None], min(AROUND, len(points))).idx[0]
    worst = error[doubtful] >= error[around].amax(1)
    stays = torch.ones_like(error, dtype=torch.bool)
    stays[torch.cat([doubtful[worst], doubtful[~worst]])[:surplus]] = False
    return stays.nonzero()[:, 0]


def evened(cloud: Tensor, steps: int, step: Step = silent) -> Tensor:
    """A cloud (m, 6) with points moved to an even spacing."""
    return torch.cat([repel(cloud[:, :3], cloud[:, 3:], steps=steps, step=step), cloud[:, 3:]], 1)


def thin(cloud: Tensor, count: int, step: Step = silent) -> Tensor:
    """Farthest points of a cloud (n, 6): (min(n, count), 6)."""
    if len(cloud) <= count:
        return cloud
    return cloud[torch.from_numpy(farthest_points_large(cloud[:, :3], count, step=step)).to(cloud.device)]
