"""The paper's compound loss: one function a term, and their weighted sum.

Clouds are `prediction` (B, m, 6) and `target` (B, n, 6), columns xyz and normal; predicted normals need not have unit
length. Terms are unweighted scalars. `reduction="mean"` (released code) averages over points and neighbours,
`"sum"` (the paper's equations) adds them up in each cloud; both average over the batch. Distances are squared and in
the clouds' units. Which point is near which is found once, without gradient, and shared by all terms (`search`).
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from pnu.ops.grouping import gather
from pnu.ops.nearest import knn, nearest

Reduction = Literal["mean", "sum"]
TINY = 1e-16  # squared length below which a direction counts as none


class Matches(NamedTuple):
    """Who is near whom, as indices."""

    nearest_target: Tensor  # (B, m): target nearest_target[b, i] is the nearest of prediction i
    nearest_prediction: Tensor  # (B, n): prediction nearest_prediction[b, j] is the nearest of target j
    neighbors: Tensor  # (B, m, k): prediction neighbors[b, i, j] is the j-th nearest of prediction i, itself excluded


def search(prediction: Tensor, target: Tensor, k: int, *, released_rounding: bool = True) -> Matches:
    """Nearest points of clouds (B, m, 3+) and (B, n, 3+), and the k neighbours of each predicted point.

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


def point_knn(prediction: Tensor, around: Tensor, reduction: Reduction = "mean") -> Tensor:
    """Eq. 3: squared distances of each prediction (B, m, 3+) to its k neighbours `around` (B, m, k, 3+).

    The released code, and the paper's text and Fig. 3, take the neighbours in the prediction; its formula says in the
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
    """Eq. 5: cosine between p - neighbour and the normal at p, for k predicted neighbours `around` (B, m, k, 6).

    Released: its absolute value; paper: signed. Coincident points and zero normals count as orthogonal.
    """
    offsets = prediction[:, :, None, :3] - around[..., :3]
    normals = prediction[:, :, None, 3:6]
    length_sq = offsets.square().sum(-1).clamp_min(TINY) * normals.square().sum(-1).clamp_min(TINY)
    cosine = (offsets * normals).sum(-1) * length_sq.rsqrt()
    return _reduce(cosine.abs() if absolute else cosine, reduction)


def normal_knn(prediction: Tensor, around: Tensor, reduction: Reduction = "mean") -> Tensor:
    """Eq. 6: squared difference of each predicted normal to those of its k predicted neighbours (B, m, k, 6)."""
    return _reduce((prediction[:, :, None, 3:6] - around[..., 3:6]).square().sum(-1), reduction)


class CompoundLoss(nn.Module):
    """w1 CD + w2 point_knn + w3 normal + w4 normal_orth + w5 normal_knn (Eq. 8), k neighbours.

    Defaults are the released code's; the comments in `conf/loss/compound.yaml` name the paper's alternatives.
    """

    def __init__(
        self,
        w1: float = 1.0,
        w2: float = 0.1,
        w3: float = 0.05,
        w4: float = 1e-4,
        w5: float = 1e-4,
        k: int = 15,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        self.weights = {"cd": w1, "point_knn": w2, "normal": w3, "normal_orth": w4, "normal_knn": w5}
        self.k, self.reduction = k, reduction

    def forward(
        self, prediction: Tensor, target: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Clouds (B, m, 6) and (B, n, 6) -> every term, unweighted, and "loss", their weighted sum.

        A prediction of 3 columns has no normal terms. `extra`: other outputs of the network, not used here.
        """
        matches = search(prediction, target, self.k)
        around = gather(prediction, matches.neighbors)
        terms = {
            "cd": chamfer(prediction, target, matches, self.reduction),
            "point_knn": point_knn(prediction, around, self.reduction),
        }
        if prediction.shape[-1] >= 6:
            terms["normal"] = normal(prediction, target, matches, self.reduction)
            terms["normal_orth"] = normal_orth(prediction, around, self.reduction)
            terms["normal_knn"] = normal_knn(prediction, around, self.reduction)
        total = torch.stack([self.weights[name] * value for name, value in terms.items()]).sum()
        return {**terms, "loss": total}
