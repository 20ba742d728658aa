"""How dense new points lie, and that the measured ones stay where that is asked for."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import pnu
from pnu.commands.upsample import main
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.io import read_cloud
from pnu.upsamplers.density import count_of_spacing, groups_of_like_spacing, point_counts


def sphere(n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).standard_normal((n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def even_sphere(n: int) -> np.ndarray:
    points = sphere(8 * n)
    return points[farthest_points_large(points, n)]


def uneven_sphere() -> np.ndarray:
    """900 points on a cap of z > 0.9, a twentieth of the sphere; 300 on all the rest."""
    points = sphere(60000)
    cap = points[:, 2] > 0.9
    return np.vstack([points[cap][:900], points[~cap][:300]])


def in_cap(points: np.ndarray) -> int:
    return int((points[:, 2] > 0.9).sum())


@pytest.mark.slow
def test_density_even_follow_and_auto() -> None:
    points = uneven_sphere()
    found = {d: in_cap(pnu.upsample(points, ratio=2, density=d, outliers="keep")) for d in ("even", "follow", "auto")}  # type: ignore[arg-type]
    assert found["even"] < 450  # of 900: far fewer than there were
    assert 1.7 * 900 < found["follow"] < 2.3 * 900
    assert 900 < found["auto"] < found["follow"]


def test_counts_fill_what_lies_low() -> None:
    points = uneven_sphere()
    counts = point_counts(points, 4800, "auto")
    assert counts is not None
    assert counts.sum() == pytest.approx(4800)
    assert counts.min() == pytest.approx(2, rel=0.01)  # the root of 4
    assert point_counts(points, 4800, "even") is None
    assert point_counts(sphere(2000), 8000, "auto") is None
    follow = point_counts(points, 4800, "follow")
    assert follow is not None
    assert (follow == 4).all()


def test_groups_share_all_points_and_counts() -> None:
    points = uneven_sphere()
    counts = point_counts(points, 3000, "follow")
    assert counts is not None
    groups = groups_of_like_spacing(points, counts, 3000)
    assert len(groups) > 1
    assert np.array_equal(np.sort(np.concatenate([rows for rows, _ in groups])), np.arange(len(points)))
    assert sum(count for _, count in groups) == 3000
    assert min(len(rows) for rows, _ in groups) >= 32


@pytest.mark.parametrize("normals", [False, True])
def test_measured_points_stay(normals: bool) -> None:
    points = 3 * sphere(400) + [100, 0, 0]
    dense = pnu.upsample(points, sphere(400) if normals else None, ratio=3, keep=True)
    assert dense.shape == (1200, 6)
    assert (dense[:400, :3] == points).all()
    if normals:
        np.testing.assert_allclose(dense[:400, 3:], sphere(400), atol=1e-12)
    apart = cKDTree(dense[:, :3]).query(dense[:, :3], 2)[0][:, 1]
    assert apart[400:].min() > 0.25 * np.median(apart)  # new ones leave room around them


def test_measured_points_stay_of_themselves_where_even_and_clean() -> None:
    points = even_sphere(500)
    kept = pnu.upsample(points, points)
    assert (kept[:500, :3] == points).all()
    noisy = points + 0.03 * np.random.default_rng(1).standard_normal(points.shape)
    assert cKDTree(pnu.upsample(noisy, points)[:, :3]).query(noisy)[0].min() > 0
    assert cKDTree(pnu.upsample(points, points, keep=False)[:, :3]).query(points)[0].min() > 0


def test_kept_points_do_not_depend_on_order() -> None:
    points = even_sphere(300)
    order = np.random.default_rng(0).permutation(300)
    found, turned = pnu.upsample(points, ratio=2), pnu.upsample(points[order], ratio=2)
    assert (turned[:300] == found[:300][order]).all()
    assert (turned[300:] == found[300:]).all()


def test_spacing_instead_of_ratio() -> None:
    points = even_sphere(1000)
    assert count_of_spacing(points, 0.05) == pytest.approx(4 * np.pi / 0.05**2, rel=0.1)
    dense = pnu.upsample(points, spacing=0.06)
    assert len(dense) == pytest.approx(4 * np.pi / 0.06**2, rel=0.1)
    with pytest.raises(ValueError, match=r"spacing=1: the points are nearer to each other"):
        pnu.upsample(points, spacing=1)


def test_bad_values_are_refused() -> None:
    with pytest.raises(ValueError, match="density=odd: expected auto, even, follow"):
        pnu.upsample(sphere(100), density="odd")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="keep=yes: expected true, false or auto"):
        pnu.upsample(sphere(100), keep="yes")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="density=follow: Midpoint spreads new points evenly"):
        pnu.upsample(sphere(100), model="midpoint", density="follow")


def test_the_command_keeps_them_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savetxt("cloud.xyz", sphere(200), fmt="%.17g")
    main(["input=cloud.xyz", "output=dense.npy", "keep=true", "spacing=0.15"])
    dense = read_cloud("dense.npy").points
    assert (dense[:200] == sphere(200)).all()
    assert len(dense) == pytest.approx(4 * np.pi / 0.15**2, rel=0.15)
