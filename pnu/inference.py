"""Densify whole clouds with a trained network: no Hydra, no Lightning, usable from a notebook."""

import copy
import hashlib
import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from pnu import __version__, checkpoint
from pnu.io import Cloud, check_cloud
from pnu.models.surface import Surface
from pnu.ops import patches
from pnu.ops.attributes import carry
from pnu.ops.nearest import nearest
from pnu.ops.normalize import Frame, unit_sphere_frame
from pnu.ops.normals import complete_normals, estimate_normals, flip_to_reference
from pnu.runtime import threads
from pnu.runtime.parts import Keep, Parts, forget
from pnu.runtime.progress import Progress
from pnu.runtime.workers import Begin, Here, Processes, Work, Workers

MINIMUM = 16  # points of a cloud
SMALLEST_PATCH = 64  # points that every network accepts; a smaller cloud is repeated up to it
LARGEST = 10**9  # points of an output
SLACK = 1.1  # growth beyond the network's ratio for which overlapping patches have points enough
KEPT = 256  # patches whose predictions are kept in one file
BATCHES = 32  # on a CPU, that its threads share
ZERO = 1e-6  # predicted normals shorter than this have no direction


@runtime_checkable
class CloudUpsampler(Protocol):
    """A procedure for whole clouds. A model that has one of its own gets no patches.

    upsample_cloud(cloud (n, 6) float64 in the unit sphere, on the model's device, count) -> (count, 6), or (count, 3)
    without normals, in the same frame. All randomness comes from the generator; batch_size bounds the memory.
    """

    def upsample_cloud(
        self, cloud: Tensor, count: int, *, batch_size: int | None, generator: torch.Generator, progress: Progress
    ) -> Tensor: ...


def upsample(
    points: np.ndarray,
    normals: np.ndarray | None = None,
    *,
    ratio: float = 4,
    model: nn.Module | str | PathLike[str] = "surface",
    patch_size: int | None = None,
    device: str = "auto",
    devices: int = 1,
    batch_size: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    parts: str | PathLike[str] | None = None,
) -> np.ndarray:
    """A denser cloud on the same surface.

    A network of patches is used as in the paper (section Inference): patches around farthest points are brought to the
    unit sphere, go through the network and back, and farthest points of all predictions are kept. In addition every
    input point lies in a patch, passes are repeated for ratios beyond the network's, and a cloud of fewer than 64
    points fills a patch by repetition. A `CloudUpsampler`, such as "surface", takes the cloud as a whole. The result
    depends neither on the order of the points nor on repeated ones.

    Args:
        points: (n, 3), or (n, 6) with normals, n >= 16, in any unit and anywhere; an array, or a tensor on any device.
            Points that are not finite, or at the place of another, are left out: n is the number of the others, and
            `pnu.io.check_cloud` tells what it finds.
        normals: (n, 3), of any length; estimated and oriented where missing, zero or NaN here and in points.
        ratio: points out for each point in, any number >= 1.
        model: network, run folder, file of weights, the name of weights that come with pnu (`pnu.weights`), or
            "newest", the run that finished last under outputs/. "surface" takes the weights made for estimated normals
            where none are given.
        patch_size: points of a patch, at least 16; None: what the network was made for. "surface" has no patches.
        device: "auto" (where the given network is; else CUDA where there is one), "cpu", "cuda", "cuda:1" ...
        devices: CUDA devices, or processes on the CPU, that share the work of the network; the result is the same for
            any number. More than one needs `if __name__ == "__main__":` in a script.
        batch_size: patches at once on a GPU, by default 64; on the CPU each thread takes one. Of "surface": points at
            once, by default 65536 on a GPU and 512 a thread on the CPU.
        seed: of models that draw random numbers; the paper's procedure draws none.
        progress: called as progress(stage, done, total).
        parts: folder for finished parts of a long computation; the same call goes on from them after an interruption.

    Returns:
        (round(ratio n), 6) float64: points in the frame and unit of the input, and unit normals.

    Raises:
        ValueError: in one line, which argument is wrong and what was expected.

    The network comes back as it was, modes and device too; generators and settings of torch are left alone.
    """
    progress = progress or (lambda stage, done, total: None)
    given = _given(points, normals)
    count = output_count(len(given.points), ratio)
    sizes = (
        ("patch_size", patch_size, MINIMUM),
        ("batch_size", batch_size, 1),
        ("devices", devices, 1),
        ("seed", seed, 0),
    )
    for name, value, least in sizes:
        if value is not None and not (isinstance(value, Integral) and value >= least):
            raise ValueError(f"{name}={value}: expected a whole number >= {least}")
    network, target = _on_device(model if isinstance(model, nn.Module) else source(model, given.normals), device)
    upsampler = _upsampler(network, patch_size)
    sparse, frame = _prepare(given, progress)
    generator = torch.Generator().manual_seed(seed)
    options: dict[str, Any] = {}
    in_parts = isinstance(upsampler, Surface | Patchwise)
    if parts is not None and in_parts:
        options["keep"] = Parts(Path(parts) / _digest(network, sparse, count, upsampler))
    if devices > 1 and not in_parts:
        raise ValueError(f"devices={devices}: {type(network).__name__} works in one process; leave devices=1")
    names = _names(target, devices)
    with torch.no_grad(), evaluating(network), ExitStack() as stack:
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        if devices > 1:
            make = partial(_begin, copy.deepcopy(network).cpu(), patch_size, batch_size)
            options["workers"] = stack.enter_context(Processes(make, names))
        raw = upsampler.upsample_cloud(
            sparse.to(target), count, batch_size=batch_size, generator=generator, progress=progress, **options
        )
        dense = with_unit_normals(raw.cpu().double(), sparse)
    return frame.from_unit(dense[None])[0].numpy()


def attributes(dense: np.ndarray, cloud: Cloud) -> dict[str, np.ndarray]:
    """Colours and scalars of a cloud at the points of its denser version (m, 6), see `pnu.ops.attributes`."""
    if not cloud.attributes:
        return {}
    given = None if cloud.normals is None else torch.from_numpy(cloud.normals)
    normals = complete_normals(torch.from_numpy(cloud.points), given).numpy()
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    sparse = np.hstack([cloud.points, normals / np.maximum(length, 1e-300)])
    return {name: carry(dense, sparse, values) for name, values in cloud.attributes.items()}


def output_count(n: int, ratio: float) -> int:
    """round(ratio n), or `ValueError` for a ratio that is no number >= 1 or asks for more than 1e9 points."""
    if not (isinstance(ratio, Real) and 1 <= ratio < float("inf")):
        raise ValueError(f"ratio={_short(ratio)}: expected a number >= 1, the points out for each point in")
    count = round(ratio * n)
    if count > LARGEST:
        raise ValueError(f"ratio={ratio:g}: asks for {count} points, at most {LARGEST:g} are made; lower it")
    return count


def source(model: str | PathLike[str], normals: np.ndarray | None) -> str | PathLike[str]:
    """What `checkpoint.load` takes, for a cloud with these normals: "surface" means one of two, "newest" a run."""
    if model == "surface" and normals is None:
        return "surface_estimated"
    return checkpoint.resolve(model)


def _given(points: np.ndarray, normals: np.ndarray | None) -> Cloud:
    """The cloud that points (n, 3) or (n, 6) and normals (n, 3) describe, checked."""
    expected = "points: expected an array (n, 3), or (n, 6) with normals"
    array = _array(points, expected)
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        raise ValueError(f"{expected}, found shape {array.shape}")
    if array.shape[1] == 6:
        if normals is not None:
            raise ValueError("normals: are in points (n, 6) already; give points (n, 3), or no normals beside them")
        array, normals = array[:, :3], array[:, 3:]
    elif normals is not None:
        normals = _array(normals, f"normals: expected an array {array.shape}")
    return check_cloud(Cloud(array, normals, {}), "points", minimum=MINIMUM)


def _array(values: Any, expected: str) -> np.ndarray:
    """An array or a tensor, wherever it lies and whether or not it has a gradient, as float64."""
    try:
        if isinstance(values, Tensor):
            values = values.detach().cpu().double().resolve_conj().resolve_neg().numpy()
        if np.iscomplexobj(values):
            raise ValueError("complex")
        return np.asarray(values, np.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise ValueError(f"{expected}, found {type(values).__name__}") from None


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, Real) else repr(value)[:40]


@contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """A network in eval mode, each of its modules in its own mode again in the end."""
    training = [module for module in network.modules() if module.training]
    network.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True


def _on_device(model: nn.Module | str | PathLike[str], device: str) -> tuple[nn.Module, torch.device]:
    """The network on a device, and which; one that is given and lies elsewhere is copied, not moved."""
    given = isinstance(model, nn.Module)
    network = model if isinstance(model, nn.Module) else checkpoint.load(model)
    if device != "auto":
        try:
            torch.empty(0, device=device)
        except (RuntimeError, AssertionError):
            raise ValueError(f"device={device}: is not here; expected auto, cpu, or cuda where there is one") from None
        target = torch.device(device)
    elif given:
        target = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
    else:
        target = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if given and any(tensor.device != target for tensor in (*network.parameters(), *network.buffers())):
        network = copy.deepcopy(network)
    return network.to(target), target


def _names(target: torch.device, devices: int) -> list[str]:
    """Of as many devices as are asked for, of the kind of the target."""
    if devices == 1 or target.type == "cpu":
        return [str(target)] * devices
    here = torch.cuda.device_count()
    if devices > here:
        raise ValueError(f"devices={devices}: expected at most {here}, as many CUDA devices as are here")
    return [f"cuda:{number}" for number in range(devices)]


def _upsampler(network: nn.Module, patch_size: int | None) -> "CloudUpsampler":
    return network if isinstance(network, CloudUpsampler) else Patchwise(network, patch_size)


def _begin(network: nn.Module, patch_size: int | None, batch_size: int | None, device: str) -> Begin:
    """What a process of its own does with clouds."""
    upsampler = _upsampler(network.to(device), patch_size)
    work = upsampler.projections if isinstance(upsampler, Surface) else cast(Patchwise, upsampler).predictions
    return partial(work, batch_size=batch_size)


def _digest(network: nn.Module, sparse: Tensor, count: int, upsampler: object) -> str:
    """Of all that the parts of a computation depend on."""
    digest = hashlib.sha256(sparse.numpy().tobytes())
    for name, value in network.state_dict().items():
        digest.update(name.encode() + value.cpu().numpy().tobytes())
    plain = [
        (name, value)
        for module in (upsampler, *network.modules())
        for name, value in sorted(vars(module).items())
        if name != "training" and isinstance(value, int | float | str)
    ]
    digest.update(repr((type(network).__name__, count, plain, __version__, torch.__version__)).encode())
    return digest.hexdigest()[:16]


def _prepare(cloud: Cloud, progress: Progress) -> tuple[Tensor, Frame]:
    """Different points in a fixed order with normals, (n, 6) float64 in the unit sphere, and the way back."""
    points, normals = cloud.points, cloud.normals
    order = np.lexsort(points.T)
    frame = unit_sphere_frame(torch.from_numpy(points[order])[None])
    unit = frame.to_unit(torch.from_numpy(points[order])[None])
    extent = torch.linalg.svdvals(unit[0] - unit[0].mean(0))
    if extent[1] < 1e-9 * extent[0]:
        raise ValueError(f"points: all {len(points)} points lie on a line; expected points on a surface")
    given = None if normals is None else torch.from_numpy(normals[order])
    if given is None or given.isnan().any():
        progress("normals", 0, 1)
        directions = complete_normals(unit[0], given)
        progress("normals", 1, 1)
    else:
        directions = given
    return torch.cat([unit[0], directions], 1), frame


class Patchwise:
    """The paper's procedure for a network of patches, in passes of `network.ratio` times as many points each.

    patch_size: points of a patch; None: what the network says, or 1024. The cloud stays on the CPU, in float64;
    patches go to the network in its own type and device.
    """

    def __init__(self, network: nn.Module, patch_size: int | None = None) -> None:
        self.network = network
        ratio = getattr(network, "ratio", None)
        if not (isinstance(ratio, Integral) and int(ratio) >= 1):
            raise ValueError(
                "model: expected a network with an attribute `ratio`, the points out for each point in, a whole number "
                f">= 1; found {_short(ratio)}"
            )
        self.ratio = int(ratio)
        self.patch_size = patch_size or int(getattr(network, "patch_size", 1024))
        self.like = next(network.parameters(), torch.empty(0))  # tells device and type

    def upsample_cloud(
        self,
        cloud: Tensor,
        count: int,
        *,
        batch_size: int | None,
        generator: torch.Generator,
        progress: Progress,
        keep: Keep = forget,
        workers: Workers | None = None,
    ) -> Tensor:
        """cloud (n, 6) in the unit sphere -> (count, 3 or 6) on the CPU; nothing is random."""
        cloud = cloud.cpu()
        workers = workers or Here(partial(self.predictions, batch_size=batch_size))
        together = self.batch(batch_size) * (BATCHES if self.like.device.type == "cpu" else 1)
        *before, last = self.pass_sizes(len(cloud), count)
        for size in before:
            cloud = with_unit_normals(self._one_pass(cloud, size, together, workers, progress, keep), cloud)
        return self._one_pass(cloud, last, together, workers, progress, keep)

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
        self, cloud: Tensor, count: int, together: int, workers: Workers, progress: Progress, keep: Keep
    ) -> Tensor:
        """The network on patches of the cloud (n, 6), and farthest points of all it predicts: (count, 3 or 6)."""
        n, size = len(cloud), min(self.patch_size, len(cloud))
        centers = 1 if size == n else max(1, round(self.ratio * n / size))
        stage = f"network, {n} points"
        progress(stage, 0, centers)
        idx = patches.extract(cloud, centers, size, cover=True)
        if size < SMALLEST_PATCH:
            idx = idx[:, torch.arange(SMALLEST_PATCH) % size]

        def predict(first: int) -> Tensor:
            found = []
            for number, part in enumerate(workers.map(cloud, idx[first : first + KEPT].split(together)), 1):
                found.append(part)
                progress(stage, min(first + number * together, len(idx)), len(idx))
            return torch.cat(found)

        predicted = torch.empty(0)
        for first in range(0, len(idx), KEPT):
            found = keep(f"{stage}, patch {first}", partial(predict, first))
            each = len(found) // min(KEPT, len(idx) - first)  # points of a patch
            if not first:
                predicted = found.new_empty(len(idx) * each, found.shape[1])
            predicted[first * each : first * each + len(found)] = found
        progress(stage, len(idx), len(idx))
        stage = f"farthest points, {count} of {len(predicted)}"
        return patches.merge(_finite(predicted)[None], count, partial(progress, stage))

    def predictions(self, cloud: Tensor, batch_size: int | None = None) -> Work:
        """Of a cloud (n, 6): patches idx (p, size) -> their predictions, one after the other, in the cloud's frame.

        On the CPU each thread works on patches of its own. That is faster than many threads in one operation, and the
        last digit of a matrix product, which may decide between two farthest points, depends on nothing else.
        """
        on_cpu, size = self.like.device.type == "cpu", self.batch(batch_size)

        def predict(idx: Tensor) -> Tensor:
            patch = cloud[idx]
            frame = unit_sphere_frame(patch)  # in float64, so that float32 has only the patch to resolve
            dense = frame.from_unit(self.network(frame.to_unit(patch).to(self.like)).cpu().double())
            return dense.flatten(0, 1)

        def work(idx: Tensor) -> Tensor:
            batches = idx.split(size)
            return torch.cat(threads.spread(predict, batches) if on_cpu else [predict(batch) for batch in batches])

        return work

    def batch(self, batch_size: int | None) -> int:
        """Patches at once."""
        return 1 if self.like.device.type == "cpu" else batch_size or 64


def with_unit_normals(dense: Tensor, sparse: Tensor) -> Tensor:
    """Predictions (m, 3) or (m, 6) with unit normals, (m, 6); `sparse` (n, 6) is the cloud they were made from.

    A predicted normal without direction becomes that of the nearest input point. Where none are predicted they are
    estimated from the predicted points, with the side of the nearest input normal.
    """
    points = _finite(dense)[:, :3]
    if dense.shape[1] == 3:
        normals = estimate_normals(points[None], orient=False)
        normals = flip_to_reference(normals, points[None], sparse[None, :, :3], sparse[None, :, 3:])[0]
    else:
        normals = dense[:, 3:6]
    length = normals.norm(dim=1, keepdim=True)
    lost = (~(length > ZERO) | length.isinf()).squeeze(1)  # NaN counts as lost
    normals = normals / length
    if bool(lost.any()):
        normals[lost] = sparse[nearest(points[None, lost], sparse[None, :, :3]).idx[0], 3:]
    return torch.cat([points, normals], 1)


def _finite(prediction: Tensor) -> Tensor:
    if not bool(torch.isfinite(prediction[:, :3]).all()):
        raise ValueError("model: predicted points that are NaN or infinite; its weights are damaged, train it again")
    return prediction
