"""Layers chunk by chunk against the same layers one by one."""

import copy
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
import torch
import torch.distributed
import torch.multiprocessing
from torch import Tensor, nn

from pnu.models import chunks, layers
from pnu.models.layers import MLP
from pnu.models.neighborhoods import Groups, distinct, single, whole
from pnu.models.norm import synchronize


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Many chunks and two threads, on little data."""
    threads = torch.get_num_threads()
    monkeypatch.setattr(chunks, "CHUNK", 1000)
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)


def mlp(*widths: int, bias: bool = True) -> MLP:
    torch.manual_seed(0)
    network = MLP(widths, bias=bias).double()
    for layer in network.layers:
        nn.init.normal_(layer.norm.weight)
        nn.init.normal_(layer.norm.bias)
        nn.init.normal_(layer.norm.running_mean)
    return network


def neighbors(clouds: int, m: int, n: int, k: int) -> Tensor:
    """Random neighbourhoods (clouds, m, k) of 1 to k distinct points, filled up with copies of the first."""
    found = torch.rand(clouds, m, n).argsort(-1)[..., :k].sort(-1).values
    number = torch.randint(1, k + 1, (clouds, m, 1))
    return torch.where(torch.arange(k) < number, found, found[..., :1])


def run(
    network: MLP, x: Tensor, groups: Groups | None, projected: bool, gradient: Tensor | None = None
) -> list[Tensor]:
    """Output, gradients of the input and of all parameters but biases, and all statistics after one step."""
    network, x = copy.deepcopy(network), x.clone().requires_grad_()
    rows = x if groups is None or len(groups.source) == len(x) else x[groups.source]
    output = network(rows, groups=groups, projected=projected)
    torch.manual_seed(1)
    output.backward(torch.randn_like(output))
    assert x.grad is not None
    values = [output.detach(), x.grad, *network.buffers()]
    return values + [
        p.grad for name, p in network.named_parameters() if "linear.bias" not in name and p.grad is not None
    ]


@pytest.mark.parametrize("projected", [False, True])
@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("grouping", ["none", "whole", "neighbours"])
def test_training_equals_layers(monkeypatch: pytest.MonkeyPatch, grouping: str, bias: bool, projected: bool) -> None:
    network = mlp(7, 16, 12, 20, bias=bias)
    x = torch.randn(3 * 50, 16 if projected else 7, dtype=torch.float64)
    groups = plainly = whole(3, 50) if grouping == "whole" else None
    if grouping == "neighbours":
        idx = neighbors(3, 40, 50, 8)
        groups, plainly = distinct(idx, 50), single(idx, 50)
        assert len(groups.source) < 0.8 * len(plainly.source)
    found = run(network, x, groups, projected)
    monkeypatch.setattr(layers, "streamed", lambda *_: False)
    for a, b in zip(found, run(network, x, plainly, projected), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_equal_maxima_share_the_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    network, x = mlp(5, 8, 6), torch.randn(10, 5, dtype=torch.float64).repeat_interleave(2, 0)
    found = run(network, x, whole(2, 10), False)
    monkeypatch.setattr(layers, "streamed", lambda *_: False)
    for a, b in zip(found, run(network, x, whole(2, 10), False), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found[1][0::2], found[1][1::2])


@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("training", [False, True])
def test_differences_of_tables_equal_layers(monkeypatch: pytest.MonkeyPatch, training: bool, depth: int) -> None:
    """Rows that are made where they are needed, of points and centres, against rows that are stored."""
    network = mlp(*(7, 16, 12, 20)[: depth + 1]).train(training)
    idx = neighbors(3, 40, 50, 8)
    table = torch.randn(150, 16, dtype=torch.float64, requires_grad=True)
    centers = torch.randn(120, 16, dtype=torch.float64, requires_grad=True)

    def both(groups: Groups) -> list[Tensor]:
        copied = copy.deepcopy(network)
        with torch.set_grad_enabled(training):
            output = copied(table, projected=True, groups=groups, centers=centers)
        if not training:
            return [output]
        weight = torch.linspace(-1, 1, output.numel(), dtype=torch.float64).view_as(output)
        parameters = [
            p for name, p in copied.named_parameters() if "linear.bias" not in name and name != "0.linear.weight"
        ]
        gradients = torch.autograd.grad((output * weight).sum(), [table, centers, *parameters])
        return [output.detach(), *gradients, *copied.buffers()]

    found = both(distinct(idx, 50))
    monkeypatch.setattr(layers, "streamed", lambda *_: False)
    for a, b in zip(found, both(single(idx, 50)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("gamma", [0.0, 1e-9, 1e-3, -1e-3, 0.2])
def test_flat_batch_norm(monkeypatch: pytest.MonkeyPatch, gamma: float) -> None:
    """Scales near zero, whose ReLU bends far from the mean of the products."""
    network, x = mlp(5, 8, 6, 7), torch.randn(100, 5, dtype=torch.float64)
    for layer in network.layers:
        nn.init.constant_(layer.norm.weight[::2], gamma)
    found = run(network, x, None, False)
    monkeypatch.setattr(layers, "streamed", lambda *_: False)
    for a, b in zip(found, run(network, x, None, False), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)


def test_rows_far_from_zero_keep_their_digits() -> None:
    network, x = mlp(5, 8, 8, 8, 6), torch.randn(300, 5)
    expected = network(x.double())
    network.float()
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
    expected = network(x, groups=groups, projected=projected).detach()
    with torch.no_grad():
        torch.testing.assert_close(network(x, groups=groups, projected=projected), expected, rtol=1e-9, atol=1e-9)


def test_gradient_in_eval_mode_reaches_the_input() -> None:
    network, x = mlp(3, 4, 2).eval(), torch.randn(6, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(network, x)


@pytest.mark.parametrize("widths", [(3, 5), (3, 5, 4)])
@pytest.mark.parametrize("way", ["chunks", "layers", "projected", "synchronized"])
def test_one_row_is_refused_and_leaves_the_statistics_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, way: str, widths: tuple[int, ...]
) -> None:
    network = mlp(*widths)
    before = copy.deepcopy(network.state_dict())
    x = torch.randn(1, widths[1] if way == "projected" else 3, dtype=torch.float64)
    if way == "layers":
        monkeypatch.setattr(layers, "streamed", lambda *_: False)
    if way == "synchronized":
        store = torch.distributed.FileStore(str(tmp_path / "store"), 1)
        torch.distributed.init_process_group("gloo", store=store, rank=0, world_size=1)
        synchronize(network)
    try:
        with pytest.raises(ValueError, match=r"batch norm: expected 2 rows or more in a training step, found 1; raise"):
            network(x, projected=way == "projected")
        with pytest.raises(ValueError, match="found 1"):
            network.layers[0].norm(torch.randn(1, widths[1], dtype=torch.float64))
    finally:
        if way == "synchronized":
            torch.distributed.destroy_process_group()
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_a_row_that_counts_several_times_has_no_variance_but_statistics() -> None:
    """A ball with one point is filled up with copies of it."""
    network = mlp(3, 5)
    groups = distinct(torch.zeros(1, 1, 8, dtype=torch.long), 1)
    network(torch.randn(1, 3, dtype=torch.float64), groups=groups)
    assert all(value.isfinite().all() for value in network.buffers())


def test_eval_mode_takes_one_row() -> None:
    assert mlp(3, 5, 4).eval()(torch.randn(1, 3, dtype=torch.float64)).isfinite().all()


def test_distinct_neighbours() -> None:
    idx = torch.tensor([[[3, 3, 3], [0, 2, 0], [1, 2, 3]]])
    groups = distinct(idx, 4)
    assert groups.runs == [(1, 1), (1, 2), (1, 3)]
    assert groups.source.tolist() == [3, 0, 2, 1, 2, 3]
    assert groups.owner.tolist() == [0, 1, 1, 2, 2, 2]
    assert groups.multiplicity is not None
    assert groups.multiplicity.tolist() == [3, 2, 1, 1, 1, 1]


def _synchronised(rank: int, folder: str, x: Tensor, plainly: bool) -> None:
    """One of two processes, which hold an uneven part each, with synchronised batch norm."""
    store = torch.distributed.FileStore(str(Path(folder) / "store"), 2)
    torch.distributed.init_process_group("gloo", store=store, rank=rank, world_size=2, timeout=timedelta(seconds=60))
    network = synchronize(mlp(7, 16, 12))
    part = x[:100] if rank == 0 else x[100:]
    output = nn.Sequential.forward(network, part) if plainly else network(part)
    output.square().sum().backward()
    gradients = [p.grad for name, p in network.named_parameters() if "linear.bias" not in name]
    for gradient in gradients:
        torch.distributed.all_reduce(gradient)
    torch.save([output.detach(), *gradients, *network.buffers()], Path(folder) / f"{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.parametrize("plainly", [False, True])
def test_synchronised_batch_norm(plainly: bool, tmp_path: Path) -> None:
    """Two processes compute what one does with all rows, chunk by chunk or layer by layer."""
    x = torch.randn(150, 7, dtype=torch.float64)
    torch.multiprocessing.spawn(_synchronised, (str(tmp_path), x, plainly), nprocs=2)
    network = mlp(7, 16, 12)
    output = network(x)
    output.square().sum().backward()
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    torch.testing.assert_close(torch.cat([first[0], second[0]]), output.detach())
    gradients = [p.grad for name, p in network.named_parameters() if "linear.bias" not in name]
    for found, expected in zip(first[1:], [*gradients, *network.buffers()], strict=True):
        torch.testing.assert_close(found, expected)


def test_errors_in_threads_are_raised() -> None:
    def fail(part: list[chunks.Chunk]) -> None:
        raise RuntimeError(f"chunk {part[0].number}")

    with pytest.raises(RuntimeError, match="chunk 0"):
        chunks.spread(fail, chunks.row_chunks(100, 100))
    assert torch.get_num_threads() == 2
