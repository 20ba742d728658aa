"""A training step of the paper's size against a plain port: `python -m bench step`.

20 patches of 1024 -> 4096 points: forward, loss, backward, Adam. Beside the ratios: where our step spends its time, and
the limit, the step's floating-point operations over the measured rate of a large matrix product.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest.mock import patch

import h5py
import numpy as np
import torch
from torch import Tensor, nn
from torch.profiler import ProfilerActivity
from torch.profiler import profile as torch_profile
from torch.utils.flop_counter import FlopCounterMode

import pnu.fast.forms
import pnu.losses.compound
import pnu.networks.pnu
from bench.plain import PlainLoss, PlainPNU
from bench.timing import Row, compare
from pnu.data import shapes
from pnu.data.patch_module import PatchDataModule
from pnu.fast import accelerate
from pnu.geometry import mesh_sampling, patch_extraction
from pnu.geometry.unit_sphere import unit_sphere_frame
from pnu.losses import CompoundLoss
from pnu.networks.pnu import PNU
from pnu.networks.released import from_released

CLOUDS, POINTS, RATIO = 20, 1024, 4
SIZE = f"{CLOUDS} x {POINTS} -> {POINTS * RATIO}"
SEARCHES = {
    "farthest points": (pnu.networks.pnu, "farthest_points"),
    "balls": (pnu.fast.forms, "ball_query"),
    "3 nearest of the network": (pnu.fast.forms, "knn"),
    "k nearest of the loss": (pnu.losses.compound, "knn"),
    "nearest of the loss": (pnu.losses.compound, "nearest"),
}


def _product_flop(_: object, a: tuple[int, int], b: tuple[int, int], **options: object) -> int:
    """Operations of a product (n, k) (k, m) that is added to a matrix in place, which torch's counter leaves out."""
    return 2 * a[0] * a[1] * b[1]


IN_PLACE = {torch.ops.aten.addmm_: _product_flop}


@lru_cache
def data() -> tuple[Tensor, Tensor]:
    """Inputs (20, 1024, 6) and targets (20, 4096, 6): patches of procedural shapes in the unit sphere."""
    generator = np.random.default_rng(0)
    targets = []
    for name in shapes.names()[: CLOUDS // 4]:
        cloud = torch.from_numpy(mesh_sampling.sample_area(shapes.make(name), 5 * POINTS * RATIO, generator)).float()
        targets.append(cloud[patch_extraction.extract(cloud, 4, POINTS * RATIO)])
    target = torch.cat(targets)
    target = target[:, torch.from_numpy(generator.permutation(POINTS * RATIO))]
    target = unit_sphere_frame(target[..., :3]).to_unit(target)
    return target[:, :POINTS].contiguous(), target


def step(
    network: Callable[[Tensor], Tensor],
    loss: nn.Module,
    optimizer: torch.optim.Optimizer,
    batch: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Forward, loss, backward, Adam, on the batch or on `data()`."""
    inputs, target = batch or data()
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

    return _training(accelerate(ours), accelerate(CompoundLoss())), _training(plain, PlainLoss())


def _training(network: nn.Module, loss: nn.Module) -> partial[Tensor]:
    return partial(step, network, loss, torch.optim.Adam(network.parameters(), 1e-3, weight_decay=1e-5))


def loss_of(loss: nn.Module, prediction: Tensor) -> None:
    prediction.grad = None
    loss(prediction, data()[1])["loss"].backward()


def step_rows(rounds: int = 3) -> list[Row]:
    """The step against the plain port, and the data of a step against the step."""
    ours, plain = trainings()
    with TemporaryDirectory() as folder:
        return [
            compare(f"training step, {SIZE}", {"pnu": ours, "plain torch port": plain}, rounds=rounds),
            compare(
                "data of a step: loaded, downsampled, augmented", {"pnu": loading(Path(folder)), "training step": ours}
            ),
        ]


def precision_rows(rounds: int = 3) -> list[Row]:
    """The step in float32 against the same in bfloat16, which a processor with AMX multiplies several times as fast."""
    ours = _training(accelerate(PNU()), accelerate(CompoundLoss()))
    plain = _training(PNU(), CompoundLoss())
    left, right = torch.randn(CLOUDS * POINTS, 512), torch.randn(512, 512)
    product = partial(torch.mm, left, right)
    return [
        compare(
            f"training step, {SIZE}, float32",
            {
                "pnu": ours,
                "trainer.precision=bf16-mixed": _mixed(ours),
                "bf16-mixed, plain modules": _mixed(plain),
                "products in bfloat16": partial(_coarse, ours),
            },
            rounds=rounds,
        ),
        compare("a large product, bfloat16", {"bfloat16": partial(_coarse, product), "float32": product}),
    ]


def _mixed(training: partial[Tensor]) -> partial[Tensor]:
    """The step with network and loss, but not its backward pass, under torch's autocast, as Lightning does it."""
    network, loss, optimizer = training.args
    mixed = torch.autocast("cpu", torch.bfloat16)
    return partial(step, mixed(network.__call__), mixed(loss.__call__), optimizer)


def _coarse(run: Callable[[], Tensor]) -> Tensor:
    """With products of float32 that torch may round to bfloat16."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        return run()
    finally:
        torch.set_float32_matmul_precision(before)


def loading(folder: Path) -> Callable[[], object]:
    """Loads one training batch, as a training does without workers."""
    _, target = data()
    path = folder / "patches.h5"
    with h5py.File(path, "w") as file:
        file["poisson_4096"] = target.repeat(2, 1, 1).numpy()
        file["name"] = [f"shape {i // 4}" for i in range(2 * CLOUDS)]
    module = PatchDataModule(str(path), batch_size=CLOUDS, augmentation={})
    module.setup()
    loader = module.train_dataloader()
    return lambda: next(iter(loader))


def loss_rows(rounds: int = 3) -> list[Row]:
    """The loss alone, with its gradient, against the plain port."""
    _, target = data()
    noise = torch.randn(target.shape, generator=torch.Generator().manual_seed(0))
    prediction = (target + 0.01 * noise).requires_grad_()
    losses = {"pnu": accelerate(CompoundLoss()), "plain torch: full matrices": PlainLoss()}
    runs = {name: partial(loss_of, loss, prediction) for name, loss in losses.items()}
    return [compare(f"compound loss and gradient, {CLOUDS} x {POINTS * RATIO}", runs, rounds=rounds)]


class Profile(NamedTuple):
    """One step on one thread: where its time goes in percent, and the limit beside it."""

    seconds: float
    gflop: float
    gflop_per_second: float  # of a large matrix product
    percent: dict[str, float]

    @property
    def limit(self) -> float:
        """Seconds that the matrix products alone would take."""
        return self.gflop / self.gflop_per_second

    def lines(self) -> list[str]:
        head = (
            f"A step of ours on one thread: {self.seconds:.2f} s. Its {self.gflop:.0f} GFLOP at the "
            f"{self.gflop_per_second:.0f} GFLOP/s of a large matrix product take {self.limit:.2f} s: "
            f"{self.seconds / self.limit:.1f} x the limit."
        )
        return [head, "", "| part | % |", "|---|---|", *(f"| {k} | {v:.1f} |" for k, v in self.percent.items())]


def profile(rounds: int = 3) -> Profile:
    """Our step in turn with a large matrix product, both on one thread."""
    ours, _ = trainings()
    a, b = torch.randn(CLOUDS * POINTS, 512), torch.randn(512, 512)
    with one_thread():
        with FlopCounterMode(display=False, custom_mapping=IN_PLACE) as counter:
            ours()
        row = compare("step", {"step": ours, "product": lambda: [a @ b for _ in range(10)]}, rounds=rounds)
        rate = 10 * 2 * a.numel() * 512 / row.seconds["product"] / 1e9
        return Profile(row.seconds["step"], counter.get_total_flops() / 1e9, rate, shares(ours))


def shares(ours: Callable[[], Tensor]) -> dict[str, float]:
    """Where our step spends its time, in percent."""
    taken = dict.fromkeys(SEARCHES, 0.0)

    def timed(name: str, function: Callable[..., object], *args: object, **options: object) -> object:
        start = time.perf_counter()
        try:
            return function(*args, **options)
        finally:
            taken[name] += time.perf_counter() - start

    with torch_profile(activities=[ProfilerActivity.CPU]) as profiled:
        ours()
    with ExitStack() as stack:
        for name, (module, function) in SEARCHES.items():
            stack.enter_context(patch.object(module, function, partial(timed, name, getattr(module, function))))
        start = time.perf_counter()
        ours()
        total = time.perf_counter() - start
    searches = {name: 100 * seconds / total for name, seconds in taken.items()}
    events = profiled.key_averages()
    everything = sum(event.self_cpu_time_total for event in events)

    def share(*names: str) -> float:
        return 100 * sum(e.self_cpu_time_total for e in events if e.key.removeprefix("aten::") in names) / everything

    parts = {
        "matrix products": share("mm", "addmm", "addmm_"),
        **searches,
        "sums over rows": share("mv", "addmv", "addmv_"),
        "batch norm and ReLU, forward and back": share(
            "maximum", "gt", "addcmul", "relu_", "sub", "square", "pow", "mul_", "add_"
        ),
        "gathers and their gradients": share(
            "index_select", "index", "embedding_bag", "_embedding_bag", "scatter_add_", "index_put_", "cat"
        ),
        "maxima over neighborhoods": share("amax", "eq", "addcmul_"),
    }
    return {**parts, "everything else": 100 - sum(parts.values())}


@contextmanager
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
