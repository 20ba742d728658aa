"""What a clone holds of the authors' released network and loss: tests/released.npz, written from the reference by

    python -m tests.released ../shared/reference/released_reference.npz

The state of the released network is 5.6 MB and is not kept. The file has

- the loss in full: its clouds, 2 x 4096 points (`loss_target` is drawn again, `loss_prediction` is stored), and the
  authors' value of every term;
- the end of the network: the authors' weights of the last four layers (`tail/...`), the features that enter them at 64
  points of the first cloud (by `bench/plain.py` in double precision), and the authors' output at these points;
- the whole network, at one remove: the output of `bench/plain.py` for a state and a patch drawn from fixed seeds. The
  port's own parity, authors' state in and authors' output out, is tested where the reference material is.
"""

import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench.plain import PlainPNU

FILE = Path(__file__).with_name("released.npz")
TERMS = (
    "chamfer_target_to_pred",
    "chamfer_pred_to_target",
    "point_knn",
    "normal",
    "normal_orth",
    "normal_knn",
    "total",
)
TAIL = 10  # number in UPSAMPLING_module of the first layer after the first doubling
POINTS = range(0, 1024, 16)


def ellipsoids(n: int, seed: int) -> Tensor:
    """Two clouds (2, n, 6) of the reference: random points of an ellipsoid and their normals."""
    axes = torch.tensor([1, 0.8, 0.5])
    ball = nn.functional.normalize(torch.randn(2, n, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)
    return torch.cat([ball * axes, nn.functional.normalize(ball * (1 / axes), dim=-1)], -1)


def loss_target() -> Tensor:
    return ellipsoids(4096, 101)


def digest(values: Tensor) -> str:
    return hashlib.sha256(values.numpy().tobytes()).hexdigest()


def drawn_network() -> PlainPNU:
    """The port with a state from numpy's frozen generator, float64: some scales negative, statistics not trivial."""
    network, draw = PlainPNU().double().eval(), np.random.RandomState(5)
    for name, value in network.state_dict().items():
        if name.endswith("num_batches_tracked"):
            continue
        low, high = (0.5, 1.5) if name.endswith("running_var") else (-0.5, 0.5)
        if value.ndim > 1:
            high = (3 / value[0].numel()) ** 0.5
            low = -high
        elif name.endswith("weight"):
            low, high = -0.4, 1.6
        value.copy_(torch.from_numpy(draw.uniform(low, high, tuple(value.shape))))
    return network


def drawn_patch() -> Tensor:
    """A patch (1, 192, 6) of a ball, float64."""
    ball = np.random.RandomState(6).normal(size=(1, 192, 3))
    ball /= np.linalg.norm(ball, axis=-1, keepdims=True)
    return torch.from_numpy(np.concatenate([0.9 * ball, ball], -1))


def contents(reference: Any) -> dict[str, Any]:
    """All that the file holds, from the reference material."""
    network = PlainPNU().double().eval()
    state = {name[6:]: torch.as_tensor(reference[name]) for name in reference if name.startswith("state/")}
    network.load_state_dict(state)
    caught: list[Tensor] = []
    network.UPSAMPLING_module[TAIL - 2].register_forward_hook(lambda _, __, found: caught.append(found))
    with torch.no_grad():
        network(torch.from_numpy(reference["input"][:1]).double())
        drawn = drawn_network()(drawn_patch())
    assert torch.equal(loss_target(), torch.from_numpy(reference["loss_target"]))
    tail = {
        f"tail/{name}": value.numpy()
        for name, value in state.items()
        if name.startswith("UPSAMPLING_module") and int(name.split(".")[1]) >= TAIL
    }
    points = list(POINTS)
    return {
        "loss_prediction": reference["loss_prediction"],
        "loss_target_sha256": np.array(digest(torch.from_numpy(reference["loss_target"]))),
        **{name: reference[name] for name in TERMS},
        **tail,
        "features": caught[0][0, :, points].float().numpy(),
        "output": np.stack([reference["output"][0, [i + 1024 * copy for i in points]] for copy in range(4)]),
        "drawn_output": drawn[0, ::8].numpy(),
    }


def released() -> dict[str, np.ndarray]:
    with np.load(FILE) as file:
        return dict(file)


if __name__ == "__main__":
    np.savez_compressed(FILE, **contents(np.load(sys.argv[1])))
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB")
