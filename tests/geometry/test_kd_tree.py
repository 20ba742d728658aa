"""SciPy's tree, also where numbers below 1e-38 are taken for zero."""

import subprocess
import sys
from pathlib import Path

import pytest

import pnu

FLOOR = """
import numpy as np
from pnu.geometry.kd_tree import kd_tree
from pnu.runtime import denormals

points = np.random.default_rng(0).random((400, 3))
points[:300, 2] = 0
points[:, :2] *= 0.01
plain = kd_tree(points).query(points, k=4)
with denormals.as_zero():
    found = kd_tree(points).query(points, k=4)
    assert denormals.are_zero()
assert all(np.array_equal(a, b) for a, b in zip(plain, found))
"""


@pytest.mark.slow
def test_points_in_a_plane_through_the_origin() -> None:
    """In a process of its own: SciPy's own tree ends it."""
    pytest.importorskip("torch")
    done = subprocess.run([sys.executable, "-c", FLOOR], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_nothing_else_builds_one() -> None:
    package = Path(pnu.__file__).parent
    builders = [path.name for path in package.rglob("*.py") if "KDTree(" in path.read_text()]
    assert [name for name in builders if name != "open3d_chain.py"] == ["kd_tree.py"]
