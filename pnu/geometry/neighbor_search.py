"""Neighbor searches between two clouds: trees on the CPU, kernels on a GPU, chunks of bounded memory elsewhere."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.point_tree import PointTree

CHUNK_ELEMENTS = 2**25  # distances held at once where neither tree nor kernel is used: 128 MiB in float32
KERNEL_K = 64  # more neighbors than this do not fit a kernel's registers


class Neighbors(NamedTuple):
    """Nearest targets of each query, by ascending distance.

    `idx[b, i, j] = t`: target t is the j-th nearest of query i in cloud b, at squared distance `dist_sq[b, i, j]`.
    """

    dist_sq: Tensor  # (B, m, k), dtype and device of the query
    idx: Tensor  # (B, m, k) int64


def knn(query: Tensor, target: Tensor, k: int) -> Neighbors:
    """The k nearest targets of each query; a search, so without gradient.

    query (B, m, 3), target (B, n, 3); equal distances come in any order. ValueError if k is not in 1..n.
    """
    _check(query, target)
    _check_k(k, target.shape[1])
    query, target = query.detach(), target.detach()
    if query.device.type == "cpu":
        return _knn_tree(query, target, k)
    triton_kernels = gpu_kernels(query)
    if triton_kernels and k <= KERNEL_K:
        return _knn_kernel(triton_kernels, query, target, k)
    return _knn_chunks(query, target, k)


class Search:
    """The k nearest points of one cloud (n, 3), looked up again and again: on the CPU its tree is built once.

    Elsewhere float32 is searched, which the kernels take: points of a unit sphere lose nothing that matters.
    """

    def __init__(self, target: Tensor) -> None:
        self.target = target.detach()
        self.tree = PointTree(self.target.double().numpy()) if target.device.type == "cpu" else None

    def knn(self, query: Tensor, k: int, *, ordered: bool = False) -> Neighbors:
        """query (m, 3) -> as `knn`, but (m, k). ordered: queries come along a curve, which saves time."""
        _check_k(k, len(self.target))
        if self.tree is None:
            found = knn(query[None].float(), self.target[None].float(), k)
            return Neighbors(found.dist_sq[0].to(query.dtype), found.idx[0])
        dist_sq, idx = self.tree.nearest_sq(
            query.detach().double().numpy(), k, threads=torch.get_num_threads(), ordered=ordered
        )
        return Neighbors(torch.from_numpy(dist_sq).to(query.dtype), torch.from_numpy(idx))


def nearest(query: Tensor, target: Tensor) -> Neighbors:
    """The nearest target of each query, as `knn` with k = 1 but of shape (B, m): `idx[b, i] = t`."""
    found = knn(query, target, 1)
    return Neighbors(found.dist_sq[..., 0], found.idx[..., 0])


def ball_query(query: Tensor, target: Tensor, radius: float, k: int) -> Tensor:
    """The first k targets, in storage order, that are closer than `radius` to each query (PointNet++).

    query (B, m, 3), target (B, n, 3) -> idx (B, m, k) int64: `idx[b, i, j] = t`, target t is the j-th of those within
    the radius of query i. Where there are fewer than k the first one is repeated; where there is none, all are 0.
    """
    _check(query, target)
    if k < 1:
        raise ValueError(f"k: expected at least 1 neighbor, found {k}")
    if not radius > 0:
        raise ValueError(f"radius: expected a positive distance, found {radius}")
    query, target = query.detach(), target.detach()
    if query.device.type == "cpu":
        return _ball_tree(query, target, radius, k)
    triton_kernels = gpu_kernels(query)
    if triton_kernels and k <= KERNEL_K:
        idx: Tensor = triton_kernels.ball_query(*_single(query, target), radius, k)
        return idx
    return _ball_chunks(query, target, radius, k)


def per_cloud(function: Callable[[int], None], clouds: int) -> None:
    """Call function(0) .. function(clouds - 1), spread over as many threads as torch uses (SciPy frees the GIL)."""
    threads = min(torch.get_num_threads(), clouds)
    if threads <= 1:
        for b in range(clouds):
            function(b)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(function, range(clouds)))


def gpu_kernels(points: Tensor) -> ModuleType | None:
    """`triton_kernels` where they can run: on a CUDA device, with triton installed. They compute in float32."""
    if points.device.type != "cuda":
        return None
    try:
        from pnu.geometry import triton_kernels
    except ImportError:
        return None
    return triton_kernels


def _check_k(k: int, n: int) -> None:
    if not 1 <= k <= n:
        raise ValueError(f"k: expected 1 to {n} neighbors (the number of target points), found {k}")


def _check(query: Tensor, target: Tensor) -> None:
    for name, cloud in (("query", query), ("target", target)):
        if cloud.ndim != 3 or cloud.shape[2] != 3:
            raise ValueError(f"{name}: expected points of shape (B, n, 3), found {tuple(cloud.shape)}")
    if query.shape[0] != target.shape[0]:
        raise ValueError(
            f"target: expected {query.shape[0]} clouds, one for each of the query, found {target.shape[0]}"
        )
    if target.shape[1] == 0:
        raise ValueError("target: expected at least one point, found none")


def _knn_tree(query: Tensor, target: Tensor, k: int) -> Neighbors:
    clouds, m, _ = query.shape
    dist_sq = np.empty((clouds, m, k))
    idx = np.empty((clouds, m, k), np.int64)
    workers = 1 if clouds > 1 else torch.get_num_threads()

    def search(b: int) -> None:
        tree = PointTree(target[b].double().numpy())
        dist_sq[b], idx[b] = tree.nearest_sq(query[b].double().numpy(), k, threads=workers)

    per_cloud(search, clouds)
    return Neighbors(torch.from_numpy(dist_sq).to(query.dtype), torch.from_numpy(idx))


def _ball_tree(query: Tensor, target: Tensor, radius: float, k: int) -> Tensor:
    clouds, m, _ = query.shape
    idx = np.zeros((clouds, m, k), np.int64)

    def search(b: int) -> None:
        tree = kd_tree(query[b].double().numpy())
        pairs = tree.sparse_distance_matrix(kd_tree(target[b].double().numpy()), radius, output_type="ndarray")
        pairs = pairs[pairs["v"] < radius]
        pairs = pairs[np.argsort(pairs["i"] * target.shape[1] + pairs["j"])]
        row, column = pairs["i"], pairs["j"]
        count = np.bincount(row, minlength=m)
        first = np.cumsum(count) - count
        rank = np.arange(len(row)) - first[row]
        some = count > 0
        idx[b, some] = column[first[some], None]
        kept = rank < k
        idx[b, row[kept], rank[kept]] = column[kept]

    per_cloud(search, clouds)
    return torch.from_numpy(idx)


def _single(query: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Both in float32; of float64 about the targets' mean, since map coordinates lose their detail in float32."""
    if torch.float64 in (query.dtype, target.dtype):
        center = target.double().mean(1, keepdim=True)
        query, target = query - center, target - center
    return query.float(), target.float()


def _knn_kernel(kernels: ModuleType, query: Tensor, target: Tensor, k: int) -> Neighbors:
    """Chosen in float32; the distances of the chosen, and their order, have the digits of the points."""
    dist_sq, idx = kernels.knn(*_single(query, target), k)
    if torch.float64 not in (query.dtype, target.dtype):
        return Neighbors(dist_sq.to(query.dtype), idx)
    batch = torch.arange(len(idx), device=idx.device)[:, None, None]
    parts = []
    size = max(1, CHUNK_ELEMENTS // (3 * k * len(idx)))
    for part in torch.split(torch.arange(query.shape[1], device=idx.device), size):
        parts.append((query[:, part, None] - target[batch, idx[:, part]]).square_().sum(-1))
    dist_sq, order = torch.cat(parts, 1).sort(dim=-1, stable=True)
    return Neighbors(dist_sq.to(query.dtype), idx.gather(-1, order))


def _chunks(query: Tensor, target: Tensor) -> Iterator[tuple[slice, slice]]:
    """Slices (clouds, queries) whose distances to all targets stay below CHUNK_ELEMENTS."""
    clouds, m, _ = query.shape
    rows = max(1, CHUNK_ELEMENTS // target.shape[1])
    if rows >= m:
        step = rows // max(m, 1)
        for b in range(0, clouds, step):
            yield slice(b, b + step), slice(None)
        return
    for b in range(clouds):
        for i in range(0, m, rows):
            yield slice(b, b + 1), slice(i, i + rows)


def _distances_sq(query: Tensor, target: Tensor) -> Tensor:
    """(B, m, n) by differences: the faster expansion of the square loses half of the digits."""
    total = (query[:, :, None, 0] - target[:, None, :, 0]).square_()
    for axis in (1, 2):
        total += (query[:, :, None, axis] - target[:, None, :, axis]).square_()
    return total


def _knn_chunks(query: Tensor, target: Tensor, k: int) -> Neighbors:
    clouds, m, _ = query.shape
    dist_sq = query.new_empty(clouds, m, k)
    idx = torch.empty(clouds, m, k, dtype=torch.int64, device=query.device)
    for b, i in _chunks(query, target):
        dist_sq[b, i], idx[b, i] = _distances_sq(query[b, i], target[b]).topk(k, dim=-1, largest=False)
    return Neighbors(dist_sq, idx)


def _ball_chunks(query: Tensor, target: Tensor, radius: float, k: int) -> Tensor:
    clouds, m, _ = query.shape
    n = target.shape[1]
    idx = torch.empty(clouds, m, k, dtype=torch.int64, device=query.device)
    order = torch.arange(n, device=query.device)
    for b, i in _chunks(query, target):
        inside = _distances_sq(query[b, i], target[b]).sqrt_() < radius
        found = torch.where(inside, order, n).topk(min(k, n), dim=-1, largest=False).values
        first = found[..., :1] % n  # none found: n % n = 0
        idx[b, i] = first
        idx[b, i, : found.shape[-1]] = torch.where(found < n, found, first)
    return idx
