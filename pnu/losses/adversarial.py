"""PU-GAN's loss: a discriminator's verdict, evenness, reconstruction and repulsion."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from pnu.geometry.neighbor_features import gather
from pnu.geometry.neighbor_search import knn
from pnu.geometry.sampling import farthest_points
from pnu.losses.compound import chamfer, emd, search
from pnu.losses.rivals import DENSE, total
from pnu.networks.pugan import Discriminator

SHARES = (0.004, 0.006, 0.008, 0.010, 0.012)  # of the unit disk, those of the paper


class AdversarialLoss(nn.Module):
    """Generator: w_adversarial (D(Q) - 1)^2 / 2 + w_uniform uniform + w_reconstruction (EMD or CD) + w_repulsion
    repulsion. The discriminator, which is trained beside it, has (D(Q)^2 + (D(truth) - 1)^2) / 2.

    Weights and terms are the paper's and its code's; repulsion is PU-Net's.

    Args:
        point_term: emd, the paper's, by auction; or chamfer, many times faster
        w_adversarial: weight of the discriminator's verdict
        w_uniform: weight of the evenness in disks
        w_reconstruction: weight of the point term
        w_repulsion: weight of PU-Net's repulsion
        discriminator_lr: learning rate of the discriminator, as a share of the generator's
        seeds: disks of each size in a cloud
        h: squared reach of the repulsion, in the unit sphere, for 4096 target points; for n it is h 4096 / n
        k: neighbors that repel a point

    Source: Li et al., "PU-GAN: a Point Cloud Upsampling Adversarial Network", ICCV 2019, section 3.5.
    """

    def __init__(
        self,
        point_term: Literal["emd", "chamfer"] = "emd",
        w_adversarial: float = 0.5,
        w_uniform: float = 10.0,
        w_reconstruction: float = 100.0,
        w_repulsion: float = 1.0,
        discriminator_lr: float = 0.1,
        seeds: int = 50,
        h: float = 5e-4,
        k: int = 5,
    ) -> None:
        super().__init__()
        if point_term not in ("emd", "chamfer"):
            raise ValueError(f"loss.point_term: expected emd or chamfer, found {point_term!r}")
        if not discriminator_lr > 0:
            raise ValueError(f"loss.discriminator_lr={discriminator_lr}: expected a number > 0")
        self.point_term, self.discriminator_lr, self.seeds, self.h, self.k = point_term, discriminator_lr, seeds, h, k
        self.weights = {
            "adversarial": w_adversarial, "uniform": w_uniform, "repulsion": w_repulsion,
            "emd": w_reconstruction, "cd": w_reconstruction,
        }  # fmt: skip
        self.discriminator = Discriminator()

    def forward(
        self, prediction: Tensor, target: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """The generator's terms, unweighted, and "loss", their weighted sum."""
        matches = search(prediction, target, self.k)
        points = prediction[..., :3]
        dist_sq = (points[:, :, None] - gather(points, matches.neighbors)).square().sum(-1)
        h = self.h * DENSE / target.shape[1]
        terms = {
            "adversarial": (self.discriminator(points) - 1).square().mean() / 2,
            "uniform": unevenness(points, self.seeds),
            "repulsion": -(dist_sq.clamp_min(1e-12).sqrt() * torch.exp(-dist_sq / h)).mean(),
        }
        if self.point_term == "emd":
            terms["emd"] = emd(prediction, target)
        else:
            terms["cd"] = chamfer(prediction, target, matches)
        return total(terms, self.weights)

    def verdict(self, prediction: Tensor, target: Tensor) -> Tensor:
        """The discriminator's loss, a scalar, of predicted and true points."""
        made, true = self.discriminator(prediction[..., :3].detach()), self.discriminator(target[..., :3])
        loss: Tensor = (made.square().mean() + (true - 1).square().mean()) / 2
        return loss


def unevenness(points: Tensor, seeds: int = 50, shares: Sequence[float] = SHARES) -> Tensor:
    """PU-GAN's uniform term of clouds (B, m, 3) in the unit sphere, a scalar: imbalance times clutter in disks.

    For each share p a disk has radius sqrt(p), around `seeds` farthest points. With n points in a disk, m p expected:
    imbalance (n - m p)^2 / (m p). With d the distance of each to the nearest other in the disk, and
    e = sqrt(2 pi p / (n sqrt 3)) that of a hexagonal lattice: clutter, the sum of (d - e)^2 / e. Their product is
    averaged over disks and shares. A disk with one point has no clutter.
    """
    count = points.shape[1]
    centers = gather(points, farthest_points(points.detach(), min(seeds, count)))
    values = []
    for share in shares:
        radius, expected = math.sqrt(share), count * share
        k = min(count, max(4, math.ceil(4 * expected)))
        near = knn(centers, points, k)
        inside = near.dist_sq <= share
        found = inside.sum(-1)
        members = gather(points, near.idx)  # (B, seeds, k, 3)
        apart_sq = (members[:, :, :, None] - members[:, :, None]).square().sum(-1)
        pair = inside[..., None] & inside[..., None, :] & ~torch.eye(k, dtype=torch.bool, device=points.device)
        nearest = apart_sq.masked_fill(~pair, math.inf).amin(-1)
        counts = inside & (found > 1)[..., None]
        distance = torch.where(counts, nearest, 1.0).clamp_min(1e-12).sqrt()
        lattice = torch.sqrt(2 * math.pi * radius**2 / (found.clamp_min(1) * math.sqrt(3)))[..., None].to(points)
        clutter = torch.where(counts, (distance - lattice).square() / lattice, 0.0).sum(-1)
        values.append(((found.to(points) - expected).square() / expected * clutter).mean())
    return torch.stack(values).mean()
