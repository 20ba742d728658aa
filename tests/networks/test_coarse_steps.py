"""The smaller network of the surface model that makes all projections but the last."""

from pathlib import Path

import numpy as np
import pytest
import torch

import pnu
from pnu import weights
from pnu.commands.export import main as export
from pnu.networks import checkpoints
from pnu.networks.compiled_surface import NEAREST, read_compiled
from pnu.networks.surface import Surface
from tests.refusals import refused

TARGET = {"_target_": "pnu.networks.surface.Surface"}


def wavy(n: int) -> np.ndarray:
    """Points and normals (n, 6) of a wavy sheet."""
    u, v = np.random.default_rng(0).uniform(-1, 1, (2, n))
    normals = np.stack([-0.6 * np.cos(3 * u), np.zeros(n), np.ones(n)], 1)
    points = np.stack([u, v, 0.2 * np.sin(3 * u)], 1)
    return np.hstack([points, normals / np.linalg.norm(normals, axis=1, keepdims=True)])


def surface(coarse: int, *, neighbors: int = 24, width: int = 16, seed: int = 0) -> Surface:
    """With weights at random in the last layers too."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = Surface(width=width, neighbors=neighbors, reach=neighbors, coarse=coarse, queries=12)
        for part in (network, network.coarse):
            if part is not None:
                torch.nn.init.normal_(part.projector.out.weight, std=0.02)
    return network.eval()


def test_both_networks_learn_and_the_prediction_is_the_larger_ones() -> None:
    network, patch = surface(8).train(), torch.from_numpy(wavy(80)[None]).float()
    alone = surface(0)
    alone.load_state_dict({k: v for k, v in network.state_dict().items() if not k.startswith("coarse.")})
    found, expected = network.outputs(patch), alone.outputs(patch)
    assert found["projected"].shape == (4, 1, 12, 6)
    torch.testing.assert_close(found["projected"][2:], expected["projected"])
    assert torch.equal(found["prediction"], found["projected"][-1])
    assert torch.equal(found["query"][0], found["query"][2])  # both begin at the seeds
    found["projected"].square().sum().backward()
    grads = {name: value.grad for name, value in network.named_parameters()}
    assert all(grads[f"{part}projector.first.weight"].abs().sum() > 0 for part in ("", "coarse."))


def test_the_larger_network_makes_the_last_step_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PNU_FAST", "0")
    network, seen = surface(8), {8: 0, 16: 0}
    project = Surface.project

    def counted(self: Surface, query: torch.Tensor, *rest: torch.Tensor) -> tuple[torch.Tensor, ...]:
        if self.projector.out.in_features in seen:  # not what judges given normals
            seen[self.projector.out.in_features] += query.shape[1]
        return project(self, query, *rest)

    monkeypatch.setattr(Surface, "project", counted)
    cloud = wavy(300)
    pnu.upsample(cloud, ratio=4, model=network, outliers="keep", keep=False)
    made = round(1200 * (1 + network.reject))
    moved = seen[16] - made  # to places without points
    assert 0 <= moved < 60
    assert seen[8] == round(1200 * 1.15) + made


def test_compiled_and_plain_steps_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled: None) -> None:
    network, file = surface(8), tmp_path / "a.safetensors"
    weights.write(file, TARGET | {**settings(network), "coarse": 8}, network.state_dict())
    read = read_compiled(file)
    assert read is not None
    assert read.coarse is not None
    names = {name.replace("projector.", "") for name in network.state_dict()}
    assert read.state_dict().keys() == names
    cloud = wavy(300)
    fast = pnu.upsample(cloud, ratio=4, model=str(file))
    monkeypatch.setenv("PNU_FAST", "0")
    plain = pnu.upsample(cloud, ratio=4, model=str(file))
    assert (np.abs(fast - plain).max(1) < 1e-5).mean() > 0.98  # a tie that falls otherwise moves a point


def settings(network: Surface) -> dict[str, object]:
    """What the file says of a network, beside its target and the coarse one."""
    names = ("ratio", "neighbors", "reach", "rounds", "seeds", "candidates", "shortlist", "relaxation", "refinements")
    own = {name: getattr(network, name) for name in (*names, "reject", "slide", "queries", "passes")}
    return own | {"width": 16, "smoothing": 0.0, "refining": 0.0, "sphere": True, "attention": True}


@pytest.mark.parametrize("said", [0, 8])
def test_what_a_file_says_and_has_must_agree(tmp_path: Path, compiled: None, said: int) -> None:
    network, file = surface(8 - said), tmp_path / "a.safetensors"
    weights.write(file, TARGET | {**settings(network), "coarse": said}, network.state_dict())
    assert read_compiled(file) is None
    with pytest.raises(ValueError, match="expected the state of Surface with the arguments of its config"):
        checkpoints.load(file)


def test_a_training_begins_with_weights_that_have_coarse_steps_or_none() -> None:
    with_some, without = surface(8, seed=1), surface(0, seed=2)
    new = {name: value.clone() for name, value in with_some.coarse.state_dict().items()}  # type: ignore[union-attr]
    checkpoints.start_from(with_some, without, "without")
    for name, value in without.state_dict().items():
        assert torch.equal(with_some.state_dict()[name], value)
    for name, value in new.items():
        assert torch.equal(with_some.state_dict()[f"coarse.{name}"], value)
    third = surface(0, seed=3)
    checkpoints.start_from(third, with_some, "with")
    assert all(torch.equal(third.state_dict()[name], value) for name, value in without.state_dict().items())
    both = surface(8, seed=4)
    checkpoints.start_from(both, with_some, "with")
    assert all(torch.equal(both.state_dict()[name], value) for name, value in with_some.state_dict().items())
    with pytest.raises(ValueError, match="other: expected the state of Surface"):
        checkpoints.start_from(both, surface(8, width=8), "other")


def test_exported_with_a_smaller_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    small = surface(0, neighbors=NEAREST, width=8, seed=1)
    file = TARGET | settings(small) | {"width": 8}
    weights.write("small.safetensors", file, small.state_dict())
    export(["run=surface", "coarse=small.safetensors", "output=both.safetensors", "quiet=true"])
    both, before = checkpoints.load("both.safetensors"), checkpoints.load("surface")
    assert isinstance(both, Surface)
    assert both.coarse_width == 8
    for name, value in small.state_dict().items():
        assert torch.equal(both.state_dict()[f"coarse.{name}"], value)
        assert torch.equal(both.state_dict()[name], before.state_dict()[name])
    again = surface(0, neighbors=12, width=8)
    weights.write("other.safetensors", file | {"neighbors": 12, "reach": 12}, again.state_dict())
    other = ["run=surface", "coarse=other.safetensors", "output=both.safetensors"]
    assert "coarse: expected a surface model with neighbors and reach of 16" in refused(capsys, export, other)
    other = ["run=pnu", "coarse=small.safetensors", "output=both.safetensors"]
    assert "coarse: PNU has no coarse steps; leave it out" in refused(capsys, export, other)
