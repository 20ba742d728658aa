"""A training step of the paper's size against a plain port: `python -m bench.step [threads]`.

20 patches of 1024 -> 4096 points: forward, loss, backward, Adam. Beside the ratios: where our step spends its time, and
the limit, the step's floating-point operations over the measured rate of a large matrix product.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

import pnu.losses.compound
import pnu.models.layers
from bench.plain import PlainLoss, PlainPNU
from bench.timing import Row, compare
from pnu.data import shapes
from pnu.losses import CompoundLoss
from pnu.models.pnu import PNU
from pnu.models.released import from_released
from pnu.ops import patches, surface
from pnu.ops.normalize import unit_sphere_frame

CLOUDS, POINTS, RATIO = 20, 1024, 4
SEARCHES = {
    "farthest points": (pnu.models.layers, "farthest_points"),
    "balls": (pnu.models.layers, "ball_query"),
    "3 nearest of the network": (pnu.models.layers, "knn"),
    "k nearest of the loss": (pnu.losses.compound, "knn"),
    "nearest of the loss": (pnu.losses.compound, "nearest"),
}


@lru_cache
def data() -> tuple[Tensor, Tensor]:
    """Inputs (20, 1024, 6) and targets (20, 4096, 6): patches of procedural shapes in the unit sphere."""
    generator = np.random.default_rng(0)
    targets = []
    for name in shapes.names()[: CLOUDS // 4]:
        cloud = torch.from_numpy(surface.sample_area(shapes.make(name), 5 * POINTS * RATIO, generator)).float()
        targets.append(cloud[patches.extract(cloud, 4, POINTS * RATIO)])
    target = torch.cat(targets)
    target = target[:, torch.from_numpy(generator.permutation(POINTS * RATIO))]
    target = unit_sphere_frame(target[..., :3]).to_unit(target)
    return target[:, :POINTS].contiguous(), target


def step(network: nn.Module, loss: nn.Module, optimizer: torch.optim.Optimizer) -> Tensor:
    inputs, target = data()
    optimizer.zero_grad()
    value = loss(network(inputs), target)["loss"]
    value.backward()
    optimizer.step()
    return value


def trainings() -> tuple[Callable[[], Tensor], Callable[[], Tensor]]:
    """Our step and the plain one, from the same weights."""
    torch.manual_seed(0)
    plain = PlainPNU()
    ours = PNU()
    ours.load_state_dict(from_released(plain.state_dict()))

    def of(network: nn.Module, loss: nn.Module) -> Callable[[], Tensor]:
        return partial(step, network, loss, torch.optim.Adam(network.parameters(), 1e-3, weight_decay=1e-5))

    return of(ours, CompoundLoss()), of(plain, PlainLoss())


def loss_of(loss: nn.Module, prediction: Tensor) -> None:
    prediction.grad = None
    loss(prediction, data()[1])["loss"].backward()


def rows(rounds: int = 3) -> list[Row]:
    """The step, and the loss alone with its gradient, against the plain port."""
    ours, plain = trainings()
    _, target = data()
    prediction = (target + 0.01 * torch.randn(target.shape)).requires_grad_()
    losses = {"pnu": partial(loss_of, CompoundLoss(), prediction), "plain": partial(loss_of, PlainLoss(), prediction)}
    size = f"{CLOUDS} x {POINTS} -> {POINTS * RATIO}"
    return [
        compare(f"training step, {size}", {"pnu": ours, "plain": plain}, rounds=rounds),
        compare(f"compound loss and gradient, {CLOUDS} x {POINTS * RATIO}", losses, rounds=rounds),
    ]


def limit() -> tuple[float, float]:
    """Floating-point operations of our step (GFLOP), and the rate of a large matrix product (GFLOP/s)."""
    ours, _ = trainings()
    with one_thread(), FlopCounterMode(display=False) as counter:
        ours()
    a, b = torch.randn(CLOUDS * POINTS, 512), torch.randn(512, 512)
    row = compare("product", {"torch": lambda: a @ b}, rounds=11)
    return counter.get_total_flops() / 1e9, 2 * a.numel() * 512 / row.seconds["torch"] / 1e9


def shares() -> dict[str, float]:
    """Where our step spends its time on one thread, in percent."""
    ours, _ = trainings()
    taken = dict.fromkeys(SEARCHES, 0.0)

    def timed(name: str, function: Callable[..., object], *args: object, **options: object) -> object:
        start = time.perf_counter()
        try:
            return function(*args, **options)
        finally:
            taken[name] += time.perf_counter() - start

    with one_thread():
        ours()
        with profile(activities=[ProfilerActivity.CPU]) as profiled:
            ours()
        with ExitStack() as stack:
            for name, (module, function) in SEARCHES.items():
                stack.enter_context(patch.object(module, function, partial(timed, name, getattr(module, function))))
            start = time.perf_counter()
            ours()
            total = time.perf_counter() - start
    searches = {name: 100 * seconds / total for name, seconds in taken.items()}
    events = [event for event in profiled.key_averages() if event.key.startswith("aten::")]
    everything = sum(event.self_cpu_time_total for event in profiled.key_averages())
    products = sum(e.self_cpu_time_total for e in events if e.key in ("aten::mm", "aten::addmm", "aten::addmm_"))
    rest = 100 - sum(searches.values())
    products = 100 * products / everything
    return {"matrix products": products, **searches, "element by element, gathers, Python": rest - products}


@contextmanager
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def main() -> None:
    torch.set_num_threads(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
    measured = rows()
    for row in measured:
        print(row)
    gflop, rate = limit()
    ratio = measured[0].seconds["pnu"] / (gflop / rate)
    print(f"limit of the step: {gflop:.0f} GFLOP at {rate:.0f} GFLOP/s = {gflop / rate:.2f} s; ours {ratio:.1f} x that")
    print("our step on one thread, in percent:")
    for name, share in shares().items():
        print(f"{share:6.1f}  {name}")


if __name__ == "__main__":
    main()
