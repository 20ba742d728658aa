"""Projections of the surface model by torch: on any device, with any network, and where kernels are not compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnu.geometry.local_frames import feet
from pnu.geometry.neighbor_search import Search
from pnu.runtime import threads

if TYPE_CHECKING:
    from pnu.networks.surface import Surface

Floats = NDArray[np.float64]


def network_projections(network: Surface, cloud: Floats, size: Callable[[bool], int]) -> Callable[[Floats], Floats]:
    """Around a cloud (n, 6 + c): queries (m, 6) -> projected, logarithm of the expected error, messages: (m, 7 + c).

    size(on_cpu): queries that go through the network together.
    """
    like, ranks = network.projector.out.weight, network.ranks(len(cloud))

    def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
        idx = idx[:, ranks]
        projected, log_error, spacing = network.project(query[None], cloud[None], idx[None])
        error = (log_error[0] + spacing[0].log()).to(projected)[:, None]
        return torch.cat([projected[0, :, :6], error, projected[0, :, 6:]], 1)

    return _by_neighbors(project, cloud, network.reach, like.device, size)


def sphere_projections(like: Tensor, cloud: Floats, k: int, size: Callable[[bool], int]) -> Callable[[Floats], Floats]:
    """As `network_projections`, but to the sphere that fits the k nearest points, without expected error.

    Computed in the type of `like`, where that lies.
    """

    def project(query: Tensor, cloud: Tensor, idx: Tensor) -> Tensor:
        near = cloud[idx]
        offsets = near[..., :3] - query[:, None, :3]
        step, normal = (x.to(query) for x in feet(*(x.to(like) for x in (offsets, near[..., 3:6], query[:, 3:6]))))
        return torch.cat([query[:, :3] + step, normal, torch.zeros_like(step[:, :1])], 1)

    return _by_neighbors(project, cloud, k, like.device, size)


def _by_neighbors(
    project: Callable[[Tensor, Tensor, Tensor], Tensor], array: Floats, k: int, device: torch.device,
    size: Callable[[bool], int],
) -> Callable[[Floats], Floats]:  # fmt: skip
    """project(queries (m, 6), cloud (n, 6), their k nearest points as idx (m, k)), for queries in batches."""
    cloud = torch.from_numpy(array).to(device)
    search, on_cpu = Search(cloud[:, :3]), device.type == "cpu"
    at_once = size(on_cpu)

    @torch.no_grad()
    def work(queries: Floats) -> Floats:
        query = torch.from_numpy(queries).to(cloud)
        idx = search.knn(query[:, :3], min(k, len(cloud)), ordered=True).idx
        batches = [slice(start, start + at_once) for start in range(0, len(query), at_once)]

        def batch(part: slice) -> Tensor:
            return project(query[part], cloud, idx[part])

        found = threads.map_on_threads(batch, batches) if on_cpu else [batch(part) for part in batches]
        return torch.cat(found).double().cpu().numpy()

    return work
