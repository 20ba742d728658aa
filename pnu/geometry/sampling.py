"""Choose some points of a cloud: evenly, at random, or unevenly on purpose."""

import numpy as np
import torch
from torch import Tensor

from pnu.geometry.farthest_sampling import check_count, farthest_order
from pnu.geometry.neighbor_search import gpu_kernels, per_cloud

NEAR_ORIGIN_SQ = 1e-3  # the released code's threshold on |x|^2


def farthest_points(points: Tensor, m: int, *, start: int | Tensor = 0, skip_near_origin: bool = False) -> Tensor:
    """Greedy farthest point sampling: from `start` on, always the point farthest from all chosen before.

    points (B, n, 3), start one index or (B,) -> idx (B, m) int64 in the order of choice, all different; computed in
    float32, of equal distances the lowest index. With `skip_near_origin` (released code) points with |x|^2 <= 1e-3 are
    chosen as the start only, and when the others run out the first of them is repeated. ValueError if m is not in 1..n.
    """
    clouds, n, _ = points.shape
    check_count(m, n)
    first = torch.as_tensor(start).cpu().expand(clouds)
    if bool(((first < 0) | (first >= n)).any()):
        raise ValueError(f"start: expected indices in 0..{n - 1}, found {start}")
    xyz = _float32(points.detach())
    if points.device.type != "cpu":
        # a number is written on the device itself: a copy would wait for all that it has to do
        first = (
            torch.full((clouds,), start, device=points.device) if isinstance(start, int) else first.to(points.device)
        )
        kernels = gpu_kernels(xyz)
        if kernels and n <= kernels.FARTHEST_LIMIT:
            idx: Tensor = kernels.farthest_points(xyz, m, first, NEAR_ORIGIN_SQ if skip_near_origin else -1.0)
            return idx
        return _farthest_steps(xyz, m, first, skip_near_origin)
    arrays, starts, out = xyz.numpy(), first.tolist(), np.empty((clouds, m), np.int64)

    def sample(b: int) -> None:
        choose = _farthest_off_origin if skip_near_origin else farthest_order
        out[b] = choose(arrays[b], m, starts[b])

    per_cloud(sample, clouds)
    return torch.from_numpy(out)


def random_points(points: Tensor, m: int, *, generator: torch.Generator) -> Tensor:
    """Uniform draw without replacement: points (B, n, 3) -> idx (B, m) int64. ValueError if m is not in 1..n."""
    clouds, n, _ = points.shape
    check_count(m, n)
    noise = torch.rand(clouds, n, generator=generator, device=generator.device)
    return noise.topk(m, dim=1).indices.to(points.device)


def nonuniform_points(points: Tensor, m: int, *, strength: float, centers: int, generator: torch.Generator) -> Tensor:
    """Draw without replacement, dense around random centers and ever thinner away from them.

    points (B, n, 3) -> idx (B, m) int64 in the order of the draws. `centers` of a cloud's own points are chosen at
    random; a point's weight is exp(-strength d), where d is the distance to the nearest of them as a fraction of the
    greatest such distance: `strength` is the logarithm of how much denser the centers are, 0 a uniform draw.
    Successive weighted draws are the m largest of log weight + Gumbel noise (Efraimidis and Spirakis 2006).
    ValueError if m or centers is not in 1..n, or strength is negative.
    """
    clouds, n, _ = points.shape
    check_count(m, n)
    if not strength >= 0:
        raise ValueError(f"strength: expected a number >= 0, found {strength}")
    if not 1 <= centers <= n:
        raise ValueError(f"centers: expected 1 to {n} centers, found {centers}")
    chosen = random_points(points, centers, generator=generator)
    distance = points.new_full((clouds, n), torch.inf)
    for center in points.gather(1, chosen[..., None].expand(-1, -1, 3)).unbind(1):  # few: no search is worth it
        distance = torch.minimum(distance, torch.linalg.vector_norm(points - center[:, None], dim=-1))
    fraction = distance / distance.amax(1, keepdim=True).clamp_min(torch.finfo(distance.dtype).tiny)
    noise = torch.empty(clouds, n, device=generator.device).exponential_(generator=generator)
    return (-strength * fraction - noise.to(points.device).log()).topk(m, dim=1).indices


def poisson_disk_points(points: Tensor, m: int, *, generator: torch.Generator) -> Tensor:
    """Evenly spread subset, exactly m: `farthest_points` from a random start. points (B, n, 3) -> idx (B, m) int64."""
    start = torch.randint(points.shape[1], (len(points),), generator=generator, device=generator.device)
    return farthest_points(points, m, start=start)


def _float32(points: Tensor) -> Tensor:
    if points.dtype == torch.float64:  # map coordinates, say, lose their detail in float32
        points = points - points.mean(1, keepdim=True)
    return points.float().contiguous()


def _farthest_off_origin(xyz: np.ndarray, m: int, start: int) -> np.ndarray:
    allowed = (xyz**2).sum(1) > NEAR_ORIGIN_SQ
    refill = int(allowed.argmax())
    allowed[start] = True
    index = np.flatnonzero(allowed)
    chosen = index[farthest_order(xyz[index], min(m, len(index)), int(np.searchsorted(index, start)))]
    return np.concatenate([chosen, np.full(m - len(chosen), refill)])


def _farthest_steps(points: Tensor, m: int, start: Tensor, skip_near_origin: bool) -> Tensor:
    clouds, n, _ = points.shape
    row = torch.arange(clouds, device=points.device)
    dist_sq = points.new_full((clouds, n), torch.inf)
    eligible = points.square().sum(-1) > (NEAR_ORIGIN_SQ if skip_near_origin else -1)
    dist_sq[~eligible] = -2
    current = start
    out = torch.empty(clouds, m, dtype=torch.int64, device=points.device)
    for i in range(m):
        out[:, i] = current
        step = (points - points[row, current][:, None]).square_().sum(-1)
        torch.minimum(dist_sq, step, out=dist_sq)
        dist_sq[row, current] = torch.where(eligible[row, current], -1.0, -2.0)
        current = dist_sq.argmax(1)
    return out
