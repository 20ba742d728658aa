"""Batch norm whose statistics can be those of all processes of a training."""

import torch
import torch.distributed
from torch import Tensor, nn


class BatchNorm(nn.BatchNorm1d):
    """`nn.BatchNorm1d` of rows (R, C). With `synchronized`, its moments are those of the rows of all processes, as
    `nn.SyncBatchNorm` has them, which knows GPUs only.

    ValueError for a single row in training mode: it has no variance.
    """

    synchronized = False

    def forward(self, rows: Tensor) -> Tensor:
        together = self.training and self.synchronized and torch.distributed.is_initialized()
        if self.training:
            check_rows(len(rows) * (torch.distributed.get_world_size() if together else 1))
        if not together:
            return super().forward(rows)
        count = everywhere(rows.new_full((1,), len(rows)))
        mean = everywhere(rows.sum(0)) / count
        deviation = rows - mean
        variance = everywhere(deviation.square().sum(0)) / count
        self.track(mean.detach(), variance.detach() * count / (count - 1))
        return deviation * (variance + self.eps).rsqrt() * self.weight + self.bias

    def track(self, mean: Tensor, variance: Tensor) -> None:
        """Update the running statistics with those of a step, (C,) each; the variance without bias."""
        if self.running_mean is None or self.running_var is None or self.num_batches_tracked is None:
            return
        self.num_batches_tracked.add_(1)
        momentum = 1 / self.num_batches_tracked.item() if self.momentum is None else self.momentum
        self.running_mean.lerp_(mean.to(self.running_mean.dtype), momentum)
        self.running_var.lerp_(variance.to(self.running_var.dtype), momentum)


def check_rows(count: float) -> None:
    """ValueError where a step's rows, in all processes, have no variance that statistics could be made of."""
    if count < 2:
        raise ValueError(
            f"batch norm: expected 2 rows or more in a training step, found {count:g}; raise data.batch_size or"
            " data.input_points"
        )


def everywhere(sums: Tensor) -> Tensor:
    """Sums over all processes, with gradient where one is wanted."""
    if torch.is_grad_enabled() and sums.requires_grad:
        from torch.distributed.nn.functional import all_reduce  # takes a tenth of a second

        with_gradient: Tensor = all_reduce(sums)
        return with_gradient
    total = sums.clone()
    torch.distributed.all_reduce(total)
    return total


def synchronize(network: nn.Module, wanted: bool = True) -> nn.Module:
    """Have all batch norms of a network take the statistics of all processes, or of their own again."""
    for module in network.modules():
        if isinstance(module, BatchNorm):
            module.synchronized = wanted
    return network
