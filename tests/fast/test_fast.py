"""Fast forms against plain ones: values and gradients of networks, their parts and the loss; layers chunk by chunk."""

import ast
import copy
import pickle
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path

import pytest
import torch
import torch.distributed
import torch.multiprocessing
from torch import Tensor, nn

import pnu
import pnu.losses
from pnu import networks
from pnu.fast import accelerate, accelerated, cache, fast_forms, forms
from pnu.fast.forms import through
from pnu.fast.neighborhoods import Neighborhoods, distinct, single, whole
from pnu.losses import CompoundLoss
from pnu.networks.layers import MLP, Abstraction, JoinedMLP, PooledMLP, Propagation
from pnu.networks.norm import synchronize
from pnu.networks.pugeo import EdgeConvolution


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Many chunks and two threads, on little data."""
    threads = torch.get_num_threads()
    monkeypatch.setattr(cache, "CHUNK", 1000)
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)


def mlp(*widths: int, bias: bool = True) -> MLP:
    torch.manual_seed(0)
    network = MLP(widths, bias=bias).double()
    for layer in forms.layers_of(network):
        nn.init.normal_(layer.norm.weight)
        nn.init.normal_(layer.norm.bias)
        nn.init.normal_(layer.norm.running_mean)
    return network


def neighbors(clouds: int, m: int, n: int, k: int) -> Tensor:
    """Random neighborhoods (clouds, m, k) of 1 to k distinct points, filled up with copies of the first."""
    found = torch.rand(clouds, m, n).argsort(-1)[..., :k].sort(-1).values
    number = torch.randint(1, k + 1, (clouds, m, 1))
    return torch.where(torch.arange(k) < number, found, found[..., :1])


def run(
    network: MLP, x: Tensor, groups: Neighborhoods | None, projected: bool, gradient: Tensor | None = None
) -> list[Tensor]:
    """Output, gradients of the input and of all parameters but biases, and all statistics after one step."""
    network, x = copy.deepcopy(network), x.clone().requires_grad_()
    rows = x if groups is None or len(groups.source) == len(x) else x[groups.source]
    output = through(network, rows, groups=groups, projected=projected)
    torch.manual_seed(1)
    output.backward(torch.randn_like(output))
    assert x.grad is not None
    values = [output.detach(), x.grad, *network.buffers()]
    return values + [
        p.grad for name, p in network.named_parameters() if "linear.bias" not in name and p.grad is not None
    ]


@pytest.mark.parametrize("projected", [False, True])
@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("grouping", ["none", "whole", "neighbors"])
def test_training_equals_layers(monkeypatch: pytest.MonkeyPatch, grouping: str, bias: bool, projected: bool) -> None:
    network = mlp(7, 16, 12, 20, bias=bias)
    x = torch.randn(3 * 50, 16 if projected else 7, dtype=torch.float64)
    groups = plainly = whole(3, 50) if grouping == "whole" else None
    if grouping == "neighbors":
        idx = neighbors(3, 40, 50, 8)
        groups, plainly = distinct(idx, 50), single(idx, 50)
        assert len(groups.source) < 0.8 * len(plainly.source)
    found = run(network, x, groups, projected)
    monkeypatch.setattr(forms, "streamed", lambda *_: False)
    for a, b in zip(found, run(network, x, plainly, projected), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_equal_maxima_share_the_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one layer, with whole numbers: equal rows have equal products wherever they stand."""
    network, x = mlp(5, 6), torch.randint(-9, 9, (10, 5), dtype=torch.float64).repeat_interleave(2, 0)
    nn.init.constant_(network[0].linear.bias, 0)
    with torch.no_grad():
        network[0].linear.weight.copy_(torch.randint(-9, 9, (6, 5)))
    found = run(network, x, whole(2, 10), False)
    monkeypatch.setattr(forms, "streamed", lambda *_: False)
    for a, b in zip(found, run(network, x, whole(2, 10), False), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found[1][0::2], found[1][1::2])


@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("training", [False, True])
def test_gathered_rows_equal_layers(monkeypatch: pytest.MonkeyPatch, training: bool, depth: int) -> None:
    """Rows that are made where they are needed, of a table and offsets, against rows that are stored."""
    network = mlp(*(7, 16, 12, 20)[: depth + 1]).train(training)
    idx = neighbors(3, 40, 50, 8)
    table = torch.randn(150, 16, dtype=torch.float64, requires_grad=True)
    points = torch.randn(150, 3, dtype=torch.float64, requires_grad=True)

    def both(groups: Neighborhoods) -> list[Tensor]:
        copied = copy.deepcopy(network)
        with torch.set_grad_enabled(training):
            offsets = points[groups.source] - points[groups.owner]
            output = through(copied, table, projected=True, groups=groups, offsets=offsets)
        if not training:
            return [output]
        weight = torch.linspace(-1, 1, output.numel(), dtype=torch.float64).view_as(output)
        parameters = [p for name, p in copied.named_parameters() if "linear.bias" not in name]
        gradients = torch.autograd.grad((output * weight).sum(), [table, points, *parameters])
        return [output.detach(), *gradients, *copied.buffers()]

    found = both(distinct(idx, 50))
    monkeypatch.setattr(forms, "streamed", lambda *_: False)
    for a, b in zip(found, both(single(idx, 50)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("gamma", [0.0, 1e-9, 1e-3, -1e-3, 0.2])
def test_flat_batch_norm(monkeypatch: pytest.MonkeyPatch, gamma: float) -> None:
    """Scales near zero, whose ReLU bends far from the mean of the products."""
    network, x = mlp(5, 8, 6, 7), torch.randn(100, 5, dtype=torch.float64)
    for layer in forms.layers_of(network):
        nn.init.constant_(layer.norm.weight[::2], gamma)
    found = run(network, x, None, False)
    monkeypatch.setattr(forms, "streamed", lambda *_: False)
    for a, b in zip(found, run(network, x, None, False), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)


def test_rows_far_from_zero_keep_their_digits() -> None:
    network, x = mlp(5, 8, 8, 8, 6), torch.randn(300, 5)
    expected = network(x.double())
    accelerate(network.float())
    torch.testing.assert_close(network(x).double(), expected, rtol=0, atol=2e-5)
    torch.testing.assert_close(network(x + 1000).double(), expected, rtol=0, atol=0.02)


@pytest.mark.parametrize("projected", [False, True])
@pytest.mark.parametrize("grouped", [False, True])
def test_inference_equals_layers(grouped: bool, projected: bool) -> None:
    network = mlp(7, 16, 12, 20).eval()
    x = torch.randn(150, 16 if projected else 7, dtype=torch.float64)
    groups = None
    if grouped:
        groups = distinct(neighbors(3, 40, 50, 8), 50)
        x = x[groups.source]
    expected = through(network, x, groups=groups, projected=projected).detach()
    with torch.no_grad():
        torch.testing.assert_close(
            through(network, x, groups=groups, projected=projected), expected, rtol=1e-9, atol=1e-9
        )


def test_gradient_in_eval_mode_reaches_the_input() -> None:
    network, x = mlp(3, 4, 2).eval(), torch.randn(6, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(network, x)


@pytest.mark.parametrize("widths", [(3, 5), (3, 5, 4)])
@pytest.mark.parametrize("way", ["chunks", "layers", "projected", "synchronized"])
def test_one_row_is_refused_and_leaves_the_statistics_alone(tmp_path: Path, way: str, widths: tuple[int, ...]) -> None:
    network = mlp(*widths)
    before = copy.deepcopy(network.state_dict())
    x = torch.randn(1, widths[1] if way == "projected" else 3, dtype=torch.float64)
    if way != "layers":
        accelerate(network)
    if way == "synchronized":
        store = torch.distributed.FileStore(str(tmp_path / "store"), 1)
        torch.distributed.init_process_group("gloo", store=store, rank=0, world_size=1)
        synchronize(network)
    try:
        with pytest.raises(ValueError, match=r"batch norm: expected 2 rows or more in a training step, found 1; raise"):
            through(network, x, projected=True) if way == "projected" else network(x)
        with pytest.raises(ValueError, match="found 1"):
            network[0].norm(torch.randn(1, widths[1], dtype=torch.float64))
    finally:
        if way == "synchronized":
            torch.distributed.destroy_process_group()
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_a_row_that_counts_several_times_has_no_variance_but_statistics() -> None:
    """A ball with one point is filled up with copies of it."""
    network = mlp(3, 5)
    groups = distinct(torch.zeros(1, 1, 8, dtype=torch.long), 1)
    through(network, torch.randn(1, 3, dtype=torch.float64), groups=groups)
    assert all(value.isfinite().all() for value in network.buffers())


def test_eval_mode_takes_one_row() -> None:
    assert accelerate(mlp(3, 5, 4)).eval()(torch.randn(1, 3, dtype=torch.float64)).isfinite().all()


def test_distinct_neighbors() -> None:
    idx = torch.tensor([[[3, 3, 3], [0, 2, 0], [1, 2, 3]]])
    groups = distinct(idx, 4)
    assert groups.runs == [(1, 1), (1, 2), (1, 3)]
    assert groups.source.tolist() == [3, 0, 2, 1, 2, 3]
    assert groups.owner.tolist() == [0, 1, 1, 2, 2, 2]
    assert groups.multiplicity is not None
    assert groups.multiplicity.tolist() == [3, 2, 1, 1, 1, 1]


def _synchronized(rank: int, folder: str, x: Tensor, plainly: bool) -> None:
    """One of two processes, which hold an uneven part each, with synchronized batch norm."""
    store = torch.distributed.FileStore(str(Path(folder) / "store"), 2)
    torch.distributed.init_process_group("gloo", store=store, rank=rank, world_size=2, timeout=timedelta(seconds=60))
    network = synchronize(mlp(7, 16, 12))
    network = network if plainly else accelerate(network)
    part = x[:100] if rank == 0 else x[100:]
    output = network(part)
    output.square().sum().backward()
    gradients = [p.grad for name, p in network.named_parameters() if "linear.bias" not in name]
    for gradient in gradients:
        torch.distributed.all_reduce(gradient)
    torch.save([output.detach(), *gradients, *network.buffers()], Path(folder) / f"{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.parametrize("plainly", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_synchronized_batch_norm(plainly: bool, tmp_path: Path) -> None:
    """Two processes compute what one does with all rows, chunk by chunk or layer by layer."""
    x = torch.randn(150, 7, dtype=torch.float64)
    torch.multiprocessing.spawn(_synchronized, (str(tmp_path), x, plainly), nprocs=2)
    network = mlp(7, 16, 12)
    output = network(x)
    output.square().sum().backward()
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    torch.testing.assert_close(torch.cat([first[0], second[0]]), output.detach())
    gradients = [p.grad for name, p in network.named_parameters() if "linear.bias" not in name]
    for found, expected in zip(first[1:], [*gradients, *network.buffers()], strict=True):
        torch.testing.assert_close(found, expected)


def test_errors_in_threads_are_raised() -> None:
    def fail(part: list[cache.Chunk]) -> None:
        raise RuntimeError(f"chunk {part[0].number}")

    with pytest.raises(RuntimeError, match="chunk 0"):
        cache.map_chunks(fail, cache.row_chunks(100, 100))
    assert torch.get_num_threads() == 2


def cloud(clouds: int, n: int) -> Tensor:
    """Points of a bent sheet with a column of features beside: (clouds, n, 3 + 4)."""
    u, v = torch.rand(2, clouds, n, generator=torch.Generator().manual_seed(n)) * 1.2 - 0.6
    return torch.stack([u, v, 0.4 * u * u - 0.3 * v * v, u - v, u * v, v.sin(), u.cos()], -1)


Part = tuple[nn.Module, Callable[[nn.Module, Tensor], Tensor]]

PARTS: dict[str, Callable[[], Part]] = {
    "MLP": lambda: (MLP((7, 9, 5)), lambda part, x: part(x)),
    "MLP of one layer": lambda: (MLP((7, 5), bias=False), lambda part, x: part(x[:, :, None])),
    "PooledMLP": lambda: (PooledMLP((7, 9, 5)), lambda part, x: part(x)),
    "JoinedMLP": lambda: (JoinedMLP((7 + 4, 9, 5)), lambda part, x: part(x, x.mean(1)[:, 3:])),
    "JoinedMLP without a cloud": lambda: (JoinedMLP((7, 9, 5)), lambda part, x: part(x)),
    "Abstraction": lambda: (
        Abstraction((4, 8, 6), 0.4, k=12),
        lambda part, x: part(x[..., :3], x[..., 3:], x[:, ::3, :3]),
    ),
    "Abstraction without features": lambda: (
        Abstraction((0, 8, 6), 0.05, k=3),
        lambda part, x: part(x[..., :3], x[..., 7:], x[:, :1, :3]),
    ),
    "Propagation": lambda: (
        Propagation(4, 7, 9, 5),
        lambda part, x: part(x[..., :3], x[:, ::2, :3], x, x[:, ::2, 3:]),
    ),
    "Propagation from one point": lambda: (
        Propagation(4, 7, 9),
        lambda part, x: part(x[..., :3], x[:, :1, :3], x, x[:, :1, 3:]),
    ),
    "EdgeConvolution": lambda: (
        EdgeConvolution(7, 5),
        lambda part, x: part(x, torch.arange(x.shape[1])[:, None].expand(len(x), -1, 4).roll(1, 1) % 5),
    ),
}


def values_of(network: nn.Module, run: Callable[[nn.Module], Tensor], *inputs: Tensor) -> dict[str, Tensor]:
    """Output, gradients of parameters and inputs, and statistics; a bias before batch norm has none but rounding."""
    network = copy.deepcopy(network)
    output = run(network)
    values = {"output": output.detach()}
    if output.requires_grad:
        weight = torch.linspace(-1, 1, output.numel(), dtype=output.dtype).sin().view_as(output)
        named = {name: p for name, p in network.named_parameters() if not name.endswith("linear.bias")}
        wanted = {**named, **{f"input {i}": x for i, x in enumerate(inputs)}}
        found = torch.autograd.grad((output * weight).sum(), list(wanted.values()))
        values |= dict(zip(wanted, found, strict=True))
    return values | dict(network.named_buffers())


def assert_equal(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        scale = max(1.0, float(value.abs().max()))
        torch.testing.assert_close(
            found[name], value, rtol=0, atol=tolerance * scale, msg=lambda text, name=name: f"{name}: {text}"
        )


def shaken(network: nn.Module) -> nn.Module:
    """Scales of batch norm of both signs, shifts and running statistics away from their beginnings."""
    generator = torch.Generator().manual_seed(2)
    for name, value in [*network.named_parameters(), *network.named_buffers()]:
        if name.endswith(("norm.weight", "norm.bias", "running_mean")):
            nn.init.normal_(value, 0.2, 1, generator=generator)
    return network


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("mode", ["training", "eval", "eval with gradient"])
@pytest.mark.parametrize(("clouds", "n"), [(1, 16), (3, 50), (2, 201)])
@pytest.mark.parametrize("name", PARTS)
def test_a_fast_part_equals_the_plain_one(name: str, clouds: int, n: int, mode: str, dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    part, run = PARTS[name]()
    part = shaken(part).to(dtype).train(mode == "training")
    x = cloud(clouds, n).to(dtype).requires_grad_(mode != "eval")
    with torch.set_grad_enabled(mode != "eval"):
        expected = values_of(part, lambda network: run(network, x), x)
        fast = accelerate(copy.deepcopy(part))
        assert type(fast) is fast_forms()[type(part)]
        found = values_of(fast, lambda network: run(network, x), x)
    # in float32 batch norm magnifies the rounding of columns that hardly vary, on each processor in another way
    assert_equal(found, expected, 1e-9 if dtype == torch.float64 else 1e-3 if mode == "training" else 1e-4)


@pytest.mark.parametrize("name", PARTS)
def test_a_fast_part_is_as_exact_as_the_plain_one(name: str) -> None:
    """In float32 training, against float64, at the worst of several sizes."""
    worst = {"plain": 0.0, "fast": 0.0}
    for clouds, n in [(1, 16), (3, 50), (2, 201)]:
        torch.manual_seed(0)
        part, run = PARTS[name]()
        x = cloud(clouds, n).double().requires_grad_()
        exact = values_of(shaken(part).double(), lambda network, run=run, x=x: run(network, x), x)
        x = x.detach().float().requires_grad_()
        for form in worst:
            network = accelerate(part.float()) if form == "fast" else part.float()
            found = values_of(network, lambda network, run=run, x=x: run(network, x), x)
            for value, truth in zip(found.values(), exact.values(), strict=True):
                if value.numel():
                    error = (value - truth).abs().max() / truth.abs().max().clamp_min(1)
                    worst[form] = max(worst[form], float(error))
    assert worst["fast"] < 5 * worst["plain"]


NETWORKS = {
    "pnu.PNU": {},
    "pnu_paper.PNUPaper": {"ratio": 2},
    "punet.PUNet": {"ratio": 2},
    "ecnet.ECNet": {"ratio": 2},
    "pugeo.PUGeo": {"ratio": 3},
}


@pytest.mark.parametrize("name", NETWORKS)
def test_a_fast_network_equals_the_plain_one(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(cache, "CHUNK", 2**15)
    torch.manual_seed(0)
    plain = networks.build_network({"_target_": f"pnu.networks.{name}", **NETWORKS[name]}).double()
    patch = torch.cat([cloud(2, 70)[..., :3], nn.functional.normalize(cloud(2, 70)[..., 3:6], dim=-1)], -1).double()
    fast = accelerate(copy.deepcopy(plain))
    assert {type(part) for part in fast.modules()} & fast_forms().keys() == set()

    def everything(network: nn.Module) -> Tensor:
        return torch.cat([value.flatten() for value in network.outputs(patch).values()])

    assert_equal(values_of(fast, everything), values_of(plain, everything), 1e-7)
    with torch.no_grad():
        assert_equal(values_of(fast.eval(), everything), values_of(plain.eval(), everything), 1e-9)


def test_the_switch_changes_classes_alone() -> None:
    network = pnu.load("pnu")
    state = network.state_dict()
    fast = accelerate(network)
    assert fast is network
    assert type(fast.head) is forms.JoinedMLP
    assert isinstance(fast.head, JoinedMLP)
    assert list(fast.state_dict()) == list(state)
    assert all(value.data_ptr() == state[name].data_ptr() for name, value in fast.state_dict().items())
    for copied in (copy.deepcopy(fast), pickle.loads(pickle.dumps(fast)), accelerate(fast)):
        assert [type(part) for part in copied.modules()] == [type(part) for part in fast.modules()]


def test_the_switch_is_off_where_it_is_not_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    network = pnu.load("pnu")
    classes = [type(part) for part in network.modules()]
    with accelerated([network]):
        assert type(network.head) is forms.JoinedMLP
    assert [type(part) for part in network.modules()] == classes
    monkeypatch.setenv("PNU_FAST", "0")
    assert [type(part) for part in accelerate(network).modules()] == classes


def test_training_and_inference_are_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    from pnu.training.lightning_module import UpsamplingModule

    module = UpsamplingModule(networks.build_network({"_target_": "pnu.networks.pnu.PNU"}), CompoundLoss())
    assert type(module.model.local_features.abstractions[0]) is forms.Abstraction
    assert type(module.loss) is fast_forms()[CompoundLoss]
    used = []
    through = forms.through
    monkeypatch.setattr(
        forms, "through", lambda mlp, *args, **options: used.append(mlp) or through(mlp, *args, **options)
    )
    network = networks.build_network({"_target_": "pnu.networks.pnu.PNU", "local_features": False})
    pnu.upsample(cloud(1, 100)[0].double().numpy()[:, :3], ratio=2, model=network)
    assert network.head in used
    assert type(network.head) is JoinedMLP


def test_networks_and_losses_know_nothing_of_fast() -> None:
    """They import from neither `pnu.fast` nor what imports it, and no signature speaks of its tricks."""
    rooms = Path(networks.__file__).parent, Path(pnu.losses.__file__).parent
    for path in (path for room in rooms for path in room.glob("*.py")):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            assert not any("fast" in f"{module}.{name}".split(".") for name in names), f"{path}: {module} {names}"
            if isinstance(node, ast.arg):
                assert node.arg not in {"projected", "groups", "first_weight"}, f"{path}, line {node.lineno}"
