"""What the points of a cloud tell those that look at them, in the surface model."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from pnu import weights
from pnu.fast.compiled_projector import compiled_projection
from pnu.geometry.neighbor_search import Search
from pnu.networks import checkpoints
from pnu.networks.compiled_surface import read_compiled
from pnu.networks.surface import FEATURES, OUT, TOLD, Surface
from pnu.upsamplers.context import Context
from pnu.upsamplers.surface_projection import SurfaceProjection
from tests.networks.test_coarse_steps import wavy


def network(messages: int = 8, *, passes: int = 2, width: int = 16, neighbors: int = 12) -> Surface:
    """With weights at random in the last layer and where messages come in."""
    with torch.random.fork_rng():
        torch.manual_seed(messages)
        surface = Surface(
            width=width, neighbors=neighbors, reach=neighbors, messages=messages, passes=passes, queries=30
        )
        nn.init.normal_(surface.projector.out.weight, std=0.02)
        nn.init.normal_(surface.projector.out.weight[OUT:], std=0.5)
        nn.init.normal_(surface.projector.first.weight[:, FEATURES:], std=0.3)
    return surface.eval().requires_grad_(False)


def cloud_of(n: int, messages: int) -> Tensor:
    told = np.random.default_rng(1).uniform(-1, 1, (n, messages))
    return torch.from_numpy(np.hstack([wavy(n), told]))


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("width", [64, 20])
@pytest.mark.parametrize("messages", [1, 8, 9, 12])
def test_compiled_steps_equal_the_networks(messages: int, width: int) -> None:
    """Also of a cloud that tells nothing yet."""
    surface, cloud = network(messages, width=width), cloud_of(200, messages)
    query = cloud[:35, :6] + 0.01
    idx = Search(cloud[:, :3]).knn(query[:, :3], 12).idx
    compiled = compiled_projection(surface)
    assert compiled is not None
    for told in (cloud, cloud[:, :6].contiguous()):
        found = compiled(query.numpy(), told.numpy(), idx.numpy())
        projected, log_error, spacing = surface.project(query[None], told[None], idx[None])
        np.testing.assert_allclose(found[:, :6], projected[0, :, :6], atol=1e-5)
        np.testing.assert_allclose(found[:, 6], (log_error + spacing.log())[0], atol=1e-4)
        np.testing.assert_allclose(found[:, OUT:], projected[0, :, 6:], atol=1e-5)
        assert found.shape == (35, OUT + messages)


@pytest.mark.parametrize("passes", [0, 2])
def test_whole_clouds_are_the_same_without_kernels(monkeypatch: pytest.MonkeyPatch, passes: int) -> None:
    surface, cloud = network(passes=passes), wavy(300)
    upsampler, found = SurfaceProjection(surface), []
    for fast in ("1", "0"):
        monkeypatch.setenv("PNU_FAST", fast)
        with torch.no_grad():
            told = upsampler.with_refined_normals(cloud, passes, Context())
        found.append((told, upsampled(surface, cloud, 900)))
    (told, dense), (plain_told, plain_dense) = found
    np.testing.assert_allclose(told, plain_told, atol=1e-4)
    assert (np.abs(dense - plain_dense).max(1) < 1e-4).mean() > 0.95  # a tie that falls otherwise moves a point


def test_given_normals_stay_and_found_ones_are_told_with_messages() -> None:
    cloud = wavy(200)
    given = SurfaceProjection(network(passes=0)).with_refined_normals(cloud, 0, Context())
    np.testing.assert_array_equal(given[:, :6], cloud)
    found = SurfaceProjection(network(passes=2)).with_refined_normals(cloud, 2, Context())
    np.testing.assert_array_equal(found[:, :3], cloud[:, :3])
    assert np.abs(found[:, 3:6] - cloud[:, 3:]).max() > 1e-3
    for told in (given[:, 6:], found[:, 6:]):
        assert told.shape == (200, 8)
        assert np.abs(told).max() <= 1
        assert told.std(0).min() > 1e-5


def test_what_is_told_does_not_depend_on_place_turn_or_size() -> None:
    cloud, turn = wavy(200), Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    upsampler = SurfaceProjection(network().double())
    moved = np.hstack([3 * cloud[:, :3] @ turn.T + [5, -2, 1], cloud[:, 3:] @ turn.T])
    told, of_moved = (upsampler.with_refined_normals(each, 2, Context()) for each in (cloud, moved))
    np.testing.assert_allclose(of_moved[:, 6:], told[:, 6:], atol=1e-8)
    np.testing.assert_allclose(of_moved[:, 3:6], told[:, 3:6] @ turn.T, atol=1e-8)


def upsampled(surface: Surface, cloud: np.ndarray, count: int) -> np.ndarray:
    with torch.no_grad():
        return SurfaceProjection(surface).upsample_cloud(cloud, count, Context())


def test_at_first_nobody_listens() -> None:
    """A network that was not trained does as one without messages."""
    torch.manual_seed(0)
    told = Surface(messages=8, passes=1).eval()
    plain = Surface(passes=1).eval()
    state = told.state_dict()
    state["projector.first.weight"] = state["projector.first.weight"][:, :FEATURES]
    state["projector.out.weight"] = state["projector.out.weight"][:OUT]
    state["projector.out.bias"] = state["projector.out.bias"][:OUT]
    plain.load_state_dict(state)
    for found in (upsampled(model, wavy(300), 900) for model in (told, plain)):
        np.testing.assert_allclose(found, upsampled(plain, wavy(300), 900), atol=1e-6)


def test_a_training_begins_with_weights_of_fewer_messages() -> None:
    more, less = (Surface(messages=messages, passes=1).eval() for messages in (8, 3))
    nn.init.normal_(less.projector.out.weight, std=0.02)
    nn.init.normal_(less.projector.first.weight, std=0.2)
    checkpoints.start_from(more, less, "less")
    cloud = wavy(200)
    found, expected = (SurfaceProjection(model).with_refined_normals(cloud, 1, Context()) for model in (more, less))
    np.testing.assert_allclose(found[:, :9], expected, atol=1e-6)
    np.testing.assert_allclose(upsampled(more, cloud, 600), upsampled(less, cloud, 600), atol=1e-5)


def test_a_training_begins_with_weights_of_more_messages() -> None:
    """Those beyond are told no more: `ablation=surface_estimated` switches them off so."""
    less, more = network(3), network(8)
    checkpoints.start_from(less, more, "more")
    mine, its = less.projector, more.projector
    assert torch.equal(mine.first.weight, its.first.weight[:, : FEATURES + 3])
    assert torch.equal(mine.out.weight, its.out.weight[: OUT + 3])
    with pytest.raises(ValueError, match="^wide: expected the state of Surface with the arguments of its config"):
        checkpoints.start_from(less, network(8, width=24), "wide")


@pytest.mark.parametrize("passes", [0, 1, 2])
def test_training_learns_what_to_tell(passes: int) -> None:
    surface = network(passes=passes).train().requires_grad_(True)
    patch = torch.from_numpy(wavy(80)[None]).float()
    found = surface.outputs(patch)
    rounds = max(1, passes)
    assert found["projected"].shape == (rounds + surface.rounds, 1, 30, 6)
    torch.testing.assert_close(found["query"][0], patch[:, :30])  # the points themselves
    assert torch.equal(found["prediction"], found["projected"][-1])
    found["projected"][-1].square().sum().backward()
    first, out = surface.projector.first.weight.grad, surface.projector.out.weight.grad
    assert first is not None
    assert out is not None
    assert first[:, FEATURES:].abs().sum() > 0
    assert (out[OUT:].abs().sum(1) > 0).all()


def test_points_whose_neighbors_are_cut_off_tell_nothing() -> None:
    surface = network()
    patch = torch.from_numpy(wavy(80)[None]).float()
    told = surface.with_messages(patch, [])
    inner = round(TOLD * 80)
    assert (told[:, :inner, 6:] != 0).all()
    assert (told[:, inner:, 6:] == 0).all()
    assert torch.equal(told[:, inner:, :6], patch[:, inner:])


@pytest.mark.usefixtures("compiled")
def test_files_say_how_many_numbers_are_told(tmp_path: Path) -> None:
    settings = vars(Surface(width=16, neighbors=12, reach=12, passes=2))
    names = ("ratio", "neighbors", "reach", "rounds", "seeds", "candidates", "shortlist", "relaxation", "refinements")
    model = {name: settings[name] for name in (*names, "reject", "slide", "queries", "passes", "fine")}
    model |= {"_target_": "pnu.networks.surface.Surface", "width": 16, "sphere": True, "attention": True}
    surface = network()
    for messages, taken in ((8, True), (7, False), (0, False), (-1, False), ("8", False)):
        weights.write(tmp_path / "a.safetensors", model | {"messages": messages}, surface.state_dict())
        found = read_compiled(tmp_path / "a.safetensors")
        assert (found is not None) == taken
    with pytest.raises(ValueError, match=r"^model\.messages=-1: expected 0 or more$"):
        Surface(messages=-1)
