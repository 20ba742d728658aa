"""Machine code that kernels are called from without numba: the same bits, and numba where it is not to be had."""

import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from pnu.kernels import compilation
from pnu.kernels.code_loading import DIGEST, Kernel, MachineCode, kernel_arguments, load_code

PUSH = "void(float64[:, ::1], float64[:, ::1], int64[:, ::1], float64[::1], int64, float64[:, ::1])"
QUANTILES = "void(float64[::1], int64[:, ::1], int64, float64[::1], int64, float64[:, :])"
ROWS_OF = "void(float32[:, ::1], int64, float32[:, ::1])"


def kept() -> Path:
    """The file of machine code; tests of it skip where none is kept."""
    place = compilation.folder()
    if place is None or not (place / compilation.CODE).exists():
        pytest.skip("machine code is kept on Linux alone")
    return place / compilation.CODE


@pytest.fixture
def code(compiled: None) -> MachineCode:
    found = load_code(kept())
    assert found is not None
    return found


def quantiles(code: MachineCode) -> Kernel:
    return code.kernel("planes.neighbor_quantiles", QUANTILES, quantiles)


def run(program: str, *words: str | Path) -> str:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("COV_", "COVERAGE"))}
    command = [sys.executable, "-c", program, *map(str, words)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


BOTH = """
import importlib, sys
from pathlib import Path
import numpy as np
from pnu.kernels import compilation
from pnu.kernels.code_loading import load_code
compilation.machine_code = lambda: None
from pnu import weights
from pnu.geometry import even_spacing, farthest_sampling, normal_estimation, orientation, outlier_features, point_tree
from pnu.networks.compiled_surface import compiled_feet, compiled_step
modules = [importlib.import_module(f"pnu.kernels.{name}") for name in compilation.KERNELS]
found = weights.read(weights.find("surface"), "numpy").state
both = [
    {name.removeprefix(part): value for name, value in found.items() if name.startswith(part)}
    for part in ("projector.", "coarse.projector.")
]
def results():
    normals = np.random.default_rng(0).normal(size=(700, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * [1, 0.7, 0.4]
    cloud, query = np.hstack([points, normals]), np.hstack([points + 0.01, normals])
    dist, idx = point_tree.PointTree(points).nearest_sq(query[:, :3], 24)
    near = orientation.NeighborCloud.of(points)
    lines = normals.astype(np.float32)
    yield from (dist, idx, compiled_feet(query, cloud, idx))
    for parameters in both:
        for sphere in (True, False):
            yield compiled_step(parameters, sphere=sphere, attention=True)(query, cloud, idx)
    yield farthest_sampling.farthest_order(points.astype(np.float32), 200, 3)
    yield even_spacing.repel(points, normals, steps=2)
    yield outlier_features.outlier_features(points)
    yield normal_estimation.estimate_normals(points, orient=False)
    yield normal_estimation.refit_normals(points, normals)
    yield orientation._Pairs(near, np.sqrt(near.area)).inverse_cubes
    yield orientation._dipoles(near, lines, 1.4)
    yield orientation._Pairs(near, np.sqrt(near.area)).winding(lines)
    yield orientation.field(near, lines, 0.1)
def called(kernel, name):
    def call(*values):
        names.add(name)
        kernel(*values)
    return call
by_numba, code, names = [*results()], load_code(Path(sys.argv[1])), set()
for name, (signature, function) in compilation._made.items():
    module, _, short = name.partition(".")
    kernel = called(code.kernel(name, signature, function.py_func), name)
    setattr(sys.modules[f"pnu.kernels.{module}"], short, kernel)
for a, b in zip(by_numba, results(), strict=True):
    assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
assert names == compilation._made.keys(), compilation._made.keys() - names
print(len(names))
"""


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_results_are_those_by_numba_bit_by_bit() -> None:
    """Of all kernels, and each is called."""
    assert int(run(BOTH, kept())) >= 13


DAMAGED = """
import sys
from pathlib import Path
import numpy as np
from pnu.kernels import compilation
compilation.folder = lambda: Path(sys.argv[1])
from pnu.kernels.boxes import box_order
points = np.random.default_rng(0).normal(size=(1000, 3))
assert (np.sort(box_order(points, 16)) == np.arange(1000)).all()
print("numba" in sys.modules)
"""


MENDED = """
import sys
from pathlib import Path
from pnu.kernels import compilation
compilation.folder = lambda: Path(sys.argv[1])
print(compilation.compile_all(wait=False))
"""


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("damage", ["none", "cut off", "missing"])
def test_numba_answers_where_code_is_damaged_which_is_then_mended(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "kernels" / compilation.CODE
    shutil.copytree(kept().parent, path.parent)
    if damage == "cut off":
        path.write_bytes(path.read_bytes()[:-1000])
    elif damage == "missing":
        path.unlink()
    assert run(DAMAGED, path.parent).split() == [str(damage != "none")]
    assert run(MENDED, path.parent).split() == ["True"]
    assert run(DAMAGED, path.parent).split() == ["False"]


REFUSED = """
import sys
from pathlib import Path
import numba, numpy as np
from pnu.kernels.code_writing import write_code
def shifted(a, k):
    a[0] += k
def sorted_(a, k):
    a[:] = np.sort(a)[k]
def told(function, given, signature):
    try:
        write_code(Path(sys.argv[1]), {"boxes._put_in_order": (signature, numba.njit(given)(function))})
    except Exception as error:
        print(type(error).__name__)
told(shifted, "void(int64[::1], int64)", "void(int64[::1], float64[::1])")
told(sorted_, "void(int64[::1], int64)", "void(int64[::1], int64)")
told(shifted, "void(int64[::1], int64)", "void(int64[::1], int64)")
"""


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_code_is_not_kept_that_is_not_as_expected_or_does_not_work(tmp_path: Path) -> None:
    """Of other arguments; with calls of numba's runtime that are not known; and what fails in a process that tries."""
    kept()
    expected = ["TypeError", "NotImplementedError", "CalledProcessError"]
    assert run(REFUSED, tmp_path / compilation.CODE).split() == expected
    assert [*tmp_path.iterdir()] == []


@pytest.mark.usefixtures("compiled")
def test_no_damaged_file_is_loaded(tmp_path: Path) -> None:
    content, path = kept().read_bytes(), tmp_path / "code"
    assert load_code(path) is None
    changed = bytearray(content)
    changed[len(content) // 2] ^= 1
    for damaged in (b"", content[:DIGEST], content[:-1], content[: len(content) // 2], bytes(changed)):
        path.write_bytes(damaged)
        assert load_code(path) is None


def test_what_a_kernel_does_not_take_is_refused(code: MachineCode) -> None:
    kernel = quantiles(code)
    good = [np.arange(5.0), np.zeros((5, 2), np.int64), 2, np.array([0.5]), 0, np.empty((5, 1))]
    kernel(*good)
    np.testing.assert_array_equal(good[-1], np.zeros((5, 1)))
    frozen, wide = np.arange(5.0), np.zeros((5, 4), np.int64)
    frozen.setflags(write=False)
    wrong = [
        (0, frozen, r"argument 1: expected float64\[::1\], found float64 \(5,\), read-only"),
        (0, np.arange(10.0)[::2], r"argument 1: expected float64\[::1\], found float64 \(5,\), in pieces"),
        (0, np.arange(5.0, dtype=np.float32), r"argument 1: expected float64\[::1\], found float32 \(5,\)"),
        (0, np.arange(5.0).astype(">f8"), r"argument 1: expected float64\[::1\], found >f8 \(5,\)|found float64"),
        (0, [1.0, 2.0], r"argument 1: expected float64\[::1\], found list"),
        (1, wide[:, :2], r"argument 2: expected int64\[:, ::1\], found int64 \(5, 2\), in pieces"),
        (1, wide[0], r"argument 2: expected int64\[:, ::1\], found int64 \(4,\)"),
        (2, 2.0, r"argument 3: expected int64, found float"),
        (5, None, r"argument 6: expected float64\[:, :\], found NoneType"),
    ]
    for place, value, message in wrong:
        values = [*good]
        values[place] = value
        with pytest.raises(TypeError, match=f"^planes.neighbor_quantiles: {message}"):
            kernel(*values)
    with pytest.raises(TypeError, match=r"^planes.neighbor_quantiles: expected 6 arguments, found 5$"):
        kernel(*good[:-1])


def test_arrays_with_steps_and_empty_ones_are_taken(code: MachineCode) -> None:
    values, near, out = np.arange(5.0), np.arange(5)[:, None].copy(), np.zeros((3, 10))
    quantiles(code)(values, near, 1, np.array([0.5, 1.0]), 2, out[:, 1::4][:, :2])
    np.testing.assert_array_equal(out.nonzero(), [[0, 0, 1, 1, 2, 2], [1, 5, 1, 5, 1, 5]])
    quantiles(code)(np.empty(0), np.empty((0, 1), np.int64), 1, np.empty(0), 0, np.empty((0, 0)))


def test_memory_that_is_not_there_is_an_error(code: MachineCode) -> None:
    with pytest.raises(MemoryError, match=r"^planes.neighbor_quantiles: no memory"):
        quantiles(code)(np.empty(0), np.empty((0, 1), np.int64), 2**50, np.empty(0), 0, np.empty((0, 0)))


def test_signatures_are_read() -> None:
    assert [argument.name for argument in kernel_arguments(f"{PUSH[:-1]}, boolean)")] == [
        "float64[:, ::1]",
        "float64[:, ::1]",
        "int64[:, ::1]",
        "float64[::1]",
        "int64",
        "float64[:, ::1]",
        "boolean",
    ]


def test_other_threads_go_on_while_a_kernel_runs(code: MachineCode) -> None:
    kernel = code.kernel("dipoles.inverse_cube_rows", ROWS_OF, quantiles)
    sources, out = (
        np.random.default_rng(0).normal(size=(8, 8000)).astype(np.float32),
        np.empty((4000, 8000), np.float32),
    )
    thread, turns = threading.Thread(target=kernel, args=(sources, 0, out)), 0
    thread.start()
    while thread.is_alive():
        time.sleep(1e-3)
        turns += 1
    assert turns > 3
