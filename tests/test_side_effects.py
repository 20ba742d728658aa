"""Public functions leave alone what belongs to the caller: generators, settings of torch, modes, devices, files."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import pnu
from tests.upsamplers.test_inference import Spread, sphere

CALLS = """
import gc, json, locale, logging, os, random, signal, sys, warnings
from pathlib import Path
import numpy as np, torch
from tests.upsamplers.test_inference import Spread, sphere

def world():
    numpy = np.random.get_state()
    return {
        "torch generator": torch.get_rng_state().numpy().tobytes(),
        "numpy generator": (numpy[0], numpy[1].tobytes(), *numpy[2:]),
        "random generator": random.getstate(),
        "threads": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "modes": (torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.is_anomaly_enabled()),
        "defaults": (torch.get_default_dtype(), torch.get_default_device(), torch.get_float32_matmul_precision()),
        "deterministic": (torch.get_deterministic_debug_mode(), torch.utils.deterministic.fill_uninitialized_memory),
        "backends": (torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic, torch.backends.mkldnn.enabled),
        "warnings": (list(warnings.filters), warnings.showwarning, torch.is_warn_always_enabled()),
        "numpy": (np.geterr(), np.get_printoptions()),
        "process": (os.getcwd(), dict(os.environ), sys.path[:], sys.argv[:], sys.getrecursionlimit(), gc.isenabled()),
        "hooks": (sys.excepthook, sys.displayhook, sys.stdout, sys.stderr),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)],
        "logging": (logging.root.level, logging.root.handlers[:], logging.root.disabled),
        "locale": locale.setlocale(locale.LC_ALL),
        "files": sorted((str(path), path.stat().st_mtime_ns) for path in Path(".").rglob("*")),
    }

def check(name, call):
    before = world()
    call()
    after = world()
    changed = [key for key in before if before[key] != after[key]]
    assert not changed, f"{name} changed {changed}"

np.random.seed(1), random.seed(2), torch.manual_seed(3)
torch.use_deterministic_algorithms(True)
import pnu
points = sphere(120)
points.flags.writeable = False  # a caller's array may be read-only
"""

FUNCTIONS = {
    "load": ["pnu.load('surface')", "pnu.load('pnu')"],
    "normals": ["pnu.normals(points)"],
    "PointCloudUpsampler": ["pnu.PointCloudUpsampler(ratio=2).fit_transform(points, points)"],
    "upsample": [
        "pnu.upsample(points)",
        "pnu.upsample(points, points, model='pnu', ratio=2)",
        "pnu.upsample(points, points, model=Spread(), devices=2)",
        "pnu.upsample(points, points, model='apss', seed=4)",
    ],
}


@pytest.mark.slow
def test_public_functions_change_nothing(tmp_path: Path) -> None:
    assert set(FUNCTIONS) == set(pnu.__all__) - {"__version__"}
    checks = [f"    check({call!r}, lambda: {call})" for calls in FUNCTIONS.values() for call in calls]
    script = tmp_path / "calls.py"
    script.write_text("\n".join([CALLS, 'if __name__ == "__main__":', *checks]))
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", str(script)],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calls.py"]


def test_a_setting_of_the_caller_changes_nothing() -> None:
    points = sphere(150)
    expected = {model: pnu.upsample(points, points, model=model, ratio=2) for model in ("surface", "pnu")}
    try:
        torch.set_default_dtype(torch.float64)
        torch.set_default_device("meta")
        for model, dense in expected.items():
            network = pnu.load(model)
            assert {(p.dtype, p.device.type) for p in network.parameters()} == {(torch.float32, "cpu")}
            np.testing.assert_array_equal(pnu.upsample(points, points, model=model, ratio=2), dense)
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)


class Frozen(Spread):
    """A network with a part that stays in eval mode in a training."""

    def __init__(self) -> None:
        super().__init__()
        self.frozen, self.norm = nn.BatchNorm1d(3).eval(), nn.BatchNorm1d(3)
        self.register_buffer("table", torch.zeros(2))


def test_each_module_keeps_its_mode() -> None:
    network = Frozen()
    before = [module.training for module in network.modules()]
    assert sorted(before) == [False, True, True]
    pnu.upsample(sphere(100), sphere(100), model=network)
    assert [module.training for module in network.modules()] == before
    network.step.data.fill_(torch.nan)
    with pytest.raises(ValueError, match="model: predicted points that are NaN"):
        pnu.upsample(sphere(100), sphere(100), model=network)
    assert [module.training for module in network.modules()] == before


def test_the_network_stays_where_it_is() -> None:
    network = Frozen()
    tensors = [*network.parameters(), *network.buffers()]
    places = [(id(tensor), tensor.device, tensor.data_ptr()) for tensor in tensors]
    dense = pnu.upsample(sphere(100), sphere(100), model=network)
    there = pnu.upsample(sphere(100), sphere(100), model=network, device="cpu:0")  # to torch another device
    np.testing.assert_array_equal(there, dense)
    assert [(id(t), t.device, t.data_ptr()) for t in (*network.parameters(), *network.buffers())] == places
    assert [id(tensor) for tensor in tensors] == [place[0] for place in places]
