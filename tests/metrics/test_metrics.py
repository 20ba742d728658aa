"""Metrics: values by hand and by SciPy, invariances, the public score script, the torchmetrics classes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.multiprocessing
from scipy.spatial import cKDTree
from scipy.spatial.distance import directed_hausdorff
from scipy.stats import wasserstein_distance_nd

from pnu import metrics
from pnu.geometry import mesh_sampling
from pnu.io import Mesh, read_mesh
from pnu.metrics import classes, ray_casting

SQUARE = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))

# Four points of a square and four of the same square, one lifted by 2: all distances can be seen.
CORNERS = [[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]]
LIFTED = [[0.0, 0, 2], [4, 0, 0], [4, 4, 0], [0, 4, 0]]


def clouds(batch: int, n: int, *, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    values = np.random.default_rng(seed).normal(size=(batch, n, 6))
    values[..., 3:] /= np.linalg.norm(values[..., 3:], axis=-1, keepdims=True)
    return torch.as_tensor(values, dtype=dtype)


def test_values_by_hand() -> None:
    assert metrics.chamfer_sq(CORNERS, LIFTED) == pytest.approx(4 / 4 + 4 / 4)
    assert metrics.hausdorff_sq(CORNERS, LIFTED) == pytest.approx(4)
    assert metrics.hausdorff(CORNERS, LIFTED) == pytest.approx(2)
    assert metrics.emd_exact(CORNERS, LIFTED) == pytest.approx(2 / 4)
    assert metrics.spacing_cv(CORNERS) == pytest.approx(0)
    assert metrics.spacing_cv([[0.0, 0, 0], [1, 0, 0], [4, 0, 0]]) == pytest.approx(
        np.std([1, 1, 3]) / np.mean([1, 1, 3])
    )


def test_normal_error_by_hand() -> None:
    angles = np.radians([0.0, 60, 120, 180])
    normals = np.stack([np.sin(angles), np.zeros(4), np.cos(angles)], axis=1)
    points = np.array([[0.3, 0.2, 0.1], [0.6, 0.2, -1], [0.2, 0.6, 0], [0.1, 0.9, 3]])
    error = metrics.normal_error(np.hstack([points, normals]), SQUARE)
    assert [float(e) for e in error] == pytest.approx([90, 30, 0.5])


def test_a_normal_of_length_zero_is_90_degrees_off_and_not_flipped() -> None:
    error = metrics.normal_error([[0.0, 0, 0, 0, 0, 0]], [[0.0, 0, 0, 0, 0, 1]])
    assert [float(e) for e in error] == [90, 90, 0]


def test_tiny_angles_survive_single_precision() -> None:
    angle = 1e-3  # degrees; the arc cosine of a float32 gives 0 or 0.02 here
    normal = torch.tensor([[0.0, 0, 0, np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))]], dtype=torch.float32)
    error = metrics.normal_error(normal, torch.tensor([[0.0, 0, 0, 0, 0, 1]]))
    assert float(error.signed_deg) == pytest.approx(angle, rel=1e-3)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 50), (200, 77), (77, 200)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_to_scipy(n: int, m: int, dtype: torch.dtype) -> None:
    a, b = clouds(3, n, seed=1, dtype=dtype), clouds(3, m, seed=2, dtype=dtype)
    points_a, points_b = a[..., :3].double().numpy(), b[..., :3].double().numpy()
    expected_cd = [
        (cKDTree(y).query(x)[0] ** 2).mean() + (cKDTree(x).query(y)[0] ** 2).mean()
        for x, y in zip(points_a, points_b, strict=True)
    ]
    expected_hd = [
        max(directed_hausdorff(x, y)[0], directed_hausdorff(y, x)[0]) for x, y in zip(points_a, points_b, strict=True)
    ]
    assert metrics.chamfer_sq(a, b).tolist() == pytest.approx(expected_cd, rel=1e-5)
    assert metrics.hausdorff(a, b).tolist() == pytest.approx(expected_hd, rel=1e-5)
    assert metrics.hausdorff_sq(a, b).dtype == dtype


def test_emd_equal_to_scipy() -> None:
    a, b = clouds(1, 40, seed=1)[0, :, :3], clouds(1, 40, seed=2)[0, :, :3]
    assert float(metrics.emd_exact(a, b)) == pytest.approx(wasserstein_distance_nd(a.numpy(), b.numpy()), rel=1e-9)


def test_compare_is_the_single_metrics_in_one() -> None:
    a, b = clouds(2, 90, seed=1), clouds(2, 150, seed=2)
    together, error = metrics.compare(a, b), metrics.normal_error(a, b)
    assert torch.equal(together["chamfer_sq"], metrics.chamfer_sq(a, b))
    assert torch.equal(together["hausdorff_sq"], metrics.hausdorff_sq(a, b))
    assert torch.equal(together["spacing_cv"], metrics.spacing_cv(a))
    for name, value in zip(("normal_deg", "normal_unsigned_deg", "flipped"), error, strict=True):
        assert torch.equal(together[name], value)


def test_rigid_motion_order_and_scale() -> None:
    a, b = clouds(1, 120, seed=1)[0], clouds(1, 300, seed=2)[0]
    rotation = torch.linalg.qr(clouds(1, 3, seed=3)[0, :, :3])[0]
    rotation = rotation * torch.linalg.det(rotation).sign()

    def moved(cloud: torch.Tensor) -> torch.Tensor:
        shuffled = cloud[torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))]
        return torch.cat([2 * shuffled[:, :3] @ rotation.T + 5, shuffled[:, 3:] @ rotation.T], dim=1)

    before, after = metrics.compare(a, b), metrics.compare(moved(a), moved(b))
    factor = {"chamfer_sq": 4, "hausdorff_sq": 4}
    for name, value in before.items():
        assert float(after[name]) == pytest.approx(float(value) * factor.get(name, 1), rel=1e-9), name
    # The disks of the uniformity stand around every n-th truth point, so only the cloud is shuffled here.
    assert float(metrics.uniformity(moved(a), moved(b), share=0.1, disks=300)) == pytest.approx(
        float(metrics.uniformity(a, b, share=0.1, disks=300)), rel=1e-9
    )


def test_one_target_serves_a_batch() -> None:
    a, b = clouds(3, 50, seed=1), clouds(1, 60, seed=2)
    assert metrics.chamfer_sq(a, b[0]).tolist() == [float(metrics.chamfer_sq(x, b[0])) for x in a]


def test_point_to_mesh_of_a_batch() -> None:
    points = torch.tensor([[[0.5, 0.5, 1.0], [0.5, 0.5, -3]], [[2, 0.5, 0], [0.5, 0.5, 0]]])
    assert metrics.point_to_mesh(points, SQUARE).tolist() == pytest.approx([2, 0.5])


def test_uniformity_sees_clusters_and_is_zero_for_the_truth_itself() -> None:
    rng = np.random.default_rng(0)
    grid = np.stack([*(a.ravel() for a in np.meshgrid(np.arange(60.0), np.arange(60.0))), np.zeros(3600)], axis=1)
    even, random = grid[::3], rng.uniform(0, 59, size=(1200, 3)) * [1, 1, 0]
    clustered = random[(random[:, 0] < 30) | (rng.random(1200) < 0.2)]
    values = [float(metrics.uniformity(c, grid, share=0.02)) for c in (grid, even, random, clustered)]
    assert values[0] == 0
    assert values == sorted(values)
    assert values[3] > 0.5


def test_spacing_of_random_points_is_that_of_a_poisson_process() -> None:
    points = np.random.default_rng(0).uniform(size=(20000, 3)) * [1, 1, 0]
    assert float(metrics.spacing_cv(points)) == pytest.approx(np.sqrt(4 / np.pi - 1), abs=0.01)


@pytest.mark.parametrize("metric", [metrics.chamfer_sq, metrics.hausdorff, metrics.emd_exact, metrics.compare])
@pytest.mark.parametrize(
    ("cloud", "text"),
    [
        (np.zeros((0, 3)), r"prediction: expected at least one point, found an empty cloud \(0, 3\)"),
        (np.zeros((2, 0, 3)), r"prediction: .* empty cloud \(2, 0, 3\)"),
        (np.zeros((5, 2)), r"prediction: expected \(n, 3\) .* found \(5, 2\)"),
        (np.zeros(3), r"prediction: .* found \(3,\)"),
        (np.full((4, 3), np.nan), "prediction: expected finite numbers, found 12 NaN"),
        (np.array([[0, 0, np.inf]]), "prediction: expected finite numbers, found 1 NaN or infinite"),
    ],
)
def test_bad_clouds_are_refused(metric: object, cloud: np.ndarray, text: str) -> None:
    assert callable(metric)
    with pytest.raises(ValueError, match=text):
        metric(cloud, np.zeros((4, 3)))


def test_other_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="target: expected a batch of 3 clouds, found 2"):
        metrics.chamfer_sq(clouds(3, 9), clouds(2, 9))
    with pytest.raises(ValueError, match="equally many points, found 9 and 8"):
        metrics.emd_exact(clouds(1, 9), clouds(1, 8))
    with pytest.raises(ValueError, match="at most 4096 points for the exact EMD, found 4097"):
        metrics.emd_exact(np.zeros((4097, 3)), np.zeros((4097, 3)))
    with pytest.raises(ValueError, match="points: expected at least 2 points"):
        metrics.spacing_cv(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"prediction: expected \(n, 6\)"):
        metrics.normal_error(np.zeros((4, 3)), SQUARE)
    with pytest.raises(ValueError, match=r"share: .* found 1"):
        metrics.uniformity(CORNERS, CORNERS, share=1)
    with pytest.raises(ValueError, match="truth: expected at least 150 points, found 4"):
        metrics.uniformity(CORNERS, CORNERS)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: metrics.NormalError("best"), "kind: expected one of signed, unsigned, flipped, found 'best'"),
        (lambda: metrics.HausdorffDistance(squared="yes"), "squared: expected True or False, found 'yes'"),  # type: ignore[arg-type]
        (lambda: metrics.Uniformity(share=0.0), "share: .* found 0.0"),
        (lambda: metrics.CloudMetrics(normals=1), "normals: expected True or False, found 1"),  # type: ignore[arg-type]
    ],
)
def test_constructors_check_their_arguments(make: object, text: str) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=text):
        make()


METRICS = {
    "chamfer": metrics.ChamferDistance,
    "hausdorff": metrics.HausdorffDistance,
    "normal": metrics.NormalError,
    "flipped": lambda: metrics.NormalError("flipped"),
    "spacing": metrics.Spacing,
    "uniformity": lambda: metrics.Uniformity(share=0.1),
    "emd": metrics.EarthMoverDistance,
    "all": metrics.CloudMetrics,
}
BATCHES = (3, 3, 1)  # the last batch is smaller


def batches() -> list[tuple[torch.Tensor, torch.Tensor]]:
    return [(clouds(b, 40, seed=i), clouds(b, 40, seed=10 + i)) for i, b in enumerate(BATCHES)]


def feed(metric: classes.CloudMean, pairs: list[tuple[torch.Tensor, torch.Tensor]]) -> np.ndarray:
    for prediction, target in pairs:
        metric.update(prediction) if isinstance(metric, metrics.Spacing) else metric.update(prediction, target)
    result = metric.compute()
    return np.array([float(v) for v in result.values()]) if isinstance(result, dict) else np.array([float(result)])


@pytest.mark.parametrize("name", METRICS)
def test_class_is_the_mean_over_clouds_whatever_the_batches(name: str) -> None:
    single = [(p[i : i + 1], t[i : i + 1]) for p, t in batches() for i in range(len(p))]
    each = np.stack([feed(METRICS[name](), [pair]) for pair in single])
    assert len(each) == sum(BATCHES)
    assert np.ptp(each, axis=0).min() > 0
    np.testing.assert_allclose(feed(METRICS[name](), batches()), each.mean(0), rtol=1e-5)


@pytest.mark.parametrize("name", METRICS)
@pytest.mark.filterwarnings("ignore:The ``compute`` method of metric:UserWarning")
def test_class_without_update_is_nan_also_after_reset(name: str) -> None:
    metric = METRICS[name]()
    assert np.isnan(feed(metric, [])).all()
    feed(metric, batches())
    metric.reset()
    assert np.isnan(feed(metric, [])).all()


def test_mesh_classes() -> None:
    lifted = Mesh(SQUARE.vertices + np.array([0, 0, 1]), SQUARE.faces[:, ::-1])
    cloud = torch.tensor([[[0.5, 0.5, 0, 0, 0, 1]], [[0.5, 0.5, 0, 0, 0, 1]]])
    p2f, flipped = metrics.PointToMesh(), metrics.NormalError("flipped")
    p2f.update(cloud, [SQUARE, lifted])
    flipped.update(cloud, [SQUARE, lifted])
    assert float(p2f.compute()) == float(flipped.compute()) == pytest.approx(0.5)


def test_cloud_metrics_without_normals() -> None:
    points = clouds(1, 30)[..., :3]
    with pytest.raises(ValueError, match="expected 6 columns for the normals' error, found 3 and 3"):
        metrics.CloudMetrics().update(points, points)
    metric = metrics.CloudMetrics(normals=False)
    metric.update(points, points)
    assert set(metric.compute()) == {"chamfer_sq", "hausdorff_sq", "spacing_cv"}


def _rank(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    share = batches()[rank::2]  # rank 0: two batches, the smaller one among them; rank 1: one
    result = {name: feed(make(), share) for name, make in METRICS.items()}
    np.savez(Path(folder) / f"rank{rank}.npz", **result)
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_two_processes_give_the_result_of_one(tmp_path: Path) -> None:
    torch.multiprocessing.spawn(_rank, args=(str(tmp_path),), nprocs=2)
    for rank in range(2):
        found = np.load(tmp_path / f"rank{rank}.npz")
        for name, make in METRICS.items():
            np.testing.assert_allclose(found[name], feed(make(), batches()), rtol=1e-5, err_msg=name)


@pytest.mark.parametrize(
    "shape",
    [
        "duck",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("casting", "fandisk", "camel", "elephant", "kitten")),
    ],
)
def test_equal_to_the_public_score_script(shared: Path, shape: str) -> None:
    pytest.importorskip("open3d")
    spec = importlib.util.spec_from_file_location("score", shared / "bench" / "score.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    rng = np.random.default_rng(0)
    cloud = np.loadtxt(shared / "bench" / "clouds" / f"{shape}.xyz") + rng.normal(scale=0.003, size=(5000, 6))
    mesh = read_mesh(shared / "bench" / "truth" / f"{shape}.ply")
    truth = np.load(shared / "bench" / "truth" / f"{shape}_20000.npy")
    expected = script.score(shape, cloud)

    # At edges the closest face is ambiguous, so the script's normal errors come back only with the script's search.
    found = metrics.compare_mesh(cloud, mesh, closest=ray_casting.closest_points)
    scores = {
        "points": 5000,
        "CD": 1e3 * float(metrics.chamfer_sq(cloud, truth)),
        "HD": 1e3 * float(metrics.hausdorff_sq(cloud, truth)),
        "P2F": 1e3 * float(metrics.point_to_mesh(cloud, mesh)),
        "spacing_cv": float(metrics.spacing_cv(cloud)),
        "normal": float(found["normal_deg"]),
        "normal_unsigned": float(found["normal_unsigned_deg"]),
        "flipped_%": 100 * float(found["flipped"]),
    }
    assert scores == pytest.approx(expected, rel=5e-5)

    # The exact search names another face for a few points only, and that face is as near.
    _, distance, face = mesh_sampling.closest_points(mesh, cloud[:, :3])
    _, _, other = ray_casting.closest_points(mesh, cloud[:, :3])
    differs = np.flatnonzero(face != other)
    assert len(differs) < 0.03 * len(cloud)
    for i in differs:
        single = Mesh(mesh.vertices, mesh.faces[other[i : i + 1]])
        assert mesh_sampling.closest_points(single, cloud[i : i + 1, :3])[1] == pytest.approx(distance[i], abs=1e-6)
