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
NEAREST_BLOCK = 32, 64  # queries and groups of targets of a program of `_nearest`


@triton.jit
def _xyz(points, rows, n):
    """Coordinates of some points, each (rows); zero beyond the cloud."""
    inside = rows < n
    x = tl.load(points + rows * 3, inside, 0.0)
    y = tl.load(points + rows * 3 + 1, inside, 0.0)
    z = tl.load(points + rows * 3 + 2, inside, 0.0)
    return x, y, z


@triton.jit
def _distance_sq(x, y, z, target, columns, n):
    """(rows, columns) squared distances of queries to targets."""
    a, b, c = _xyz(target, columns, n)
    a = x[:, None] - a[None, :]
    b = y[:, None] - b[None, :]
    c = z[:, None] - c[None, :]
    return a * a + b * b + c * c


@triton.jit
def _keys(distance, columns):
    """Candidates of distances (rows, columns) of targets (rows or 1, columns)."""
    return (distance.to(tl.int32, bitcast=True).to(tl.int64) << INDEX_BITS) | columns.to(tl.int64)


@triton.jit
def _candidates(x, y, z, target, columns, n):
    distance = _distance_sq(x, y, z, target, columns, n)
    return tl.where(columns[None, :] < n, _keys(distance, columns[None, :]), NO_CANDIDATE)


@triton.jit
def _nearest(query, target, dist_sq, idx, m, n, k, K: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """One or two neighbors (K) in one pass: of each of COLUMNS groups of targets the nearest K, joined at the end."""
    cloud = tl.program_id(1).to(tl.int64)
    query, target = query + cloud * m * 3, target + cloud * n * 3
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    x, y, z = _xyz(query, rows, m)
    columns = tl.arange(0, COLUMNS)
    first = tl.full((ROWS, COLUMNS), float("inf"), tl.float32)
    second = first
    of_first = tl.zeros((ROWS, COLUMNS), tl.int32) + columns[None, :]
    of_second = of_first
    for start in range(0, n, COLUMNS):
        at = start + columns
        distance = tl.where((at < n)[None, :], _distance_sq(x, y, z, target, at, n), float("inf"))
        nearer = distance < first
        if K == 2:
            close = distance < second
            second = tl.where(nearer, first, tl.where(close, distance, second))
            of_second = tl.where(nearer, of_first, tl.where(close, at[None, :], of_second))
        first = tl.where(nearer, distance, first)
        of_first = tl.where(nearer, at[None, :], of_first)
    best = tl.where(of_first < n, _keys(first, of_first), NO_CANDIDATE)
    if K == 2:
        others = tl.where(of_second < n, _keys(second, of_second), NO_CANDIDATE)
        best = -tl.topk(-tl.reshape(tl.join(best, others), (ROWS, 2 * COLUMNS)), 2)
    else:
        best = tl.min(best, axis=1)[:, None]
    _store(best, rows, dist_sq + cloud * m * k, idx + cloud * m * k, m, k)


@triton.jit
def _joined(best, keys, K: tl.constexpr):
    """The K smallest of both, (rows, K) and (rows, columns)."""
    # topk keeps the largest, so everything is negated
    return -tl.topk(-tl.reshape(tl.join(best, -tl.topk(-keys, K)), (best.shape[0], 2 * K)), K)


@triton.jit
def _store(best, rows, dist_sq, idx, m, k):
    """The first k of (rows, K) keys as distances and indices."""
    slots = tl.arange(0, best.shape[1])
    out = rows[:, None] * k + slots[None, :]
    kept = (rows[:, None] < m) & (slots[None, :] < k)
    tl.store(dist_sq + out, (best >> INDEX_BITS).to(tl.int32).to(tl.float32, bitcast=True), kept)
    tl.store(idx + out, best & INDEX_MASK, kept)


@triton.jit
def _knn(query, target, close, dist_sq, idx, m, n, k,
         K: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr, SPACE: tl.constexpr, SORTED: tl.constexpr
):  # fmt: skip
    """Two passes over the targets. The first takes the nearest target of each of COLUMNS groups; the K-th of these is
    no nearer than the K-th of all. The second puts the few that are no farther into `close`, where they are sorted."""
    cloud = tl.program_id(1).to(tl.int64)
    query, target = query + cloud * m * 3, target + cloud * n * 3
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    x, y, z = _xyz(query, rows, m)
    least = tl.full((ROWS, COLUMNS), float("inf"), tl.float32)
    for start in range(0, n, COLUMNS):
        columns = start + tl.arange(0, COLUMNS)
        distance = _distance_sq(x, y, z, target, columns, n)
        least = tl.minimum(least, tl.where(columns[None, :] < n, distance, float("inf")))
    bound = tl.max(-tl.topk(-least, K), axis=1) * 1.000001  # whatever rounding the second pass has
    found = tl.zeros((ROWS,), tl.int32)
    space = close + (cloud * m + rows[:, None]) * SPACE
    for start in range(0, n, COLUMNS):
        columns = start + tl.arange(0, COLUMNS)
        distance = _distance_sq(x, y, z, target, columns, n)
        near = (rows[:, None] < m) & (columns[None, :] < n) & ~(distance > bound[:, None])  # NaN is a candidate, too
        place = found[:, None] + tl.cumsum(near.to(tl.int32), axis=1) - 1
        tl.store(space + place, _keys(distance, columns[None, :]), near & (place < SPACE))
        found += tl.sum(near.to(tl.int32), axis=1)
    best = tl.full((ROWS, K), NO_CANDIDATE, tl.int64)
    if tl.max(found) <= SPACE:
        tl.debug_barrier()  # what other threads have put there
        slots = tl.arange(0, SPACE)[None, :]
        best = -tl.topk(-tl.load(space + slots, slots < found[:, None], NO_CANDIDATE), K)
    else:  # many equal distances
        for start in range(0, n, SORTED):
            best = _joined(best, _candidates(x, y, z, target, start + tl.arange(0, SORTED), n), K)
    _store(best, rows, dist_sq + cloud * m * k, idx + cloud * m * k, m, k)


def knn(query: Tensor, target: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """dist_sq (B, m, k) float32 and idx (B, m, k) int64 of the k nearest targets, ascending; 1 <= k <= n.

    query (B, m, 3), target (B, n, 3). Work O(B m n), memory O(B m k).
    """
    query, target = query.float().contiguous(), target.float().contiguous()
    (batch, m, _), n = query.shape, target.shape[1]
    dist_sq = torch.empty(batch, m, k, device=query.device)
    idx = torch.empty(batch, m, k, dtype=torch.int64, device=query.device)
    slots = triton.next_power_of_2(k)
    if slots <= 2:
        rows, columns = NEAREST_BLOCK
        grid = (triton.cdiv(m, rows), batch)
        _nearest[grid](query, target, dist_sq, idx, m, n, k, slots, rows, columns)
        return dist_sq, idx
    columns, space = knn_columns(slots)
    close = torch.empty(batch, m, space, dtype=torch.int64, device=query.device)
    _knn[(triton.cdiv(m, 16), batch)](
        query, target, close, dist_sq, idx, m, n, k, slots, 16, columns, space, max(32, slots)
    )
    return dist_sq, idx


def knn_columns(slots: int) -> tuple[int, int]:
    """Groups of targets of `_knn`, and room for the close ones, for so many neighbors (a power of two): of twice as
    many groups 1.4 times as many are close, where the targets' order says nothing of their places."""
    return max(64, 2 * slots), max(16, 2 * slots)


@triton.jit
def _ball(query, target, idx, m, n, k, radius, K: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    cloud = tl.program_id(1).to(tl.int64)
    query, target = query + cloud * m * 3, target + cloud * n * 3
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    x, y, z = _xyz(query, rows, m)
    idx += cloud * m * k + rows[:, None] * k
    found = tl.zeros((ROWS,), tl.int32)
    first = tl.full((ROWS,), n, tl.int32)
    for start in range(0, n, COLUMNS):
        columns = start + tl.arange(0, COLUMNS)
        distance = tl.sqrt(_distance_sq(x, y, z, target, columns, n))
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
