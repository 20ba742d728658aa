"""The paper's compound loss: one function a term, and their weighted sum.

Clouds are `prediction` (B, m, 6) and `target` (B, n, 6), columns xyz and normal; predicted normals need not have unit
length. Terms are unweighted scalars. `reduction="mean"` (released code) averages over points and neighbors,
`"sum"` (the paper's equations) adds them up in each cloud; both average over the batch. Distances are squared and in
the clouds' units. Which point is near which is found once, without gradient, and shared by all terms (`search`).
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnu.geometry.assignment import assign
from pnu.geometry.neighbor_features import gather
from pnu.geometry.neighbor_search import knn, nearest

Reduction = Literal["mean", "sum"]
ORDER = ("cd", "emd", "point_knn", "normal", "normal_orth", "normal_knn")
TINY = 1e-16  # squared length below which a direction counts as none


class Matches(NamedTuple):
    """Who is near whom, as indices."""

    nearest_target: Tensor  # (B, m): target nearest_target[b, i] is the nearest of prediction i
    nearest_prediction: Tensor  # (B, n): prediction nearest_prediction[b, j] is the nearest of target j
    neighbors: Tensor  # (B, m, k): prediction neighbors[b, i, j] is the j-th nearest of prediction i, itself excluded


def search(prediction: Tensor, target: Tensor, k: int, *, released_rounding: bool = True) -> Matches:
    """Nearest points of clouds (B, m, 3+) and (B, n, 3+), and the k neighbors of each predicted point.

    With `released_rounding`, near-ties of the nearest prediction are decided as in the released code.

    Raises:
        ValueError: the prediction has no k + 1 points.
    """
    a, b = prediction[..., :3].detach(), target[..., :3].detach()
    if not 1 <= k < a.shape[1]:
        raise ValueError(f"loss.k: expected 1 to {a.shape[1] - 1} (predicted points - 1), found {k}")
    nearest_prediction = _released_nearest(b, a) if released_rounding else nearest(b, a).idx
    return Matches(nearest(a, b).idx, nearest_prediction, knn(a, a, k + 1).idx[..., 1:])


def _released_nearest(query: Tensor, target: Tensor) -> Tensor:
    """Nearest target of each query (B, m), near-ties decided by the rounding of the released code.

    It takes the smallest of (q.q + t.t) - 2 q.t in float32, whose error (1e-7 in the unit sphere) swaps a nearest with
    a second nearest that is as close, about once in 8000 points; the products accumulate with fused multiply-add.
    """
    idx = knn(query, target, 2).idx
    q, t = query.float()[:, :, None].double(), gather(target, idx).float().double()

    def dot(a: Tensor, b: Tensor) -> Tensor:
        total = (a[..., 0] * b[..., 0]).float()
        for axis in (1, 2):
            total = (a[..., axis] * b[..., axis] + total).float()
        return total

    dist_sq = (dot(q, q) + dot(t, t)) - 2 * dot(q, t)
    return torch.where(dist_sq[..., 1] < dist_sq[..., 0], idx[..., 1], idx[..., 0])


def _reduce(values: Tensor, reduction: Reduction) -> Tensor:
    """Values (B, ...) to a scalar: mean over all, or sums over each cloud averaged over the batch."""
    return values.mean() if reduction == "mean" else values.sum() / values.shape[0]


def chamfer(prediction: Tensor, target: Tensor, matches: Matches, reduction: Reduction = "mean") -> Tensor:
    """Eq. 1: squared distance of each prediction to the nearest target, plus that of each target to the nearest
    prediction. Paper: sums; released: means."""
    a, b = prediction[..., :3], target[..., :3]
    to_target = (a - gather(b, matches.nearest_target)).square().sum(-1)
    to_prediction = (b - gather(a, matches.nearest_prediction)).square().sum(-1)
    return _reduce(to_target, reduction) + _reduce(to_prediction, reduction)


def emd(prediction: Tensor, target: Tensor, reduction: Reduction = "mean") -> Tensor:
    """Eq. 2: distance of each prediction to the target that a nearly shortest one-to-one matching gives it.

    The matching is found by auction (`pnu.geometry.assignment.assign`): 2 % too long where the clouds are near, 9 % for
    unrelated ones. It costs 0.3 to 0.6 s for each cloud of 4096 points on one CPU thread, many times the other terms
    together.
    """
    a, b = prediction[..., :3], target[..., :3]
    offsets = a - gather(b, assign(a, b))
    return _reduce(offsets.square().sum(-1).clamp_min(TINY).sqrt(), reduction)


def point_knn(prediction: Tensor, around: Tensor, reduction: Reduction = "mean") -> Tensor:
    """Eq. 3: squared distances of each prediction (B, m, 3+) to its k neighbors `around` (B, m, k, 3+).

    The released code, and the paper's text and Fig. 3, take the neighbors in the prediction; its formula says in the
    ground truth.
    """
    return _reduce((prediction[:, :, None, :3] - around[..., :3]).square().sum(-1), reduction)


def normal(prediction: Tensor, target: Tensor, matches: Matches, reduction: Reduction = "mean",
           direction: Literal["target", "prediction"] = "target") -> Tensor:  # fmt: skip
    """Eq. 4: squared difference of predicted and true normals.

    direction "target" (released): each target with its nearest prediction; "prediction": each prediction with its
    nearest target. The paper leaves the pairing open.
    """
    if direction == "target":
        difference = target[..., 3:6] - gather(prediction[..., 3:6], matches.nearest_prediction)
    else:
        difference = prediction[..., 3:6] - gather(target[..., 3:6], matches.nearest_target)
    return _reduce(difference.square().sum(-1), reduction)


def normal_orth(prediction: Tensor, around: Tensor, reduction: Reduction = "mean", absolute: bool = True) -> Tensor:
    """Eq. 5: cosine between p - neighbor and the normal at p, for k predicted neighbors `around` (B, m, k, 6).

    Released: its absolute value; paper: signed. Coincident points and zero normals count as orthogonal.
    """
    offsets = prediction[:, :, None, :3] - around[..., :3]
    normals = prediction[:, :, None, 3:6]
    length_sq = offsets.square().sum(-1).clamp_min(TINY) * normals.square().sum(-1).clamp_min(TINY)
    cosine = (offsets * normals).sum(-1) * length_sq.rsqrt()
    return _reduce(cosine.abs() if absolute else cosine, reduction)


def normal_knn(prediction: Tensor, around: Tensor, reduction: Reduction = "mean") -> Tensor:
    """Eq. 6: squared difference of each predicted normal to those of its k predicted neighbors (B, m, k, 6)."""
    return _reduce((prediction[:, :, None, 3:6] - around[..., 3:6]).square().sum(-1), reduction)


class CompoundLoss(nn.Module):
    """w1 CD + w2 point_knn + w3 normal + w4 normal_orth + w5 normal_knn (Eq. 7).

    Defaults are the released code's, and the weights are the paper's. Every term is computed at every step, whatever
    its weight.

    Args:
        w1: weight of the point term: Chamfer distance (Eq. 1), or EMD (Eq. 2)
        w2: weight of point_knn: neighbors close (Eq. 3)
        w3: weight of normal: predicted against true normals (Eq. 4)
        w4: weight of normal_orth: normals orthogonal to the surface (Eq. 5)
        w5: weight of normal_knn: normals of neighbors alike (Eq. 6)
        k: neighbors of the three neighborhood terms
        reduction: mean over points and neighbors (released code), or sum over them (the paper's equations)
        point_term: what w1 weighs: chamfer, or emd (the paper defines it; many times slower); cd is reported too
        point_knn_in: where its neighbors are: prediction (released code; the paper's text, Fig. 3) or target (Eq. 3)
        normal_pairs: target: each with its nearest prediction (released code); prediction: the other way
        orth: cosine of normal_orth: absolute (released code) or signed (Eq. 5)
        unit_normals: normalize predicted normals before the loss; the released code does not
        near_ties: of the nearest prediction: released (its rounding decides) or exact
    """

    def __init__(
        self,
        w1: float = 1.0,
        w2: float = 0.1,
        w3: float = 0.05,
        w4: float = 1e-4,
        w5: float = 1e-4,
        k: int = 15,
        reduction: Literal["mean", "sum"] = "mean",
        point_term: Literal["chamfer", "emd"] = "chamfer",
        point_knn_in: Literal["prediction", "target"] = "prediction",
        normal_pairs: Literal["target", "prediction"] = "target",
        orth: Literal["absolute", "signed"] = "absolute",
        unit_normals: bool = False,
        near_ties: Literal["released", "exact"] = "released",
    ) -> None:
        super().__init__()
        _check("reduction", reduction, "mean", "sum")
        _check("point_term", point_term, "chamfer", "emd")
        _check("point_knn_in", point_knn_in, "prediction", "target")
        _check("normal_pairs", normal_pairs, "target", "prediction")
        _check("orth", orth, "absolute", "signed")
        _check("near_ties", near_ties, "released", "exact")
        if k < 1:
            raise ValueError(f"loss.k: expected at least 1 neighbor, found {k}")
        point = "cd" if point_term == "chamfer" else "emd"
        self.weights = {point: w1, "point_knn": w2, "normal": w3, "normal_orth": w4, "normal_knn": w5}
        self.k, self.reduction, self.point_knn_in, self.normal_pairs = k, reduction, point_knn_in, normal_pairs
        self.absolute, self.unit_normals, self.released_rounding = (
            orth == "absolute",
            unit_normals,
            near_ties == "released",
        )

    def forward(self, prediction: Tensor, target: Tensor, extra: Mapping[str, Any] | None = None) -> dict[str, Tensor]:
        """Clouds (B, m, 6) and (B, n, 6) -> every term, unweighted, and "loss", their weighted sum.

        A prediction of 3 columns has no normal terms. `extra`: other outputs of the network and tensors of the batch,
        not used here. ValueError if a cloud has no k + 1 points, or for EMD if m is not n.
        """
        if self.unit_normals and prediction.shape[-1] >= 6:
            prediction = torch.cat([prediction[..., :3], F.normalize(prediction[..., 3:6], dim=-1)], -1)
        matches = search(prediction, target, self.k, released_rounding=self.released_rounding)
        terms = {
            "cd": chamfer(prediction, target, matches, self.reduction),
            **self.neighborhood_terms(prediction, matches.neighbors),
        }
        if self.point_knn_in == "target":
            close = gather(target, knn(prediction[..., :3], target[..., :3], self.k).idx)
            terms["point_knn"] = point_knn(prediction, close, self.reduction)
        if "emd" in self.weights:
            terms["emd"] = emd(prediction, target, self.reduction)
        if prediction.shape[-1] >= 6:
            terms["normal"] = normal(prediction, target, matches, self.reduction, self.normal_pairs)
        terms = {name: terms[name] for name in ORDER if name in terms}
        weighted = [weight * terms[name] for name, weight in self.weights.items() if weight and name in terms]
        return {**terms, "loss": torch.stack(weighted).sum() if weighted else 0 * terms["cd"]}

    def neighborhood_terms(self, prediction: Tensor, neighbors: Tensor) -> dict[str, Tensor]:
        """point_knn, and with normals normal_orth and normal_knn, of the neighbors (B, m, k) of each prediction."""
        around = gather(prediction, neighbors)
        terms = {"point_knn": point_knn(prediction, around, self.reduction)}
        if prediction.shape[-1] >= 6:
            terms["normal_orth"] = normal_orth(prediction, around, self.reduction, self.absolute)
            terms["normal_knn"] = normal_knn(prediction, around, self.reduction)
        return terms


def _check(name: str, value: str, *choices: str) -> None:
    if value not in choices:
        raise ValueError(f"loss.{name}: expected one of {', '.join(choices)}, found {value!r}")
