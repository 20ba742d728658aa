"""The released network and loss as a plain PyTorch port: the slow, obviously right peer of `pnu`.

Full distance matrices, `topk`, Python loops for farthest points and balls, channels first, features gathered before
they are multiplied. Parameters carry the names of the released checkpoints, so that a released state loads as it is.
"""

import itertools

import torch
from torch import Tensor, nn

RADII = (0.1, 0.2, 0.3, 0.4)
SAMPLES = 32
ABSTRACTIONS = ((6, 32, 32, 64), (67, 64, 64, 128), (131, 128, 128, 256), (259, 256, 256, 512))
PROPAGATIONS = ((768, 128, 256), (384, 128, 128), (192, 128, 128), (134, 128, 256))  # coarsest first


def distances(a: Tensor, b: Tensor) -> Tensor:
    """The full matrix (B, n, m) of distances of `a` (B, n, 3) to `b` (B, m, 3)."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def farthest_points(points: Tensor, m: int) -> Tensor:
    """Indices (B, m) of farthest points from point 0 on; points with |x|^2 <= 1e-3 are never picked."""
    batch = torch.arange(len(points), device=points.device)
    allowed = points.square().sum(-1) > 1e-3
    distance = torch.full(points.shape[:2], 1e10, device=points.device)
    picked = torch.zeros(len(points), m, dtype=torch.long, device=points.device)
    for i in range(1, m):
        last = points[batch, picked[:, i - 1]]
        distance = torch.minimum(distance, (points - last[:, None]).square().sum(-1))
        picked[:, i] = torch.where(allowed, distance, -1.0).argmax(-1)
    return picked


def ball_query(centers: Tensor, points: Tensor, radius: float, k: int) -> Tensor:
    """Indices (B, m, k) of the first k points in storage order with distance < radius, the first repeated if fewer."""
    idx = torch.zeros(*centers.shape[:2], k, dtype=torch.long, device=points.device)
    for b in range(len(centers)):
        for i in range(centers.shape[1]):
            inside = (centers[b, i] - points[b]).square().sum(-1) < radius**2
            found = inside.nonzero()[:k, 0]
            if len(found):
                idx[b, i] = found[0]
                idx[b, i, : len(found)] = found
    return idx


def gather(features: Tensor, idx: Tensor) -> Tensor:
    """Features (B, C, n) at idx (B, m, k), as (B, C, m, k)."""
    flat = idx.flatten(1)[:, None].expand(-1, features.shape[1], -1)
    return features.gather(2, flat).unflatten(2, idx.shape[1:])


class Convolution(nn.Module):
    """1x1 convolution without bias, batch norm, ReLU, on (B, C, m, k)."""

    def __init__(self, width_in: int, width_out: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(width_in, width_out, 1, bias=False)
        self.normlayer = nn.ModuleDict({"bn": nn.BatchNorm2d(width_out)})
        nn.init.kaiming_normal_(self.conv.weight)

    def forward(self, x: Tensor) -> Tensor:
        return self.normlayer["bn"](self.conv(x)).relu()


def convolutions(widths: tuple[int, ...]) -> nn.Sequential:
    mlp = nn.Sequential()
    for i, (width_in, width_out) in enumerate(itertools.pairwise(widths)):
        mlp.add_module(f"layer{i}", Convolution(width_in, width_out))
    return mlp


class Abstraction(nn.Module):
    """Set abstraction: farthest points, balls around them, shared MLP, max."""

    def __init__(self, widths: tuple[int, ...], radius: float) -> None:
        super().__init__()
        self.mlps = nn.ModuleList([convolutions(widths)])
        self.radius = radius

    def forward(self, points: Tensor, features: Tensor, m: int) -> tuple[Tensor, Tensor]:
        picked = farthest_points(points, m)
        centers = points.gather(1, picked[..., None].expand(-1, -1, 3))
        idx = ball_query(centers, points, self.radius, SAMPLES)
        offsets = gather(points.mT, idx) - centers.mT[..., None]
        grouped = torch.cat([offsets, gather(features, idx)], 1)
        return centers, self.mlps[0](grouped).max(-1).values


class Propagation(nn.Module):
    """Feature propagation: inverse distance interpolation of the 3 nearest, skip features, shared MLP."""

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.mlp = convolutions(widths)

    def forward(self, fine: Tensor, coarse: Tensor, skip: Tensor, features: Tensor) -> Tensor:
        distance, idx = distances(fine, coarse).topk(min(3, coarse.shape[1]), largest=False)
        weight = 1 / (distance + 1e-8)
        weight = weight / weight.sum(-1, keepdim=True)
        interpolated = (gather(features, idx) * weight[:, None]).sum(-1)
        return self.mlp(torch.cat([interpolated, skip], 1)[..., None]).squeeze(-1)


def unit(width_in: int, width_out: int) -> list[nn.Module]:
    return [nn.Conv1d(width_in, width_out, 1), nn.BatchNorm1d(width_out), nn.ReLU()]


class Double(nn.Module):
    """Moves half of the features (B, C, n) into new points: (B, C / 2, 2 n)."""

    def forward(self, x: Tensor) -> Tensor:
        return x.reshape(x.shape[0], x.shape[1] // 2, x.shape[2] * 2)


class PlainPNU(nn.Module):
    """The released network, x4: (B, n, 6) -> (B, 4 n, 6)."""

    def __init__(self) -> None:
        super().__init__()
        widths = (6, 32, 64, 64, 128, 256, 512)
        steps = [module for pair in itertools.pairwise(widths) for module in unit(*pair)]
        self.GLOBAL_module = nn.Sequential(*steps)
        self.SA_modules = nn.ModuleList(Abstraction(w, r) for w, r in zip(ABSTRACTIONS, RADII, strict=True))
        self.FP_modules = nn.ModuleList(Propagation(w) for w in PROPAGATIONS)
        self.UPSAMPLING_module = nn.Sequential(
            *unit(774, 512), *unit(512, 256), *unit(256, 128), Double(), *unit(64, 64), *unit(64, 32), Double(),
            *unit(16, 16), nn.Conv1d(16, 6, 1),
        )  # fmt: skip

    def forward(self, patch: Tensor) -> Tensor:
        x = patch.mT
        n = patch.shape[1]
        points, features = [patch[..., :3].contiguous()], [patch[..., 3:].mT]
        for level, abstraction in enumerate(self.SA_modules):
            centers, pooled = abstraction(points[-1], features[-1], n // 4**level)
            points.append(centers)
            features.append(pooled)
        features[0] = x
        local = features.pop()
        for level, propagation in zip((3, 2, 1, 0), self.FP_modules, strict=True):
            local = propagation(points[level], points[level + 1], features[level], local)
        global_ = self.GLOBAL_module(x).max(-1, keepdim=True).values.expand(-1, -1, n)
        return self.UPSAMPLING_module(torch.cat([x, local, global_], 1)).mT


class PlainLoss(nn.Module):
    """The released compound loss by full distance matrices."""

    def __init__(self, weights: tuple[float, ...] = (1.0, 0.1, 0.05, 1e-4, 1e-4), k: int = 15) -> None:
        super().__init__()
        self.weights, self.k = weights, k

    def forward(self, prediction: Tensor, target: Tensor) -> dict[str, Tensor]:
        points, normals = prediction[..., :3].mT, prediction[..., 3:].mT  # (B, 3, m)
        true_points, true_normals = target[..., :3].mT, target[..., 3:].mT
        with torch.no_grad():
            matrix = distances(target[..., :3], prediction[..., :3])
            to_prediction, to_target = matrix.argmin(2), matrix.argmin(1)
            idx = distances(prediction[..., :3], prediction[..., :3]).topk(self.k + 1, largest=False).indices[..., 1:]

        def nearest(values: Tensor, idx: Tensor) -> Tensor:
            return gather(values, idx[..., None])[..., 0]

        to_target_sq = (points - nearest(true_points, to_target)).square().sum(1)
        to_prediction_sq = (true_points - nearest(points, to_prediction)).square().sum(1)
        offsets = points[..., None] - gather(points, idx)  # (B, 3, m, k)
        cosine = torch.cosine_similarity(offsets, normals[..., None].expand_as(offsets), dim=1)
        terms = {
            "cd": to_target_sq.mean() + to_prediction_sq.mean(),
            "point_knn": offsets.square().sum(1).mean(),
            "normal": (true_normals - nearest(normals, to_prediction)).square().sum(1).mean(),
            "normal_orth": cosine.abs().mean(),
            "normal_knn": (normals[..., None] - gather(normals, idx)).square().sum(1).mean(),
        }
        return {**terms, "loss": torch.stack([w * v for w, v in zip(self.weights, terms.values(), strict=True)]).sum()}
