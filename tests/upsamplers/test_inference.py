"""Upsampling whole clouds: exact counts, the input's frame, unit normals, and no dependence on what must not matter."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from pnu.networks.pnu import PNU
from pnu.upsamplers import Context, Patches
from pnu.upsamplers.patches import predictions
from pnu.upsamplers.whole_clouds import normals, upsample

Array = np.ndarray


class Spread(nn.Module):
    """Each point becomes `ratio` points in its tangent plane, `step` apart; normals keep direction, not length."""

    predicts_normals = True

    def __init__(self, ratio: int = 4, step: float = 0.01, patch_size: int = 256) -> None:
        super().__init__()
        self.ratio, self.patch_size = ratio, patch_size
        self.step = nn.Parameter(torch.tensor(step))
        self.seen: list[Tensor] = []

    def forward(self, patch: Tensor) -> Tensor:
        self.seen.append(patch)
        points, normals = patch[..., :3], patch[..., 3:]
        tangent = torch.nn.functional.normalize(normals.cross(normals.roll(1, -1) + 0.1, dim=-1), dim=-1)
        moves = [(i - (self.ratio - 1) / 2) * self.step * tangent for i in range(self.ratio)]
        return torch.cat([torch.cat([points + move, 3 * normals], -1) for move in moves], 1)


class Columns(Spread):
    """Spread, with the normals replaced by a constant, or left out for None."""

    def __init__(self, normal: float | None) -> None:
        super().__init__()
        self.normal = normal
        self.predicts_normals = normal is not None

    def forward(self, patch: Tensor) -> Tensor:
        dense = super().forward(patch)
        return (
            dense[..., :3] if self.normal is None else torch.cat([dense[..., :3], 0 * dense[..., 3:] + self.normal], -1)
        )


def sphere(n: int, seed: int = 0) -> Array:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("n", [16, 63, 64, 300, 1000])
@pytest.mark.parametrize("ratio", [1, 1.5, 3.99, 4, 4.2, 7.3, 16])
def test_exact_count_and_unit_normals(n: int, ratio: float) -> None:
    points = sphere(n)
    dense = upsample(points, points, ratio=ratio, model=Spread())
    assert dense.shape == (round(ratio * n), 6)
    assert dense.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(dense[:, 3:], axis=1), 1, atol=1e-12)
    assert np.abs(np.linalg.norm(dense[:, :3], axis=1) - 1).max() < 0.1


@pytest.mark.parametrize("ratio", [2, 4, 16])
@pytest.mark.parametrize("network_ratio", [2, 4])
def test_passes_reach_any_ratio(ratio: int, network_ratio: int) -> None:
    sizes = Patches(Spread(network_ratio)).pass_sizes(1000, ratio * 1000)
    assert sizes[-1] == ratio * 1000
    assert network_ratio ** len(sizes) == max(ratio, network_ratio)
    growth = np.array(sizes) / [1000, *sizes[:-1]]
    assert growth == pytest.approx(growth[0], rel=1e-3)


def test_pass_sizes_never_outgrow_the_network() -> None:
    rng = np.random.default_rng(0)
    for _ in range(2000):
        n, ratio = int(rng.integers(16, 300)), rng.uniform(1, 40)
        sizes = [n, *Patches(Spread(patch_size=300)).pass_sizes(n, round(ratio * n))]
        assert all(b <= 4 * a for a, b in pairwise(sizes)), sizes


def test_patches_arrive_as_in_training() -> None:
    """Centered, of radius 1, with unit normals, in float32, of the network's size."""
    network = Spread()
    upsample(700 * sphere(2000) + 1e5, sphere(2000), model=network, batch_size=3)
    patches = torch.cat(network.seen)
    assert patches.shape[1:] == (256, 6)
    assert len(patches) >= round(4 * 2000 / 256)
    assert patches.dtype == torch.float32
    torch.testing.assert_close(patches[..., :3].mean(1), torch.zeros(len(patches), 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(patches[..., :3].norm(dim=-1).amax(1), torch.ones(len(patches)))
    torch.testing.assert_close(patches[..., 3:].norm(dim=-1), torch.ones(len(patches), 256))


def test_patch_size_and_small_clouds() -> None:
    network = Spread()
    upsample(sphere(1000), sphere(1000), model=network, patch_size=100)
    assert network.seen[0].shape[1] == 100
    network.seen.clear()
    upsample(sphere(40), sphere(40), model=network)
    assert [patch.shape for patch in network.seen] == [(1, 64, 6)]  # every network takes 64 points
    assert len(network.seen[0][0].unique(dim=0)) == 40


def test_normals_may_stand_beside_the_points() -> None:
    points = sphere(100)
    both = np.hstack([points, 2 * points])
    for model in (Spread(), "surface"):  # the weights too are those for given normals
        np.testing.assert_array_equal(upsample(both, model=model), upsample(points, 2 * points, model=model))


def test_every_input_point_is_covered() -> None:
    """A network that repeats its input gives back each point, also of a far and sparse second piece."""
    rng = np.random.default_rng(1)
    points = np.concatenate([sphere(1500) * rng.uniform(0.5, 1, (1500, 1)) ** 3, 0.01 * sphere(30) + [9, 9, 9]])
    dense = upsample(points, np.broadcast_to([0, 0, 1.0], points.shape), model=Spread(step=0.0), outliers="keep")
    assert cKDTree(dense[:, :3]).query(points)[0].max() < 1e-5
    assert len(dense) == 4 * len(points)


@pytest.fixture(scope="module")
def network() -> PNU:
    torch.manual_seed(0)
    network = PNU(ratio=4)
    network.patch_size = 256
    return network.eval()


def test_batch_size_and_threads_do_not_matter(network: PNU) -> None:
    points = sphere(1500)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = upsample(points, points, model=network, batch_size=1)
        torch.set_num_threads(3)
        several = upsample(points, points, model=network, batch_size=5)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    np.testing.assert_allclose(one, several, atol=1e-5)


def test_patches_together_are_as_patches_alone(network: PNU, monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = np.hstack([sphere(700), sphere(700)])
    rows = np.random.default_rng(0).integers(700, size=(20, 64))
    together = predictions(network, cloud)(rows)
    monkeypatch.setattr("pnu.upsamplers.patches.AT_ONCE", 64)
    np.testing.assert_allclose(predictions(network, cloud)(rows), together, atol=1e-5)


def test_order_and_repetition_do_not_matter(network: PNU) -> None:
    points = sphere(900)
    order = np.random.default_rng(0).permutation(900)
    dense = upsample(points, points, model=network)
    np.testing.assert_array_equal(dense, upsample(points[order], points[order], model=network))
    twice = np.concatenate([points, points[order[:1]].repeat(900, 0)])
    np.testing.assert_array_equal(dense, upsample(twice, twice, model=network))


def test_scale_and_place_do_not_matter(network: PNU) -> None:
    points = np.round(sphere(600) * 2**20) / 2**20
    dense = upsample(points, points, model=network)
    for scale in (2.0**-20, 2.0**20):
        moved = upsample(points * scale, points, model=network)
        np.testing.assert_array_equal(moved[:, :3], dense[:, :3] * scale)
        np.testing.assert_array_equal(moved[:, 3:], dense[:, 3:])


def test_map_coordinates_keep_millimetres() -> None:
    place = np.array([4.1e6, 5.3e6, 120])
    points = sphere(2000)
    dense = upsample(points + place, points, model=Spread(step=0.0), outliers="keep")
    assert cKDTree(points).query(dense[:, :3] - place)[0].max() < 1e-5


def test_network_comes_back_as_it_was(network: PNU) -> None:
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.train()
    one, two = (upsample(sphere(100), sphere(100), model=network) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert network.training
    assert all(parameter.grad is None for parameter in network.parameters())
    network.eval()
    for name, value in network.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0)


@pytest.mark.parametrize("normal", [0.0, float("nan"), float("inf")])
def test_lost_normals_come_from_the_nearest_input_point(normal: float) -> None:
    points = sphere(500)
    dense = upsample(2 * points + 7, points, model=Columns(normal))
    nearest = cKDTree(2 * points + 7).query(dense[:, :3])[1]
    np.testing.assert_allclose(dense[:, 3:], points[nearest], atol=1e-15)


@pytest.mark.parametrize("side", [1, -1])
def test_network_without_normals(side: int) -> None:
    """PCA normals, on the side of the input's."""
    points = sphere(3000)
    dense = upsample(points, side * points, model=Columns(None))
    cosine = side * (dense[:, 3:] * dense[:, :3]).sum(1) / np.linalg.norm(dense[:, :3], axis=1)
    assert np.degrees(np.arccos(np.median(cosine))) < 10
    assert cosine.min() > 0


def test_missing_normals_are_estimated_and_point_outward() -> None:
    points = sphere(2000) * [1, 0.8, 0.6] + 5
    dense = upsample(points, model=Spread())
    outward = (dense[:, :3] - 5) / np.array([1, 0.8, 0.6]) ** 2
    cosine = (dense[:, 3:] * outward).sum(1) / np.linalg.norm(outward, axis=1)
    assert cosine.min() > 0.8


def test_normals() -> None:
    """Outward, of unit length, for each point its own, whatever the order, the place and repeated points."""
    points = sphere(1000) * [1, 0.8, 0.6]
    found = normals(points)
    outward = points / np.array([1, 0.8, 0.6]) ** 2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert (found * outward).sum(1).min() > 0.95
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    order = np.random.default_rng(0).integers(0, 1000, 1500)  # some twice, some left out
    order = np.concatenate([order, np.arange(1000)])
    np.testing.assert_array_equal(normals(points[order]), found[order])
    np.testing.assert_array_equal(normals(torch.from_numpy(points).requires_grad_()), found)
    dense = upsample(points, model=Spread(step=0.0))  # each point, with its normal
    np.testing.assert_allclose(dense[:, 3:], found[cKDTree(points).query(dense[:, :3])[1]], atol=1e-6)


@pytest.mark.parametrize(
    ("points", "neighbors", "message"),
    [
        (sphere(20), 2, "^neighbors=2: expected a whole number from 3 to 20, the different points$"),
        (sphere(20), 21, "^neighbors=21: expected a whole number from 3 to 20"),
        (sphere(20), 4.5, "^neighbors=4.5: expected a whole number from 3 to 20"),
        (sphere(15), 16, "^points: holds 15 points; at least 16 are needed$"),
        (np.hstack([sphere(20), sphere(20)]), 16, r"^points: expected an array \(n, 3\), found shape \(20, 6\)$"),
        (np.arange(60.0).reshape(20, 3), 16, "^points: all 20 points lie on a line"),
    ],
)
def test_points_without_normals(points: Array, neighbors: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        normals(points, neighbors=neighbors)


def test_progress_reaches_the_end_of_each_stage() -> None:
    calls: dict[str, list[tuple[int, int]]] = {}
    upsample(
        sphere(600),
        ratio=9,
        model=Spread(),
        progress=lambda s, done, total: calls.setdefault(s, []).append((done, total)),
    )
    # normals and four passes of the surface model for them; network and farthest points in each of two passes
    assert len(calls) == 9
    for steps in calls.values():
        done = [step[0] for step in steps]
        assert done == sorted(done)
        assert (done[0], done[-1]) == (0, steps[-1][1])


def test_a_network_that_adds_no_points() -> None:
    points = sphere(600)
    assert upsample(points, points, model=Spread(1), ratio=1).shape == (600, 6)
    for size in (256, 1024):  # of patches: several, or one
        with pytest.raises(
            ValueError, match="^model: a network of ratio 1 makes no more points than it gets, 1200 of "
        ):
            upsample(points, points, model=Spread(1, patch_size=size), ratio=2)


@pytest.mark.parametrize("ratio", [0, -2, 2.5, None, "4"])
def test_a_network_without_a_ratio(ratio: object) -> None:
    network = Spread()
    network.ratio = ratio  # type: ignore[assignment]
    with pytest.raises(
        ValueError, match="^model: expected a network with an attribute `ratio`, .* a whole number >= 1"
    ):
        upsample(sphere(100), sphere(100), model=network)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_tensors_as_points(dtype: torch.dtype) -> None:
    points = torch.from_numpy(sphere(100)).to(dtype).requires_grad_()
    expected = upsample(points.detach().double().numpy(), points.detach().double().numpy(), model=Spread())
    wanted = torch.from_numpy(expected).to(torch.float32 if dtype == torch.float32 else torch.float64)
    assert torch.equal(upsample(points, points, model=Spread()), wanted)
    both = torch.cat([points, points], 1)
    assert both.grad_fn is not None
    assert torch.equal(upsample(both, model=Spread()), wanted)
    assert points.grad is None


class Whole:
    """An upsampler of one's own."""

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        assert cloud.dtype == torch.float64
        assert cloud[:, :3].norm(dim=1).max() == pytest.approx(1)
        chosen = torch.randint(len(cloud), (count,), generator=context.generator)
        return cloud[chosen] * torch.tensor([1, 1, 1, 2, 2, 2])


def test_an_upsampler_of_ones_own() -> None:
    points = sphere(100)
    dense = upsample(5 * points + 3, points, model=Whole(), ratio=2.5, seed=1)
    assert dense.shape == (250, 6)
    distance, nearest = cKDTree(5 * points + 3).query(dense[:, :3])
    assert distance.max() < 1e-12
    np.testing.assert_allclose(dense[:, 3:], points[nearest])
    np.testing.assert_array_equal(dense, upsample(5 * points + 3, points, model=Whole(), ratio=2.5, seed=1))
    assert (dense != upsample(5 * points + 3, points, model=Whole(), ratio=2.5, seed=2)).any()


GOOD = sphere(20)
BAD = {
    "ratio": ({"ratio": 0.5}, r"^ratio=0.5: expected a number >= 1, the points out for each point in$"),
    "nan ratio": ({"ratio": float("nan")}, "^ratio=nan: expected a number >= 1"),
    "infinite ratio": ({"ratio": float("inf")}, "^ratio=inf: expected a number >= 1"),
    "huge ratio": ({"ratio": 1e9}, r"^ratio=1e\+09: asks for 20000000000 points, at most 1e\+09 are made"),
    "few": ({"points": GOOD[:15]}, "^points: holds 15 points; at least 16 are needed$"),
    "few different": ({"points": GOOD[[0, 1] * 10]}, "^points: holds 2 different points; at least 16 are needed$"),
    "shape": ({"points": np.zeros((20, 5))}, r"^points: expected an array \(n, 3\), or .*, found shape \(20, 5\)$"),
    "type": ({"points": "scan.ply"}, r"^points: expected an array \(n, 3\), or \(n, 6\) with normals, found str$"),
    "equal": ({"points": np.ones((20, 3))}, "^points: all 20 points are equal"),
    "ratio text": ({"ratio": "4"}, "^ratio='4': expected a number >= 1"),
    "complex": ({"points": 1j * GOOD}, r"^points: expected an array \(n, 3\), or .*, found ndarray$"),
    "objects": ({"points": [object()] * 20}, r"^points: expected an array \(n, 3\), or .*, found list$"),
    "ragged": ({"points": [[1, 2], [3]]}, r"^points: expected an array \(n, 3\), or .*, found list$"),
    "meta": ({"points": torch.zeros(20, 3, device="meta")}, r"^points: expected an array .*, found Tensor$"),
    "sparse": ({"points": torch.eye(20)[:, :3].to_sparse()}, r"^points: expected an array .*, found Tensor$"),
    "normals text": ({"normals": "up"}, r"^normals: expected an array \(20, 3\), found str$"),
    "no newest": ({"model": "newest"}, "^run=newest: no finished run under outputs/"),
    "seed": ({"seed": -1}, "^seed=-1: expected a whole number >= 0"),
    "nan": ({"points": np.where(np.arange(20)[:, None] < 9, np.nan, GOOD)}, "^points: 9 of 20 points left out: NaN"),
    "normals twice": ({"points": np.hstack([GOOD, GOOD]), "normals": GOOD}, "^normals: are in points"),
    "normals": ({"normals": GOOD[:5]}, r"^points: expected normals of shape \(20, 3\), found \(5, 3\)"),
    "device": ({"device": "tpu"}, "^device=tpu: is not here; expected auto, cpu, or cuda"),
    "batch": ({"batch_size": 0}, "^batch_size=0: expected a whole number >= 1"),
    "patch": ({"patch_size": 15}, "^patch_size=15: expected a whole number >= 16"),
    "part of a patch": ({"patch_size": 64.5}, "^patch_size=64.5: expected a whole number >= 16"),
    "run": ({"model": "nowhere"}, "expected a run folder.*found no folder"),
    "prediction": ({"model": Spread(step=float("nan"))}, "^model: predicted points that are NaN or infinite"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_arguments(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    changes, message = BAD[case]
    with pytest.raises(ValueError, match=message) as error:
        upsample(**{"points": GOOD, "model": Spread(), **changes})
    assert "\n" not in str(error.value)


def test_points_and_normals_that_are_not_finite_are_left_out() -> None:
    """As if they had not been given; a point without a normal keeps its place."""
    points = sphere(100)
    holes = np.insert(points, [0, 50, 100], [[np.nan, 0, 0], [0, np.inf, 0], [1e200, 0, 0]], axis=0)
    clean = upsample(points, points, model=Spread())
    np.testing.assert_array_equal(upsample(holes, holes, model=Spread()), clean)
    for missing in (0, np.nan):
        normals = np.where(np.arange(100)[:, None] % 10 == 0, missing, -points)
        dense = upsample(points, normals, model=Spread())
        assert ((dense[:, :3] * dense[:, 3:]).sum(1) < -0.8).all()  # estimated on the side of those that are given


@pytest.mark.slow
def test_hundred_thousand_points() -> None:
    code = """
import numpy as np, resource
from tests.upsamplers.test_inference import Spread, sphere
from pnu.upsamplers.whole_clouds import upsample
points = sphere(100_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
assert upsample(points, points, model=Spread(patch_size=1024)).shape == (400_000, 6)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          cwd=Path(__file__).parents[2])  # fmt: skip
    assert int(done.stdout) < 1000  # MiB


def test_surface_model_where_there_is_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cloud = sphere(300)
    for given in (cloud, None):
        dense = upsample(cloud, given, ratio=7.3)
        assert dense.shape == (2190, 6)
        assert abs(np.linalg.norm(dense[:, :3], axis=1) - 1).max() < 0.1
        assert (dense[:, :3] * dense[:, 3:]).sum(1).min() > 0.8
        np.testing.assert_array_equal(dense, upsample(cloud, given, ratio=7.3, model="surface"))
