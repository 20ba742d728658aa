"""The paper's procedure (section Inference): patches through the network, farthest points of all predictions."""

import math
from dataclasses import replace
from functools import partial
from numbers import Integral

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from pnu.geometry import patch_extraction
from pnu.geometry.normal_estimation import flip_to_reference
from pnu.geometry.unit_sphere import unit_sphere_frame
from pnu.runtime import threads
from pnu.runtime.workers import Begin, InProcess, Work, Workers
from pnu.upsamplers.agreement import most_agreed
from pnu.upsamplers.context import Context
from pnu.upsamplers.surface_projection import thin_between
from pnu.upsamplers.unit_normals import check_finite, with_unit_normals

SMALLEST_PATCH = 64  # points that every network accepts; a smaller cloud is repeated up to it
SLACK = 1.1  # growth beyond the network's ratio for which overlapping patches have points enough
UNSIDED = 0.25  # share of predicted normals against the nearest given ones from which on their sides mean nothing
KEPT = 256  # patches whose predictions are kept in one file
AT_ONCE = 1024  # points that go through a network together on a CPU, by one thread
BATCHES = 32  # of these, that its threads share
Floats = NDArray[np.float64]


class Patches:
    """For a network of patches (B, n, 6) -> (B, ratio n, 6 or 3), in passes of `ratio` times as many points each.

    In addition to the paper every point lies in a patch, passes are repeated for ratios beyond the network's, and a
    small cloud fills a patch by repetition. Nothing is random. The cloud stays on the CPU, in float64; patches go to
    the network in its own type and device.

    With `merge="agreed"` of the context, ours, the farthest points are moved to where the predictions around them agree
    (`agreement`); the normals of a network without are estimated for it. With `keep` the input points come first, and
    the farthest points are those from them, too.

    Args:
        network: with an attribute `ratio`.
        patch_size: points of a patch; None: what the network says, or 1024.

    Raises:
        ValueError: the network has no ratio.
    """

    parallel = merges = keeps = True

    def __init__(self, network: nn.Module, patch_size: int | None = None) -> None:
        self.network = network
        ratio = getattr(network, "ratio", None)
        if not (isinstance(ratio, Integral) and int(ratio) >= 1):
            raise ValueError(
                "model: expected a network with an attribute `ratio`, the points out for each point in, a whole number "
                f">= 1; found {ratio!r}"
            )
        self.ratio = int(ratio)
        self.patch_size = patch_size or int(getattr(network, "patch_size", 1024))

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 3 or 6) on the CPU."""
        cloud = cloud.cpu()
        begin = partial(predictions, batch_size=context.batch_size)
        kept = cloud if context.keep else cloud[:0]
        if count <= len(kept):
            return kept[:count]
        run = partial(self._one_pass, begin, context.workers or InProcess(self.network), context, kept)
        *before, last = self.pass_sizes(len(cloud), count)
        for size in before:
            dense = run(cloud, size).double().numpy()
            cloud = torch.from_numpy(with_unit_normals(dense, cloud.double().numpy())).to(cloud)
        return run(cloud, last)

    def pass_sizes(self, n: int, count: int) -> list[int]:
        """Number of points after each pass from n to count: as few passes as possible, all with the same growth."""
        if self.ratio == 1 and count > n:
            raise ValueError(
                f"model: a network of ratio 1 makes no more points than it gets, {count} of {n} were asked for; leave "
                "ratio=1, or take a network of ratio 2 or more"
            )
        reach = self.ratio * (SLACK if n > self.patch_size else 1)
        passes = 1
        while count > n * reach**passes:
            passes += 1
        sizes = [n]
        for i in range(1, passes):
            sizes.append(min(math.ceil(n * (count / n) ** (i / passes)), self.ratio * sizes[-1]))
        return [*sizes[1:], count]

    def _one_pass(
        self, begin: Begin, workers: Workers, context: Context, kept: Tensor, cloud: Tensor, count: int
    ) -> Tensor:
        """The network on patches of the cloud (n, 6), and farthest points of all it predicts: (count, 3 or 6).

        The first are those kept (k, 6).
        """
        n, size = len(cloud), min(self.patch_size, len(cloud))
        centers = 1 if size == n else max(1, round(self.ratio * n / size))
        stage = f"network, {n} points"
        context.progress(stage, 0, centers)
        idx = patch_extraction.extract(cloud, centers, size, cover=True)
        if size < SMALLEST_PATCH:
            idx = idx[:, torch.arange(SMALLEST_PATCH) % size]
        like = example(self.network)
        at_once = patches_at_once(like, context.batch_size, idx.shape[1])
        together = at_once * (BATCHES if like.device.type == "cpu" else 1)

        places, rows = cloud.numpy(), idx.numpy()

        def predict(first: int) -> np.ndarray:
            found = []
            some = rows[first : first + KEPT]
            parts = [some[at : at + together] for at in range(0, len(some), together)]
            for number, part in enumerate(workers.map(begin, places, parts), 1):
                found.append(part)
                context.progress(stage, min(first + number * together, len(idx)), len(idx))
            return np.concatenate(found)

        predicted = torch.empty(0)
        for first in range(0, len(idx), KEPT):
            found = torch.from_numpy(context.parts.get(f"{stage}, patches from {first}", partial(predict, first)))
            each = len(found) // min(KEPT, len(idx) - first)  # points of a patch
            if not first:
                predicted = found.new_empty(len(idx) * each, found.shape[1])
            predicted[first * each : first * each + len(found)] = found
        context.progress(stage, len(idx), len(idx))
        stage = f"farthest points, {count} of {len(predicted)}"
        check_finite(predicted.numpy())
        given, columns = cloud.double().numpy(), predicted.shape[1]
        stay, new = kept.double().numpy(), count - len(kept)
        if context.merge == "agreed":
            all_predicted = with_agreeing_sides(with_unit_normals(predicted.double().numpy(), given), given)
            of_pass = replace(context, parts=context.parts.within(f"agreement_{n}"))
            made = most_agreed(all_predicted, given, stay, new, of_pass, stage)
        elif len(kept):
            made = thin_between(predicted.double().numpy(), new, stay, partial(context.progress, stage))
        else:
            return patch_extraction.merge(predicted[None], count, partial(context.progress, stage))
        return torch.from_numpy(np.concatenate([stay[:, :columns], made[:, :columns]]))


def with_agreeing_sides(predicted: Floats, cloud: Floats) -> Floats:
    """Predictions (m, 6) of a network that does not learn sides, as PUGeo-Net, with those of the nearest normals.

    cloud (n, 6). Others stay as they are: on a thin sheet the nearest point may lie on its other side.
    """
    sided = flip_to_reference(predicted[:, 3:], predicted[:, :3], cloud[:, :3], cloud[:, 3:])
    turned = (sided != predicted[:, 3:]).any(1).mean()
    return np.hstack([predicted[:, :3], sided]) if turned > UNSIDED else predicted


def predictions(network: nn.Module, places: np.ndarray, batch_size: int | None = None) -> Work:
    """Of a cloud (n, 6): patches idx (p, size) -> their predictions, one after the other, in the cloud's frame.

    On the CPU each thread works on patches of its own. That is faster than many threads in one operation, and the last
    digit of a matrix product, which may decide between two farthest points, depends on nothing else.
    """
    like, cloud = example(network), torch.from_numpy(places)
    on_cpu = like.device.type == "cpu"

    def predict(idx: Tensor) -> Tensor:
        patch = cloud[idx]
        frame = unit_sphere_frame(patch)  # in float64, so that float32 has only the patch to resolve
        dense: Tensor = frame.from_unit(network(frame.to_unit(patch).to(like)).cpu().double())
        return dense.flatten(0, 1)

    def work(rows: np.ndarray) -> np.ndarray:
        batches = torch.split(torch.from_numpy(rows), patches_at_once(like, batch_size, rows.shape[1]))
        found = threads.map_on_threads(predict, batches) if on_cpu else [predict(batch) for batch in batches]
        return torch.cat(found).numpy()

    return work


def example(network: nn.Module) -> Tensor:
    """A tensor of the network's type, on its device."""
    return next(network.parameters(), torch.empty(0))


def patches_at_once(like: Tensor, batch_size: int | None, size: int) -> int:
    """Patches of `size` points that go through the network together."""
    return max(1, AT_ONCE // size) if like.device.type == "cpu" else batch_size or 64
