"""What compiled kernels gain: the same functions with them and without (`PNU_FAST=0`), in turn."""

import os
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from bench.scale import wavy_sphere
from bench.timing import Row, compare
from pnu.geometry.even_spacing import repel
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.normal_estimation import estimate_normals
from pnu.geometry.outlier_features import outlier_features
from pnu.geometry.point_tree import PointTree
from pnu.networks import checkpoints
from pnu.runtime.threads import thread_count
from pnu.upsamplers.surface_projection import projections, spheres
from pnu.upsamplers.whole_clouds import upsample

NOISE = 0.01  # of the radius


def without_kernels(run: Callable[[], object]) -> None:
    """The same on the other path."""
    before = os.environ.get("PNU_FAST")
    os.environ["PNU_FAST"] = "0"
    try:
        run()
    finally:
        if before is None:
            del os.environ["PNU_FAST"]
        else:
            os.environ["PNU_FAST"] = before


def both(name: str, run: Callable[[], object], rounds: int = 3) -> Row:
    """With kernels and without."""
    return compare(name, {"pnu": run, "without kernels": partial(without_kernels, run)}, rounds=rounds)


def rows() -> Iterator[Row]:
    """Stages of `surface`, then whole clouds."""
    network = checkpoints.load("surface").eval()
    cloud, query = wavy_sphere(5000), wavy_sphere(20_000)
    many, noisy = wavy_sphere(40_000)[:, :3], wavy_sphere(6000)[:, :3]
    noisy = noisy + NOISE * np.random.default_rng(0).normal(size=noisy.shape)
    yield both("20000 projections", lambda: projections(network, cloud)(query))
    yield both("20000 steps to spheres", lambda: spheres(network, cloud)(query))
    yield both("24 nearest, 40000", lambda: PointTree(many).nearest(many, 24, threads=thread_count()))
    yield both("farthest points, 40000 -> 10000", lambda: farthest_points_large(many, 10_000))
    yield both("even spacing, 20000", lambda: repel(query[:, :3], query[:, 3:], steps=2))
    yield both("features of strays, 6000", lambda: outlier_features(noisy))
    yield both("normals, 6000", lambda: estimate_normals(noisy))
    points, normals = cloud[:, :3], cloud[:, 3:]
    yield both("upsample 5000 -> 20000, surface, warm", lambda: upsample(points, normals))
    yield both("upsample 6000 noisy -> 24000, no normals, warm", lambda: upsample(noisy))
