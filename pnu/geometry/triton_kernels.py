"""GPU searches as Triton kernels: distances live in registers and never as a matrix in memory.

Imported only where Triton is there (it comes with torch's CUDA builds); `neighbor_search` and `sampling` call these for
CUDA tensors. With TRITON_INTERPRET=1 they run on the CPU, slowly, which is how the tests check them
without a GPU.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

if not hasattr(tl, "topk"):
    raise ImportError("Triton 3.3 or later is needed: this one lacks topk")

# A candidate is one int64: the bits of its squared distance (whose order is that of non-negative floats), then its
# index. Its smallest values are the nearest points, the lower index first among equals.
NO_CANDIDATE = tl.constexpr(0x7FFFFFFFFFFFFFFF)
INDEX_BITS = tl.constexpr(32)
INDEX_MASK = tl.constexpr(0xFFFFFFFF)


@triton.jit
def _distance_sq(query, rows, m, target, columns, n):
    """(rows, columns) squared distances; rows and columns beyond the clouds read as zero."""
    total = tl.zeros((rows.shape[0], columns.shape[0]), tl.float32)
    for axis in tl.static_range(3):
        q = tl.load(query + rows * 3 + axis, rows < m, 0.0)
        t = tl.load(target + columns * 3 + axis, columns < n, 0.0)
        difference = q[:, None] - t[None, :]
        total += difference * difference
    return total


@triton.jit
def _candidates(query, rows, m, target, columns, n):
    distance = _distance_sq(query, rows, m, target, columns, n)
    key = (distance.to(tl.int32, bitcast=True).to(tl.int64) << INDEX_BITS) | columns[None, :].to(tl.int64)
    return tl.where(columns[None, :] < n, key, NO_CANDIDATE)


@triton.jit
def _knn(query, target, dist_sq, idx, m, n, k, K: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    cloud = tl.program_id(1).to(tl.int64)
    query, target = query + cloud * m * 3, target + cloud * n * 3
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    best = tl.full((ROWS, K), NO_CANDIDATE, tl.int64)
    for start in range(0, n, COLUMNS):
        keys = _candidates(query, rows, m, target, start + tl.arange(0, COLUMNS), n)
        if K == 1:
            best = tl.minimum(best, tl.min(keys, axis=1)[:, None])
        else:
            # topk keeps the largest, so everything is negated
            nearest = -tl.topk(-keys, K)
            both = tl.reshape(tl.join(best, nearest), (ROWS, 2 * K))
            best = -tl.topk(-both, K)
    slots = tl.arange(0, K)
    out = cloud * m * k + rows[:, None] * k + slots[None, :]
    kept = (rows[:, None] < m) & (slots[None, :] < k)
    tl.store(dist_sq + out, (best >> INDEX_BITS).to(tl.int32).to(tl.float32, bitcast=True), kept)
    tl.store(idx + out, best & INDEX_MASK, kept)


def knn(query: Tensor, target: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """dist_sq (B, m, k) float32 and idx (B, m, k) int64 of the k nearest targets, ascending; 1 <= k <= n.

    query (B, m, 3), target (B, n, 3). Work O(B m n), memory O(B m k).
    """
    query, target = query.float().contiguous(), target.float().contiguous()
    (batch, m, _), n = query.shape, target.shape[1]
    dist_sq = torch.empty(batch, m, k, device=query.device)
    idx = torch.empty(batch, m, k, dtype=torch.int64, device=query.device)
    slots = triton.next_power_of_2(k)
    rows, columns = knn_block(slots)
    _knn[(triton.cdiv(m, rows), batch)](query, target, dist_sq, idx, m, n, k, slots, rows, columns)
    return dist_sq, idx


def knn_block(slots: int) -> tuple[int, int]:
    """Queries and targets that a program of `_knn` holds at once, for so many neighbors (a power of two)."""
    return (64, 128) if slots == 1 else (16, max(64, slots))


@triton.jit
def _ball(query, target, idx, m, n, k, radius, K: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    cloud = tl.program_id(1).to(tl.int64)
    query, target = query + cloud * m * 3, target + cloud * n * 3
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    idx += cloud * m * k + rows[:, None] * k
    found = tl.zeros((ROWS,), tl.int32)
    first = tl.full((ROWS,), n, tl.int32)
    for start in range(0, n, COLUMNS):
        columns = start + tl.arange(0, COLUMNS)
        distance = tl.sqrt(_distance_sq(query, rows, m, target, columns, n))
        inside = (distance < radius) & (columns[None, :] < n) & (rows[:, None] < m)
        first = tl.minimum(first, tl.min(tl.where(inside, columns[None, :], n), axis=1))
        place = found[:, None] + tl.cumsum(inside.to(tl.int32), axis=1) - 1
        value = tl.broadcast_to(columns[None, :], (ROWS, COLUMNS)).to(tl.int64)
        tl.store(idx + place, value, inside & (place < k))
        found += tl.sum(inside.to(tl.int32), axis=1)
    slots = tl.arange(0, K)[None, :]
    value = tl.broadcast_to(tl.where(found > 0, first, 0)[:, None], (ROWS, K)).to(tl.int64)
    tl.store(idx + slots, value, (slots >= found[:, None]) & (slots < k) & (rows[:, None] < m))


def ball_query(query: Tensor, target: Tensor, radius: float, k: int) -> Tensor:
    """idx (B, m, k) int64: the first k targets in storage order with distance < radius; the first repeated, or 0."""
    query, target = query.float().contiguous(), target.float().contiguous()
    (batch, m, _), n = query.shape, target.shape[1]
    idx = torch.empty(batch, m, k, dtype=torch.int64, device=query.device)
    _ball[(triton.cdiv(m, 16), batch)](query, target, idx, m, n, k, radius, triton.next_power_of_2(k), 16, 128)
    return idx


@triton.jit
def _farthest(points, start, idx, n, m, skip_sq, BLOCK: tl.constexpr):
    cloud = tl.program_id(0).to(tl.int64)
    points += cloud * n * 3
    idx += cloud * m
    offsets = tl.arange(0, BLOCK)
    x = tl.load(points + offsets * 3, offsets < n, 0.0)
    y = tl.load(points + offsets * 3 + 1, offsets < n, 0.0)
    z = tl.load(points + offsets * 3 + 2, offsets < n, 0.0)
    eligible = (offsets < n) & (x * x + y * y + z * z > skip_sq)
    distance = tl.where(eligible, float("inf"), -2.0)
    last = tl.load(start + cloud)
    tl.store(idx, last)
    for i in range(1, m):
        # below its duplicates' zero, above what is never chosen: the first of these repeats when all others are taken
        distance = tl.where(eligible & (offsets == last), -1.0, distance)
        dx = x - tl.load(points + last * 3)
        dy = y - tl.load(points + last * 3 + 1)
        dz = z - tl.load(points + last * 3 + 2)
        distance = tl.minimum(distance, dx * dx + dy * dy + dz * dz)
        last = tl.argmax(distance, axis=0).to(tl.int64)
        tl.store(idx + i, last)


FARTHEST_LIMIT = 16384  # points that one program holds in registers


def farthest_points(points: Tensor, m: int, start: Tensor, skip_sq: float = -1.0) -> Tensor:
    """idx (B, m) int64 by greedy farthest point sampling of points (B, n <= FARTHEST_LIMIT, 3), in one kernel.

    start (B,) int64. All different, duplicates among the points too. Points with |x|^2 <= skip_sq are chosen as the
    start only; when the others run out the first of them is repeated.
    """
    points = points.float().contiguous()
    batch, n, _ = points.shape
    idx = torch.empty(batch, m, dtype=torch.int64, device=points.device)
    block = triton.next_power_of_2(n)
    _farthest[(batch,)](points, start.to(torch.int64), idx, n, m, skip_sq, block, num_warps=farthest_warps(block))
    return idx


def farthest_warps(block: int) -> int:
    """Warps of a program of `_farthest` that holds so many points."""
    return min(16, max(1, block // 256))
