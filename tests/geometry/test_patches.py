"""Patches: centers far apart, nearest points, every point covered, merged to an exact count."""

import numpy as np
import pytest
import torch
from torch import Tensor

from pnu.geometry.patch_extraction import extract, merge
from tests import reference


def cloud(n: int, columns: int = 3) -> Tensor:
    return torch.rand(n, columns, generator=torch.Generator().manual_seed(n))


def test_extract_against_the_slow_twins() -> None:
    points = cloud(60, 6)
    idx = extract(points, 5, 12)
    assert idx.dtype == torch.int64
    xyz = points[:, :3].numpy().astype(float)
    centers = reference.farthest_points(xyz, 5)
    np.testing.assert_array_equal(idx[:, 0], centers)
    np.testing.assert_array_equal(idx, reference.knn(xyz[centers], xyz, 12)[1])


def test_cover_reaches_every_point() -> None:
    outlier = torch.tensor([[0.4, 0.4, 0.4]])
    points = torch.cat([cloud(2000) * 0.01, outlier, cloud(2000) * 0.01 + 1])
    plain, covering = extract(points, 3, 64), extract(points, 3, 64, cover=True)
    assert len(plain) == 3
    assert len(plain.unique()) < len(points)
    assert torch.equal(covering[:3], plain)
    assert torch.equal(covering.unique(), torch.arange(len(points)))


def test_cover_ends_where_many_points_coincide() -> None:
    idx = extract(torch.zeros(40, 3), 2, 8, cover=True)
    assert torch.equal(idx.unique(), torch.arange(40))


def test_whole_cloud_as_one_patch() -> None:
    assert torch.equal(extract(cloud(20), 1, 20).unique(), torch.arange(20))


def test_merge_gives_exactly_n_different_points_evenly() -> None:
    points = cloud(500, 6)
    patches = points[extract(points, 8, 200)]
    merged = merge(patches, 300)
    assert merged.shape == (300, 6)
    # the overlap holds each point several times: none comes twice, and columns stay together
    rows = {tuple(row) for row in points.tolist()}
    assert len({tuple(row) for row in merged.tolist()} & rows) == 300


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="m: expected 1 to 10 points"):
        extract(cloud(10), 11, 4)
    with pytest.raises(ValueError, match="k: expected 1 to 10 neighbors"):
        extract(cloud(10), 2, 11)
    with pytest.raises(ValueError, match="m: expected 1 to 20 points"):
        merge(torch.rand(2, 10, 3), 21)
