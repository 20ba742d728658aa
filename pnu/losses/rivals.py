"""Losses of the rival networks, each from its paper, on the same searches as the compound loss.

Clouds are `prediction` (B, m, 3 or 6), `target` (B, n, 6). Terms are unweighted scalars, means over points and batch.
"""

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor, nn

from pnu.geometry.neighbor_features import gather
from pnu.geometry.neighbor_search import knn, nearest
from pnu.losses.compound import chamfer, emd, search

DENSE = 4096  # target points for which the papers give reaches; with fewer the reach grows as their spacing does


def total(terms: dict[str, Tensor], weights: Mapping[str, float]) -> dict[str, Tensor]:
    """The terms and "loss", their weighted sum."""
    return {**terms, "loss": torch.stack([weights[name] * value for name, value in terms.items()]).sum()}


class RepulsionLoss(nn.Module):
    """PU-Net (section 3.4): reconstruction + w_repulsion * repulsion.

    Repulsion is the mean over points and their k neighbors at distance r of eta(r) w(r), eta(r) = -r and
    w(r) = exp(-r^2 / h), so it is negative and grows in magnitude where close neighbors move apart.

    Args:
        point_term: chamfer, or emd (the paper's earth mover's distance; many times slower)
        w_repulsion: weight of the repulsion, the paper's alpha
        h: squared reach of the repulsion, in the unit sphere, for 4096 target points; for n it is h 4096 / n
        k: neighbors that repel a point
    """

    def __init__(self, point_term: Literal["chamfer", "emd"] = "chamfer", w_repulsion: float = 0.01, h: float = 5e-4,
                 k: int = 5) -> None:  # fmt: skip
        super().__init__()
        if point_term not in ("chamfer", "emd"):
            raise ValueError(f"loss.point_term: expected chamfer or emd, got {point_term!r}")
        self.point_term, self.h, self.k = point_term, h, k
        self.weights = {"cd": 1.0, "emd": 1.0, "repulsion": w_repulsion}

    def forward(
        self, prediction: Tensor, target: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        matches = search(prediction, target, self.k)
        points, terms = prediction[..., :3], {}
        if self.point_term == "chamfer":
            terms["cd"] = chamfer(prediction, target, matches)
        else:
            terms["emd"] = emd(prediction, target)
        dist_sq = (points[:, :, None] - gather(points, matches.neighbors)).square().sum(-1)
        h = self.h * DENSE / target.shape[1]
        terms["repulsion"] = -(dist_sq.clamp_min(1e-12).sqrt() * torch.exp(-dist_sq / h)).mean()
        return total(terms, self.weights)


class EdgeAwareLoss(nn.Module):
    """EC-Net (section 3.3): distance to the surface, repulsion, distance of edge points to the edges, and regression
    of the distance to the nearest edge.

    surface: squared distance of new points to the true surface; the dense target stands for the mesh: distance to the
    tangent plane of the nearest target point, plus what lies beyond the target's spacing within that plane.
    repulsion: mean over k neighbors at distance r of max(0, h^2 - r^2), with h for 4096 target points; for n it is
    h sqrt(4096 / n).
    edge: mean squared true distance to the nearest edge over the points whose regressed distance is below `near`.
    edge_distance: mean squared difference of regressed and true distance, both truncated to [0, reach].

    Reads from `extra`: "edge_distance" (B, m), which the network regresses, and "edges" (B, e, 3), points on the
    sharp edges of the target, rows of NaN where there are fewer than e. Distances and weights are in the units of the
    patch's unit sphere; the defaults of the weights are ours.

    Args:
        w_repulsion: weight of the repulsion
        w_edge: weight of the distance of edge points to the edges
        w_edge_distance: weight of the regressed distance to the nearest edge
        h: reach of the repulsion, in the unit sphere, for 4096 target points; for n it is h sqrt(4096 / n)
        k: neighbors that repel a point
        near: regressed distance below which a point belongs to an edge
        reach: distances to edges are truncated there
    """

    def __init__(
        self,
        w_repulsion: float = 1.0,
        w_edge: float = 0.1,
        w_edge_distance: float = 0.01,
        h: float = 0.03,
        k: int = 4,
        near: float = 0.15,
        reach: float = 0.5,
    ) -> None:
        super().__init__()
        self.h, self.k, self.near, self.reach = h, k, near, reach
        self.weights = {
            "surface": 1.0,
            "repulsion": w_repulsion,
            "edge": w_edge,
            "edge_distance": w_edge_distance,
        }

    def forward(
        self, prediction: Tensor, target: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        if not extra or "edges" not in extra or "edge_distance" not in extra:
            raise ValueError("loss: EdgeAwareLoss needs edges in the data and a network that regresses edge_distance")
        matches = search(prediction, target, self.k)
        points = prediction[..., :3]
        dist_sq = (points[:, :, None] - gather(points, matches.neighbors)).square().sum(-1)
        true = self.distance_to_edges(points, extra["edges"])
        regressed = extra["edge_distance"]
        on_edge = (regressed.detach() < self.near) & (true.detach() < self.reach)
        terms = {
            "surface": surface_distance_sq(points, target, matches.nearest_target).mean(),
            "repulsion": (self.h**2 * DENSE / target.shape[1] - dist_sq).relu().mean(),
            "edge": (true.square() * on_edge).sum() / on_edge.sum().clamp_min(1),
            "edge_distance": (regressed.clamp(0, self.reach) - true.detach().clamp(0, self.reach)).square().mean(),
        }
        return total(terms, self.weights)

    def distance_to_edges(self, points: Tensor, edges: Tensor) -> Tensor:
        """(B, m) distance to the nearest of the edge points; far beyond `reach` in a patch without edges."""
        edges = edges.nan_to_num(nan=10.0)
        closest = gather(edges, nearest(points, edges).idx)
        return (points - closest).square().sum(-1).clamp_min(1e-12).sqrt()


def surface_distance_sq(points: Tensor, target: Tensor, nearest_target: Tensor) -> Tensor:
    """(B, m) squared distance of points to the surface that the dense target (B, n, 6) samples."""
    near = gather(target, nearest_target)
    offset = points - near[..., :3]
    height = (offset * near[..., 3:6]).sum(-1)
    aside = (offset - height[..., None] * near[..., 3:6]).square().sum(-1)
    spacing = target_spacing(target)[:, None]
    return height.square() + (aside.clamp_min(1e-12).sqrt() - spacing).relu().square()


def target_spacing(target: Tensor) -> Tensor:
    """(B,) median distance of target points to their nearest neighbor."""
    points = target[..., :3]
    return knn(points, points, 2).dist_sq[..., 1].sqrt().median(1).values


class ParameterizationLoss(nn.Module):
    """PUGeo-Net (section 4.5): w_cd CD + w_coarse coarse normals + w_normal refined normals; 100, 1, 1 in the paper.

    Normals count without their sign, min(|a - b|^2, |a + b|^2): coarse ones of the input points against the nearest
    target's, refined ones of each prediction against its nearest target's. Reads "coarse_normal" (B, n', 3) and
    "input" (B, n', 3+) from `extra`.

    Args:
        w_cd: weight of the Chamfer distance
        w_coarse: weight of the coarse normals
        w_normal: weight of the refined normals
    """

    def __init__(self, w_cd: float = 100.0, w_coarse: float = 1.0, w_normal: float = 1.0) -> None:
        super().__init__()
        self.weights = {"cd": w_cd, "coarse_normal": w_coarse, "normal": w_normal}

    def forward(
        self, prediction: Tensor, target: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        if not extra or "coarse_normal" not in extra or "input" not in extra:
            raise ValueError("loss: ParameterizationLoss needs a network that gives coarse_normal, such as model=pugeo")
        matches = search(prediction, target, 1)
        at_input = nearest(extra["input"][..., :3], target[..., :3]).idx
        terms = {
            "cd": chamfer(prediction, target, matches),
            "coarse_normal": unsigned_sq(extra["coarse_normal"], gather(target, at_input)[..., 3:6]).mean(),
            "normal": unsigned_sq(prediction[..., 3:6], gather(target, matches.nearest_target)[..., 3:6]).mean(),
        }
        return total(terms, self.weights)


def unsigned_sq(a: Tensor, b: Tensor) -> Tensor:
    """Squared difference of vectors (..., 3) up to the sign of one of them."""
    return torch.minimum((a - b).square().sum(-1), (a + b).square().sum(-1))


class PyramidLoss(nn.Module):
    """DensePCR: the Chamfer distance of every stage's points, 1 for the last and w_coarse for the one before.

    Reads "coarse" (B, m / 4, 3) from `extra`, if the network has two stages; the paper trains its stages one after
    the other and then together, here they are trained together from the start.

    Args:
        w_coarse: weight of the first stage's Chamfer distance, where there are two
    """

    def __init__(self, w_coarse: float = 1.0) -> None:
        super().__init__()
        self.weights = {"cd": 1.0, "cd_coarse": w_coarse}

    def forward(
        self, prediction: Tensor, target: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        terms = {"cd": chamfer(prediction, target, search(prediction, target, 1))}
        if extra and "coarse" in extra:
            terms["cd_coarse"] = chamfer(extra["coarse"], target, search(extra["coarse"], target, 1))
        return total(terms, self.weights)
