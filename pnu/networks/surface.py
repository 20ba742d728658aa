"""Learned surface projection: points near a cloud are moved onto the surface that it samples.

A query sees its nearest input points with their normals in a local frame (`pnu.geometry.local_frames`). An algebraic
sphere gives a first foot and normal; a small network shared by all neighbors, with maximum and attention pooling,
corrects both. How clouds become dense with it, is in `pnu.upsamplers.surface_projection`.
"""

import copy
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import linear, normalize

from pnu.geometry.even_spacing import GOLDEN_ANGLE, RANK, tangent_discs
from pnu.geometry.local_frames import FEATURES, local_frames, tangent_basis
from pnu.geometry.neighbor_features import gather
from pnu.geometry.neighbor_ranks import neighbor_ranks
from pnu.geometry.neighbor_search import knn
from pnu.geometry.sampling import farthest_points
from pnu.networks.compiled_surface import NEAREST

EACH = 3  # seeds of a point, in training, before they are thinned out
OUT = 7  # numbers of the network: step, normal, logarithm of the error; then messages
TOLD = 0.55  # share of the points of a patch, in training, that tell something: the others' neighbors are cut off
PUSH = 0.1  # between rounds of training, beside the way from its point to a seed


class Projector(nn.Module):
    """One step onto the surface, for queries (m, 3) with rough normals, from their k nearest points and normals."""

    def __init__(self, width: int = 64, *, sphere: bool = True, attention: bool = True, messages: int = 0) -> None:
        super().__init__()
        self.sphere, self.attend, self.messages = sphere, attention, messages
        self.first, self.second = nn.Linear(FEATURES + messages, width), nn.Linear(width, width)
        self.context = nn.Linear(2 * width + 1, width)
        self.third = nn.Linear(width, width)
        self.attention = nn.Linear(width, width + 2, bias=False)  # a bias changes no share
        self.head = nn.Sequential(nn.Linear(3 * width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width), nn.ReLU())
        self.out = nn.Linear(width, OUT + messages)
        nn.init.zeros_(self.out.weight[:OUT])
        nn.init.zeros_(self.out.bias)
        nn.init.zeros_(self.first.weight[:, FEATURES:])

    def forward(self, offsets: Tensor, normals: Tensor, hint: Tensor, told: Tensor | None = None) -> tuple[Tensor, ...]:
        """Neighbors relative to the query (m, k, 3), their normals, the query's rough normal (m, 3), and what the
        neighbors tell (m, k, messages), None: nothing yet ->

        step (m, 3), unit normal (m, 3), logarithm of the expected error in spacings (m,), spacing (m, 1); with messages
        also what a point at this place tells those that look at it (m, messages), from -1 to 1."""
        with torch.no_grad():
            frame = local_frames(offsets, normals, hint, sphere=self.sphere)
        features = frame.features
        if self.messages:
            told = offsets.new_zeros((*offsets.shape[:2], self.messages)) if told is None else told
            features = torch.cat([features, told], -1)
        y = self.second(self.first(features).relu_()).relu_()
        context = self.context(torch.cat([y.amax(1), self.weighed(y.clone(), y), frame.height], -1))
        # the bias is added to the few contexts, not to the many neighbors
        y = linear(y, self.third.weight).add_((context + self.third.bias)[:, None]).relu_()
        of_features, of_choices = torch.split(self.attention.weight, [y.shape[-1], 2])
        seen = self.weighed(linear(y, of_features), y)
        choice = self.shares(linear(y, of_choices))
        out = self.out(self.head(torch.cat([y.amax(1), seen, context], -1)))
        # beside what the network finds freely, it chooses among the neighbors' normals and their bent planes
        bent = (choice[..., 1] * frame.features[..., 7]).sum(1)
        step = torch.cat([out[:, :2], (out[:, 2] + 0.5 * bent)[:, None]], 1)
        normal = (choice[..., :1] * frame.features[..., 3:6]).sum(1) + out[:, 3:6]
        step, normal = ((v[:, None] @ frame.axes)[:, 0] for v in (step, normal))
        tells = (out[:, OUT:].tanh(),) if self.messages else ()
        return frame.base + frame.spacing * step, normalize(normal, dim=-1), out[:, 6], frame.spacing, *tells

    def weighed(self, logits: Tensor, y: Tensor) -> Tensor:
        """Sum of y (m, k, c) over the neighbors, by their `shares`: (m, c). Without gradient it overwrites logits."""
        if torch.is_grad_enabled() or not self.attend:
            return (self.shares(logits) * y).sum(1)
        shares = logits.sub_(logits.amax(1, keepdim=True)).exp_()
        total = shares.sum(1)
        return shares.mul_(y).sum(1).div_(total)

    def shares(self, logits: Tensor) -> Tensor:
        """Weights of the neighbors, for each of the features (m, k, c); all alike without attention."""
        return logits.softmax(1) if self.attend else torch.full_like(logits, 1 / logits.shape[1])


class Surface(nn.Module):
    """A network that projects points onto the surface of a cloud.

    How its upsampler (`procedure`) works with it is kept here, as what was found best for these weights.

    Args:
        ratio: points out for each point in, where a command asks for none
        neighbors: input points that a seed looks at
        reach: rank of the farthest of them; beyond the 16 nearest they are thinned out evenly
        width: of the network
        rounds: projections in training; at work there are 1 + refinements
        seeds: seeds for each point wanted
        candidates: of them, after thinning out evenly; each moves to a sphere. null: 3 where input points stay, else 2
        shortlist: of those, thinned out again after they moved; the network projects these. null: 2 where input points
            stay, else 1.15
        relaxation: steps of even spacing; 0: none
        refinements: projections after the even spacing; one more is nearer to the surface and a little less even
        reject: share of points made too many; the worst of their surroundings by expected error are dropped
        slide: share of their way along the surface that points make in a refinement; a small one leaves points at tips
            and creases, from where the network draws them, and is a little less near to the surface
        queries: seeds of a crop, in training
        smoothing: share of the crops in training whose inner points are themselves projected first, as those of a noisy
            cloud are at work
        refining: share of the crops in training whose inner points get the network's own normals first
        passes: at work, times that the normals of the cloud are replaced by those that the network finds at its points;
            where this is not 0 and there is no noise, two more
        messages: numbers that each point of a cloud tells those that look at it, so that these know more than their
            own neighbors; the network finds them at the point, in each of the passes, or in one for them alone
        sphere: start from the sphere that fits the neighbors (algebraic point set surface), not from the seed
        attention: weigh the neighbors; without it all count alike
        coarse: width of a smaller network that sees the 16 nearest points and at work makes the first projections, in a
            fraction of the time; 0: none
        fine: the last projections, so many, by the network itself, where there is a coarse one
    """

    predicts_normals = True
    procedure = "surface"
    patch_size = 1024
    optional = ("coarse.",)  # a training may begin with weights that have more or less of these,
    widths = ("projector.first.weight", "projector.out.weight", "projector.out.bias")  # or of more or fewer messages

    def __init__(
        self, ratio: int = 4, neighbors: int = 24, reach: int = 24, width: int = 64, rounds: int = 2,
        seeds: float = 4, candidates: float | None = None, shortlist: float | None = None,
        relaxation: int = 2, refinements: int = 2, reject: float = 0.003, slide: float = 1.0,
        queries: int = 64, smoothing: float = 0.0, refining: float = 0.0, passes: int = 0,
        sphere: bool = True, attention: bool = True, messages: int = 0, coarse: int = 0, fine: int = 1,
    ) -> None:  # fmt: skip
        super().__init__()
        self.ratio, self.neighbors, self.reach, self.rounds = ratio, neighbors, reach, rounds
        self.seeds, self.candidates, self.shortlist = seeds, candidates, shortlist
        self.relaxation, self.refinements, self.reject, self.queries = relaxation, refinements, reject, queries
        if not 4 <= neighbors <= reach:
            raise ValueError(f"model.reach={reach}: expected at least model.neighbors={neighbors}, which is at least 4")
        if reject < 0:
            raise ValueError(f"model.reject={reject}: expected a share of the points, 0 or more")
        self.fine = fine
        for name in ("rounds", "seeds", "candidates", "shortlist", "refinements", "queries", "fine"):
            number = getattr(self, name)
            if number is not None and number < 1:  # too few seeds would be too few points
                raise ValueError(f"model.{name}={number}: expected at least 1")
        for name, share in (("smoothing", smoothing), ("refining", refining), ("slide", slide)):
            if not 0 <= share <= 1:
                raise ValueError(f"model.{name}={share}: expected a share from 0 to 1")
        for name, count in (("passes", passes), ("messages", messages), ("coarse", coarse)):
            if count < 0:
                raise ValueError(f"model.{name}={count}: expected 0 or more")
        self.smoothing, self.refining, self.passes, self.slide = smoothing, refining, passes, slide
        self.messages = messages
        self.projector = Projector(width, sphere=sphere, attention=attention, messages=messages)
        self.coarse: Surface | None = None
        if coarse:
            few = {"neighbors": NEAREST, "reach": NEAREST, "rounds": rounds, "width": coarse}
            self.coarse = Surface(ratio, **few, sphere=sphere, attention=attention)

    @property
    def coarse_width(self) -> int:
        """That of the network for the coarse steps; 0 where there is none."""
        return 0 if self.coarse is None else self.coarse.projector.out.in_features

    def with_coarse(self, coarse: nn.Module) -> "Surface":
        """The same network with a surface model of NEAREST neighbors for its coarse steps; ValueError if it is none."""
        if not isinstance(coarse, Surface) or (coarse.neighbors, coarse.reach) != (NEAREST, NEAREST):
            raise ValueError(
                f"coarse: expected a surface model with neighbors and reach of {NEAREST}, found another one"
            )
        mine, its = self.projector, coarse.projector
        if (its.sphere, its.attend) != (mine.sphere, mine.attend):
            raise ValueError("coarse: expected a surface model with the same sphere and attention, found others")
        joined = copy.copy(self)
        joined._modules = dict(self._modules)
        joined.coarse = coarse
        return joined

    def check_input(self, key: str, points: int) -> None:
        """`ValueError` where training inputs of so many points, set by `key`, have no room for the queries."""
        if self.queries > EACH * points:
            raise ValueError(
                f"model.queries={self.queries}: expected at most {EACH} times the points of a training input, "
                f"{key}={points}"
            )

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        """Training: a seed for each of the first `queries` points of patches (B, n, 6), projected `rounds` times.

        "query" and "projected" (rounds, B, queries, 6) before and after each round, "log_error" and "spacing"
        (rounds, B, queries), those of a coarse network before the others; "prediction" is the last of "projected". A
        query has no gradient. With messages the first rounds are those of points of the patch, where these are found.
        """
        found: list[tuple[Tensor, ...]] = []
        if self.messages:
            patch = self.with_messages(self.with_some_smoothed(patch), found)
        else:
            patch = self.with_some_smoothed(self.with_some_refined(patch))
        query, outward = self.training_seeds(patch[..., :6])
        for network in (self.coarse, self) if self.coarse is not None else (self,):
            place = query
            for _ in range(self.rounds):
                projected, log_error, spacing = network.project(place, patch)
                projected = projected[..., :6]
                found.append((place, projected, log_error, spacing))
                place = projected.detach() + outward
        names = ("query", "projected", "log_error", "spacing")
        outputs = dict(zip(names, (torch.stack(values) for values in zip(*found, strict=True)), strict=True))
        return outputs | {"prediction": outputs["projected"][-1]}

    @torch.no_grad()
    def with_some_smoothed(self, patch: Tensor) -> Tensor:
        """Patches (B, n, 6), the nearer half of the points of the first of them projected, a share of `smoothing`."""
        some, inner = round(self.smoothing * len(patch)), patch.shape[1] // 2
        if not some:
            return patch
        smooth, _, _ = self.project(patch[:some, :inner], patch[:some])
        return torch.cat([torch.cat([smooth[..., :6], patch[:some, inner:]], 1), patch[some:]])

    @torch.no_grad()
    def with_some_refined(self, patch: Tensor) -> Tensor:
        """Patches (B, n, 6), the nearer half of the points of the last with normals found by the network.

        A share of `refining` gets them, half of these twice.
        """
        inner = patch.shape[1] // 2
        for share in (self.refining, self.refining / 2):
            plain = len(patch) - round(share * len(patch))
            if plain < len(patch):
                found, _, _ = self.project(patch[plain:, :inner], patch[plain:])
                patch = patch.clone()
                patch[plain:, :inner, 3:] = found[..., 3:6]
        return patch

    def with_messages(self, patch: Tensor, found: list[tuple[Tensor, ...]]) -> Tensor:
        """Patches (B, n, 6) with what their nearer points tell, (B, n, 6 + messages), as at work: with the normals that
        the network finds there in as many passes. Its rounds are appended to `found`."""
        self.check_input("points", patch.shape[1])
        inner, some = round(TOLD * patch.shape[1]), min(self.queries, round(TOLD * patch.shape[1]))
        told = patch.new_zeros((*patch.shape[:2], self.messages))
        for _ in range(max(1, self.passes)):
            projected, log_error, spacing = self.project(patch[:, :inner], torch.cat([patch, told], -1))
            found.append((patch[:, :some], projected[:, :some, :6], log_error[:, :some], spacing[:, :some]))
            told = torch.cat([projected[..., 6:], told[:, inner:]], 1)
            if self.passes:
                normals = torch.cat([projected[..., 3:6].detach(), patch[:, inner:, 3:]], 1)
                patch = torch.cat([patch[..., :3], normals], -1)
        return torch.cat([patch, told], -1)

    def training_seeds(self, patch: Tensor) -> tuple[Tensor, Tensor]:
        """Seeds around the first points of patches (B, n, 6), (B, queries, 6), and a push of each, (B, queries, 6).

        As at work seeds are thinned out, so that many lie in holes and beyond edges, and pushed on between rounds.
        """
        self.check_input("points", patch.shape[1])
        count = self.queries
        if patch.device.type == "cpu":
            seeds_of = [tangent_discs(p[:, :3], p[:, 3:], EACH, first=count) for p in patch.detach().numpy()]
            discs = torch.from_numpy(np.stack(seeds_of)).to(patch)
        else:
            discs = discs_of_patches(patch.detach(), EACH, first=count)
        parents = patch[:, :count, None].expand(-1, -1, EACH, -1)
        seeds = torch.cat([discs, parents[..., 3:]], -1).flatten(1, 2)
        push = torch.cat([PUSH * (discs - parents[..., :3]), torch.zeros_like(discs)], -1).flatten(1, 2)
        kept = farthest_points(seeds[..., :3], count)
        return gather(seeds, kept), gather(push, kept)

    def project(self, query: Tensor, clouds: Tensor, idx: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """query (B, m, 6), clouds (B, n, 6 + messages) -> projected (B, m, 6 + messages), log error (B, m), spacing
        (B, m).

        Clouds (B, n, 6) tell nothing yet. idx: their `neighbor_indices`, where they are known.
        """
        batch, m, _ = query.shape
        like = self.projector.out.weight
        idx = self.neighbor_indices(query, clouds) if idx is None else idx
        near = gather(clouds, idx)
        offsets = (near[..., :3] - query[:, :, None, :3]).flatten(0, 1).to(like)
        told = near[..., 6:].flatten(0, 1).to(like) if near.shape[-1] > 6 else None
        step, normal, log_error, spacing, *tells = self.projector(
            offsets, near[..., 3:6].flatten(0, 1).to(like), query[..., 3:6].flatten(0, 1).to(like), told
        )
        moved = query[..., :3] + step.view(batch, m, 3).to(query)
        return (
            torch.cat([moved, *(values.view(batch, m, -1).to(query) for values in (normal, *tells))], -1),
            log_error.view(batch, m),
            spacing.view(batch, m),
        )

    def neighbor_indices(self, query: Tensor, clouds: Tensor) -> Tensor:
        """Points of clouds (B, n, 6) that queries (B, m, 6) look at: (B, m, k)."""
        n = clouds.shape[1]
        nearest = knn(query[..., :3], clouds[..., :3], min(self.reach, n)).idx
        return nearest.index_select(-1, ranks_on(nearest.device, self.neighbors, self.reach, n))

    def ranks(self, n: int) -> list[int]:
        """Ranks of the neighbors that are looked at, of those that a cloud of n points has."""
        return neighbor_ranks(self.neighbors, self.reach, n)

    def forward(self, patch: Tensor) -> Tensor:
        """As in training: patch (B, n, 6) -> (B, queries, 6). Whole clouds: `pnu.upsamplers.surface_projection`."""
        return self.outputs(patch)["prediction"]


@lru_cache(maxsize=8)
def ranks_on(device: torch.device, neighbors: int, reach: int, n: int) -> Tensor:
    """`neighbor_ranks` on a device, kept there: sending them each time would have it wait."""
    return torch.tensor(neighbor_ranks(neighbors, reach, n), device=device)


def discs_of_patches(patch: Tensor, count: int, *, first: int) -> Tensor:
    """`tangent_discs` of the first points of patches (B, n, 6), (B, first, count, 3), all at once on their device."""
    n = patch.shape[1]
    points, normals = patch[:, :first, :3], patch[:, :first, 3:6]
    near = knn(points, patch[..., :3], min(RANK, n - 1) + 1)
    radius = near.dist_sq[..., -1:].sqrt()
    toward = gather(patch[..., :3], near.idx[..., 1]) - points
    along = toward - (toward * normals).sum(-1, keepdim=True) * normals
    short = along.norm(dim=-1, keepdim=True) <= 1e-6 * radius
    aside, _ = tangent_basis(normals.flatten(0, 1))
    along = normalize(torch.where(short, aside.view_as(along), along), dim=-1)
    across = torch.linalg.cross(normals, along)
    point = torch.arange(points.shape[1], device=patch.device, dtype=patch.dtype)[:, None]
    seed = torch.arange(count, device=patch.device, dtype=patch.dtype)
    share = (seed + (point / GOLDEN_ANGLE) % 1) / count
    angle = GOLDEN_ANGLE * (seed + count * point)
    x, y = (radius * share.sqrt() * turned for turned in (angle.cos(), angle.sin()))
    discs: Tensor = points[:, :, None] + x[..., None] * along[:, :, None] + y[..., None] * across[:, :, None]
    return discs
