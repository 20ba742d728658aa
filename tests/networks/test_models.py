"""Networks: the released reference, the plain port, shapes, switches, bad input."""

import importlib.util
import itertools
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from reference import ball_query
from torch import Tensor, nn

from pnu.fast import accelerate
from pnu.networks import build_network
from pnu.networks.pnu import PNU, levels
from pnu.networks.pnu_paper import RADII, PNUPaper
from pnu.networks.released import from_released


@pytest.fixture(scope="session")
def plain() -> ModuleType:
    """bench/plain.py, the slow and plain port of the released network and loss."""
    path = Path(__file__).resolve().parents[2] / "bench" / "plain.py"
    spec = importlib.util.spec_from_file_location("plain", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def patches(clouds: int, n: int, seed: int = 0) -> Tensor:
    """Patches (clouds, n, 6) of random points on a bent sheet with unit normals, in the unit sphere."""
    generator = torch.Generator().manual_seed(seed)
    u, v = torch.rand(2, clouds, n, generator=generator) * 1.3 - 0.65
    normals = nn.functional.normalize(torch.stack([-0.8 * u, 0.6 * v, torch.ones_like(u)], -1), dim=-1)
    return torch.cat([torch.stack([u, v, 0.4 * u * u - 0.3 * v * v], -1), normals], -1)


def test_released_reference(shared: Path) -> None:
    reference = np.load(shared / "reference/released_reference.npz")
    state = {name[6:]: torch.as_tensor(reference[name]) for name in reference if name.startswith("state/")}
    network = PNU().eval()
    network.load_state_dict(from_released(state))
    expected = torch.from_numpy(reference["output"])
    patch = torch.from_numpy(reference["input"])
    torch.testing.assert_close(network(patch), expected, rtol=0, atol=1e-6)
    with torch.no_grad():  # layers in chunks, batch norm folded
        torch.testing.assert_close(accelerate(network)(patch), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(network(patch), expected, rtol=0, atol=1e-6)  # layers one by one


@pytest.mark.parametrize("fast", [False, True])
def test_training_equals_plain_port(plain: ModuleType, fast: bool) -> None:
    """Output, gradient of every parameter and running statistics of one step, in float64."""
    torch.manual_seed(0)
    peer = plain.PlainPNU().double()
    for module in peer.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            nn.init.normal_(module.weight, 0.5)  # some negative: the maximum becomes a minimum
            nn.init.normal_(module.bias, std=0.2)
    network = accelerate(PNU().double()) if fast else PNU().double()
    network.load_state_dict(from_released(peer.state_dict()))
    patch = patches(3, 160).double()
    expected, output = peer(patch), network(patch)
    torch.testing.assert_close(output, expected, rtol=1e-8, atol=1e-8)
    gradient = torch.randn(output.shape, dtype=output.dtype)
    expected.backward(gradient)
    output.backward(gradient)
    gradients = from_released({name: parameter.grad for name, parameter in peer.named_parameters()})
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(
            parameter.grad, gradients[name], rtol=1e-6, atol=1e-7, msg=lambda m, n=name: f"{n}: {m}"
        )
    statistics = from_released(peer.state_dict())
    for name, value in network.named_buffers():
        torch.testing.assert_close(value, statistics[name], rtol=1e-9, atol=1e-9)


def test_paper_features_are_maxima_over_radii() -> None:
    torch.manual_seed(0)
    network = PNUPaper().eval()
    patch = patches(1, 70)
    points, features = patch[0, :, :3], patch[0, :, 3:]
    expected = torch.full((70, 128), -torch.inf)
    for radius in RADII:
        neighbors = ball_query(points.numpy(), points.numpy(), radius, 32)
        for i in range(70):
            rows = torch.cat([(points[neighbors[i]] - points[i]) / radius, features[neighbors[i]]], -1)
            for layer in network.local_features.abstraction.mlp:
                rows = layer(rows)
            expected[i] = torch.maximum(expected[i], rows.amax(0))
    with torch.no_grad():
        found = network.local_features(patch)[0]
    torch.testing.assert_close(found, expected.detach(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["pnu.PNU", "pnu_paper.PNUPaper"])
@pytest.mark.parametrize("ratio", [2, 4, 8, 16])
@pytest.mark.parametrize("n", [64, 101])
def test_shapes(name: str, ratio: int, n: int) -> None:
    network = build_network({"_target_": f"pnu.networks.{name}", "ratio": ratio})
    assert network.ratio == ratio
    output = network(patches(2, n))
    assert output.shape == (2, n * ratio, 6)
    assert output.std(1).min() > 1e-4  # points differ
    output.sum().backward()
    assert all(parameter.grad is not None for parameter in network.parameters())


@pytest.mark.parametrize("network", [PNU, PNUPaper])
def test_switches(network: type[PNU]) -> None:
    patch = patches(2, 64)
    blind = network(input_normals=False).eval()
    changed = torch.cat([patch[..., :3], -patch[..., 3:]], -1)
    torch.testing.assert_close(blind(patch), blind(changed), rtol=0, atol=0)
    torch.testing.assert_close(blind(patch), blind(patch[..., :3]), rtol=0, atol=0)
    seeing = network().eval()
    assert not torch.allclose(seeing(patch), seeing(changed))
    points = network(predict_normals=False)
    assert points(patch).shape == (2, 256, 3)
    assert not points.predicts_normals
    local, both = network(global_features=False), network()
    assert local(patch).shape == (2, 256, 6)
    assert not any(name.startswith("global") for name, _ in local.named_parameters())
    assert both.head[0].linear.in_features == local.head[0].linear.in_features + 512
    assert set(both.outputs(patch)) == {"prediction"}


@pytest.mark.parametrize("network", [PNU, PNUPaper])
@pytest.mark.parametrize(("switched_off", "given"), [("", 6), ("predict_normals", 3), ("input_normals", 3)])
def test_residual_adds_to_the_input(network: type[PNU], switched_off: str, given: int) -> None:
    patch = patches(2, 64)
    options = {switched_off: False} if switched_off else {}
    plain, added = network(**options).eval(), network(**options, residual=True).eval()
    added.load_state_dict(plain.state_dict())
    difference = (added(patch) - plain(patch)).view(2, 4, 64, -1)
    torch.testing.assert_close(difference[..., :given], patch[:, None, :, :given].expand(-1, 4, -1, -1))
    torch.testing.assert_close(difference[..., given:], torch.zeros_like(difference[..., given:]))


def test_new_points_stand_in_blocks() -> None:
    """Without local features a permutation of the input permutes each block of n outputs."""
    network = PNU(local_features=False).eval()
    patch, order = patches(1, 64), torch.randperm(64)
    blocks = network(patch).view(4, 64, 6)
    torch.testing.assert_close(network(patch[:, order]).view(4, 64, 6), blocks[:, order])


def test_steps_are_repeatable() -> None:
    """The same bits in every run, whatever the system does with the threads."""

    def gradients() -> list[Tensor]:
        torch.manual_seed(0)
        network = accelerate(PNU())
        network(patches(3, 128)).square().mean().backward()
        return [parameter.grad for parameter in network.parameters() if parameter.grad is not None]

    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        first = gradients()
        for _ in range(2):
            assert all(torch.equal(a, b) for a, b in zip(first, gradients(), strict=True))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("fast", [False, True])
def test_mixed_precision(fast: bool) -> None:
    torch.manual_seed(0)
    network, patch = accelerate(PNU()) if fast else PNU(), patches(2, 64)
    with torch.autocast("cpu", torch.bfloat16):
        output = network(patch)
    output.float().square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())
    network.eval()
    with torch.no_grad():
        expected = network(patch)
        with torch.autocast("cpu", torch.bfloat16):
            assert (network(patch) - expected).norm() < 0.05 * expected.norm()


def test_bad_input() -> None:
    with pytest.raises(ValueError, match=r"patch: expected \(B, n >= 64, 6\), got \(1, 63, 6\)"):
        PNU()(torch.zeros(1, 63, 6))
    with pytest.raises(ValueError, match=r"got \(1, 64, 3\)"):
        PNU()(torch.zeros(1, 64, 3))
    with pytest.raises(ValueError, match=r"model.ratio: expected 2, 4, 8 or 16, got 3"):
        PNU(ratio=3)


@pytest.mark.parametrize(
    ("target", "text"),
    [
        ("os.system", "expected a class below pnu.networks, such as pnu.networks.pnu.PNU, got 'os.system'"),
        ("pnu.networks.nothing.PNU", "'pnu.networks.nothing.PNU' is no network of this version"),
        ("pnu.networks.pnu.PNUU", "'pnu.networks.pnu.PNUU' is no network"),
        ("pnu.networks.pnu.torch", "is no network"),
        ("pnu.networks.layers.nn.Linear", "is no network"),
        ("", "got ''"),
    ],
)
def test_build_only_networks(target: str, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        build_network({"_target_": target})


def test_older_targets_are_built() -> None:
    """Run folders and weights from before `pnu.networks` had its name say `pnu.models`."""
    assert type(build_network({"_target_": "pnu.models.pnu.PNU", "ratio": 2})) is PNU
    with pytest.raises(ValueError, match="'pnu.networks.layers.torch' is no network"):
        build_network({"_target_": "pnu.models.layers.torch"})


def test_build_arguments() -> None:
    with pytest.raises(ValueError, match="PNU does not accept these arguments: .*'depth'"):
        build_network({"_target_": "pnu.networks.pnu.PNU", "depth": 3})
    assert isinstance(build_network({"_target_": "pnu.networks.pnu_paper.PNUPaper", "ratio": 2}), PNUPaper)


def test_released_names() -> None:
    with pytest.raises(ValueError, match="expected the names of the released network, found 'head.weight'"):
        from_released({"head.weight": torch.zeros(1)})
    with pytest.raises(ValueError, match="expected a tensor for 'UPSAMPLING_module.0.weight', found float"):
        from_released({"UPSAMPLING_module.0.weight": 1.0})  # type: ignore[dict-item]
    value = torch.arange(4.0)
    assert from_released({"module.UPSAMPLING_module.7.bias": value})["head.2.norm.bias"].tolist() == [0, 2, 1, 3]


def test_levels_are_nested() -> None:
    points = patches(2, 256)[..., :3] + 1  # none near the origin, where none are taken
    first, *others = levels(points, 4)
    assert torch.equal(first, points)
    assert [level.shape[1] for level in others] == [256, 64, 16, 4]
    assert torch.equal(others[0].sort(1).values, points.sort(1).values)
    for finer, level in itertools.pairwise(others):
        assert torch.equal(finer[:, : level.shape[1]], level)
