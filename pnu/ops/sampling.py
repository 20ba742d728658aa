"""Choose some points of a cloud."""

import fpsample
import numpy as np
import torch
from torch import Tensor

from pnu.ops.nearest import per_cloud

NEAR_ORIGIN_SQ = 1e-3  # the released code's threshold on |x|^2


def farthest_points(points: Tensor, m: int, *, start: int = 0, skip_near_origin: bool = False) -> Tensor:
    """Greedy farthest point sampling: from `start` on, always the point farthest from all chosen before.

    points (B, n, 3) -> idx (B, m) int64, all different. With `skip_near_origin`, points with |x|^2 <= 1e-3 are chosen
    only as the start (released code); when the others run out the first of them is repeated. ValueError if m > n.
    """
    clouds, n, _ = points.shape
    if not 1 <= m <= n:
        raise ValueError(f"m: expected 1 to {n} points (the size of the cloud), found {m}")
    if not 0 <= start < n:
        raise ValueError(f"start: expected an index in 0..{n - 1}, found {start}")
    points = points.detach()
    if points.device.type == "cpu":
        xyz = points.float().numpy()
        out = np.empty((clouds, m), np.int64)

        def sample(b: int) -> None:
            out[b] = _farthest(xyz[b], m, start, skip_near_origin)

        per_cloud(sample, clouds)
        return torch.from_numpy(out)
    return _farthest_steps(points, m, start, skip_near_origin)


def _farthest(xyz: np.ndarray, m: int, start: int, skip_near_origin: bool) -> np.ndarray:
    if skip_near_origin:
        allowed = (xyz**2).sum(1) > NEAR_ORIGIN_SQ
        refill = int(allowed.argmax())
        allowed[start] = True
        index = np.flatnonzero(allowed)
        chosen = index[_greedy(xyz[index], min(m, len(index)), int(np.searchsorted(index, start)))]
        return np.concatenate([chosen, np.full(m - len(chosen), refill)])
    return _greedy(xyz, m, start)


def _greedy(xyz: np.ndarray, m: int, start: int) -> np.ndarray:
    return fpsample.fps_sampling(xyz, m, start).astype(np.int64)


def _farthest_steps(points: Tensor, m: int, start: int, skip_near_origin: bool) -> Tensor:
    clouds, n, _ = points.shape
    row = torch.arange(clouds, device=points.device)
    current = torch.full((clouds,), start, device=points.device)
    dist_sq = points.new_full((clouds, n), torch.inf)
    if skip_near_origin:
        dist_sq[points.square().sum(-1) <= NEAR_ORIGIN_SQ] = -1
    out = torch.empty(clouds, m, dtype=torch.int64, device=points.device)
    for i in range(m):
        out[:, i] = current
        step = (points - points[row, current][:, None]).square_().sum(-1)
        torch.minimum(dist_sq, step, out=dist_sq)
        if not skip_near_origin:
            dist_sq[row, current] = -1
        current = dist_sq.argmax(1)
    return out


def farthest_points_large(points: np.ndarray | Tensor, m: int) -> np.ndarray:
    """Farthest point sampling of one whole cloud (n, 3) -> idx (m,) int64, all different; starts anywhere."""
    xyz = np.ascontiguousarray(np.asarray(points), np.float32)
    if not 1 <= m <= len(xyz):
        raise ValueError(f"m: expected 1 to {len(xyz)} points (the size of the cloud), found {m}")
    height = max(1, min(7, int(np.log2(max(len(xyz), 2)))))
    if len(xyz) == 1:
        return np.zeros(1, np.int64)
    return fpsample.bucket_fps_kdline_sampling(xyz, m, height, 0).astype(np.int64)
