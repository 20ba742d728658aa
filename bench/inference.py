"""Upsampling 5000 -> 20000 points against the paper's procedure done naively, in a warm process and as a command."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.ops import full_matrix, plain_farthest_points
from bench.plain import PlainPNU
from bench.scale import wavy_sphere
from bench.timing import Row, compare
from pnu.io import write_cloud, write_json
from pnu.networks.checkpoints import load
from pnu.networks.pnu import PNU
from pnu.networks.released import from_released
from pnu.upsamplers.whole_clouds import upsample

POINTS, RATIO, PATCH = 5000, 4, 1024
SHARED = 10_000  # points of a cloud that processes share


@torch.no_grad()
def naive(network: torch.nn.Module, cloud: Tensor, size: int = PATCH) -> Tensor:
    """The paper's section Inference word by word: full matrices, one patch after the other. cloud (n, 6)."""
    points = cloud[:, :3]
    count = round(RATIO * len(cloud) / size)
    centers = plain_farthest_points(points[None], count)[0]
    idx = full_matrix(points[None, centers], points[None])[0].topk(size, largest=False).indices
    predicted = []
    for patch in cloud[idx]:
        middle = patch[:, :3].mean(0)
        radius = (patch[:, :3] - middle).norm(dim=1).max()
        dense = network(torch.cat([(patch[:, :3] - middle) / radius, patch[:, 3:]], 1)[None])[0]
        predicted.append(torch.cat([dense[:, :3] * radius + middle, dense[:, 3:]], 1))
    everything = torch.cat(predicted)
    return everything[plain_loop(everything[:, :3], RATIO * len(cloud))]


def plain_loop(points: Tensor, m: int) -> Tensor:
    """Farthest points of one cloud without its matrix, which has no room for 80000 points."""
    reach = torch.full((len(points),), torch.inf)
    chosen = torch.zeros(m, dtype=torch.int64)
    for i in range(1, m):
        torch.minimum(reach, (points - points[chosen[i - 1]]).square().sum(1), out=reach)
        chosen[i] = reach.argmax()
    return chosen


def as_run(network: torch.nn.Module, folder: Path) -> Path:
    """A run folder with a network of the paper."""
    (folder / "checkpoints").mkdir(parents=True)
    state = {f"model.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state}, folder / "checkpoints" / "best.ckpt")
    (folder / "config.yaml").write_text("model: {_target_: pnu.networks.pnu.PNU}\n")
    write_json(folder / "run.json", {"status": "finished"})
    return folder


def rows() -> Iterator[Row]:
    """Each as soon as it is measured."""
    torch.manual_seed(0)
    plain, ours = PlainPNU().eval(), PNU().eval()
    ours.load_state_dict(from_released(plain.state_dict()))
    cloud = wavy_sphere(POINTS)
    points, normals = cloud[:, :3], cloud[:, 3:]
    tensor = torch.from_numpy(cloud).float()
    size = f"{POINTS} -> {RATIO * POINTS}"
    theirs = "the paper's procedure, naively"
    turns = compare(
        "",
        {
            "pnu": partial(upsample, points, normals, model=ours),
            "surface": partial(upsample, points, normals, model="surface"),
            theirs: partial(naive, plain, tensor),
        },
        rounds=2,
    ).seconds
    for name, title in (("pnu", "network pnu"), ("surface", "surface")):
        yield Row(f"upsample {size}, {title}, warm", {"pnu": turns[name], theirs: turns[theirs]})
    ships: Any = load("pnu")
    yield compare(
        f"upsample {size}, pnu as it ships, patches of {ships.patch_size}, warm",
        {
            "pnu": partial(upsample, points, normals, model=ships),
            theirs: partial(naive, ships, tensor, ships.patch_size),
        },
        rounds=2,
    )
    large = wavy_sphere(SHARED)
    share = partial(upsample, large[:, :3], large[:, 3:], model="surface", device="cpu")
    yield compare(
        f"upsample {SHARED} -> {RATIO * SHARED}, surface, {torch.get_num_threads()} threads",
        {"pnu": share, "2 processes, with their start (devices=2)": partial(share, devices=2)},
        rounds=1,
    )
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "cloud.ply", Path(folder) / "dense.ply"
        write_cloud(source, points, normals)
        command = [sys.executable, "-m", "pnu", "upsample", f"input={source}", f"output={target}", "quiet=true"]
        alone = [sys.executable, "-c", "import torch"]
        run = partial(subprocess.run, check=True, capture_output=True)
        for name, weights in (("network pnu", as_run(ours, Path(folder) / "run")), ("surface", "surface")):
            yield compare(
                f"whole command {size}, {name}",
                {
                    "pnu upsample": partial(run, [*command, f"run={weights}"]),
                    "import torch": partial(run, alone),
                },
                rounds=3,
            )
