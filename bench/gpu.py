"""All that only a GPU can show, in one command of some fifteen minutes: `python -m bench.gpu [PART ...]`.

Parts, in this order; each writes its lines to FOLDER/gpu.md when it is done, so that what was measured is kept whatever
happens after it:

- `kernels`: the Triton searches against their slow twins, same neighbors and how many times as fast
- `surface`: closest points on true meshes beside all pairs of points and triangles, and the training step of the model
  for clouds without normals
- `step`: the training step of the paper's size, 20 x 1024 -> 4096, forward, loss, backward, Adam, at each precision and
  as a CUDA graph, and where its time goes
- `upsample`: shipped models on the GPU beside the CPU
- `schedule`: trains the paper's network (`scale=full`) for the minutes that are left, with checkpoints, in FOLDER/run;
  the step is captured, and the rate follows the time

`--device cpu --small` tries all of it without a GPU, in a minute or two; the numbers then mean nothing.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity
from torch.profiler import profile as torch_profile

import pnu
from bench.ops import full_matrix, plain_ball_query, plain_closest_points, plain_farthest_points
from bench.step import data, step
from bench.timing import Row, compare
from pnu.data import shapes
from pnu.data.crops import Crops, flattened
from pnu.data.mesh_scene import MeshScene
from pnu.fast import accelerate
from pnu.geometry.neighbor_search import ball_query, gpu_kernels, knn
from pnu.geometry.sampling import farthest_points
from pnu.io import atomic_path
from pnu.losses import CompoundLoss
from pnu.losses.projection import SurfaceLoss
from pnu.networks.pnu import PNU
from pnu.networks.surface import Surface
from pnu.runtime.provenance import provenance
from pnu.runtime.threads import processor_count

EPOCH_STEPS = 200  # of the paper: 4000 patches in batches of 20


class Plan(NamedTuple):
    """Where and how large."""

    device: torch.device
    small: bool
    folder: Path
    until: float  # of time.monotonic(), for the schedule

    def finished(self, function: Callable[[], object]) -> Callable[[], None]:
        """The function until the device has done all of it."""

        def run() -> None:
            function()
            if self.device.type == "cuda":
                torch.cuda.synchronize()

        return run

    def compare(self, name: str, contestants: dict[str, Callable[[], object]], rounds: int = 5) -> Row:
        return compare(name, {of: self.finished(run) for of, run in contestants.items()}, rounds=rounds)


def kernel_lines(plan: Plan) -> Iterator[str]:
    """Each search beside full distance matrices on the same device: equal, and how fast."""
    clouds, n, m = (2, 200, 60) if plan.small else (20, 4096, 1024)
    points = torch.rand(clouds, n, 3, generator=torch.Generator().manual_seed(0)).sub(0.5).to(plan.device)
    centers = points[:, :m].contiguous()
    chosen = "Triton kernels" if gpu_kernels(points) else "no Triton kernels here: what runs without them"
    yield f"Searches ({chosen}):"
    pairs: dict[str, tuple[Callable[[], Tensor], Callable[[], Tensor]]] = {
        f"16 nearest, {clouds} x {n}": (
            lambda: knn(points, points, 16).dist_sq,
            lambda: full_matrix(points, points).topk(16, largest=False).values.square(),
        ),
        f"farthest points, {clouds} x {n} -> {m}": (
            lambda: farthest_points(points, m),
            lambda: plain_farthest_points(points, m),
        ),
        f"ball query r = 0.1, {clouds} x {m} in {m}": (
            lambda: ball_query(centers, centers, 0.1, 32),
            lambda: plain_ball_query(centers, centers, 0.1, 32),
        ),
    }
    for name, (ours, plain) in pairs.items():
        found, expected = ours(), plain()
        if found.is_floating_point():
            same = f"greatest difference {(found - expected).abs().max():.1e}"
        else:
            same = f"{(found == expected).double().mean():.2%} of the indices the same"
        yield f"- {plan.compare(name, {'pnu': ours, 'full matrices': plain}, rounds=3)}; {same}"


def surface_lines(plan: Plan) -> Iterator[str]:
    """What a training of the surface model asks of a GPU: closest points of meshes, and a whole step."""
    clouds, views, queries = (1, 2, 12) if plan.small else (16, 12, 72)
    meshes = {name: shapes.make(name) for name in ("cup", "dice", "knob", "nut")}
    scene = MeshScene(list(meshes.values()))
    crops = Crops(meshes, clouds, size=160 if plan.small else 288, views=views, normals="estimated", least=300)
    batch = flattened([crops[0, index] for index in range(clouds)])
    batch = {name: value.to(plan.device) if isinstance(value, Tensor) else value for name, value in batch.items()}
    batch["surface"] = scene

    shape = torch.zeros(1, dtype=torch.int64, device=plan.device)
    mesh = scene.meshes[0]
    corners = torch.from_numpy(mesh.vertices[mesh.faces]).float().to(plan.device)
    points = torch.rand(256, 3, generator=torch.Generator().manual_seed(0)).sub(0.5).to(plan.device)

    def ours() -> Tensor:
        return scene.closest(points[None], shape)[0][0]

    def plain() -> Tensor:
        return plain_closest_points(points, corners)

    apart = ((points - ours()).norm(dim=1) - (points - plain()).norm(dim=1)).abs().max()
    name = f"closest points, {len(points)} on {len(corners)} triangles"
    row = plan.compare(name, {"pnu": ours, "all pairs": plain}, rounds=3)
    yield f"- {row}; greatest difference of distances {apart:.1e}"

    torch.manual_seed(0)
    network = Surface(neighbors=32, reach=48, queries=queries, messages=8, passes=2).to(plan.device)
    loss, optimizer = SurfaceLoss(), torch.optim.AdamW(network.parameters(), 1e-4, fused=True)

    def one_step() -> None:
        optimizer.zero_grad()
        outputs = network.outputs(batch["input"])
        loss(outputs["prediction"], batch["target"], {**batch, **outputs})["loss"].backward()
        optimizer.step()

    row = plan.compare("", {"pnu": one_step}, rounds=3)
    yield f"- training step of the surface model, {clouds * views} crops: {1e3 * row.seconds['pnu']:.1f} ms"


def step_lines(plan: Plan) -> Iterator[str]:
    """The training step at each precision, milliseconds, and its most expensive operations."""
    inputs, target = data()
    if plan.small:
        inputs, target = inputs[:2, :64].contiguous(), target[:2, :256].contiguous()
    batch = (inputs.to(plan.device), target.to(plan.device))
    networks: dict[str, Callable[[], object]] = {
        "float32, plain modules": training(plan, batch, "highest", None, fast=False)
    }
    for name, precision, dtype in (
        ("float32", "highest", None),
        ("TF32", "high", None),
        ("bfloat16", "high", torch.bfloat16),
    ):
        networks[name] = training(plan, batch, precision, dtype)
    if plan.device.type == "cuda":
        networks["TF32, a graph"] = captured(networks["TF32"])
        networks["TF32, plain modules, a graph"] = captured(training(plan, batch, "high", None, fast=False))
    row = plan.compare(f"training step, {len(inputs)} x {inputs.shape[1]} -> {target.shape[1]}", networks)
    torch.set_float32_matmul_precision("highest")
    for name, seconds in row.seconds.items():
        hours = seconds * EPOCH_STEPS * 500 / 3600
        yield f"- training step, {name}: {1e3 * seconds:.1f} ms; 500 epochs of {EPOCH_STEPS} steps {hours:.2f} h"
    kinds = [ProfilerActivity.CPU] + ([ProfilerActivity.CUDA] if plan.device.type == "cuda" else [])
    with torch_profile(activities=kinds) as profiled:
        plan.finished(networks["float32"])()
    order = "self_device_time_total" if plan.device.type == "cuda" else "self_cpu_time_total"
    yield "\n```\n" + profiled.key_averages().table(sort_by=order, row_limit=15, max_name_column_width=60) + "```\n"


def training(
    plan: Plan, batch: tuple[Tensor, Tensor], precision: str, dtype: torch.dtype | None, *, fast: bool = True
) -> Callable[[], object]:
    """A step of a network of its own; `dtype` of autocast, with the loss in float32 as in training. `fast`: with the
    kernels of `pnu.fast`, as `pnu train` has them."""
    torch.manual_seed(0)
    network, loss = PNU().to(plan.device), CompoundLoss().to(plan.device)
    if fast:
        network, loss = accelerate(network), accelerate(loss)
    on_gpu = plan.device.type == "cuda"
    optimizer = torch.optim.Adam(network.parameters(), 1e-3, weight_decay=1e-5, capturable=on_gpu, fused=on_gpu)

    def forward(inputs: Tensor) -> Tensor:
        with torch.autocast(plan.device.type, dtype) if dtype else nullcontext():
            made: Tensor = network(inputs)
        return made.float()

    def run() -> Tensor:
        torch.set_float32_matmul_precision(precision)
        return step(forward, loss, optimizer, batch)

    return run


def captured(run: Callable[[], object]) -> Callable[[], object]:
    """A step as one CUDA graph, after the trial runs that a capture wants."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            run()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph.replay


def upsample_lines(plan: Plan) -> Iterator[str]:
    """Shipped models, warm, on the device beside the CPU."""
    points, ratio = (400, 4) if plan.small else (5000, 4)
    cloud = data()[1][0, :points] if plan.small else data()[1].flatten(0, 1)[:points]
    for name in ("surface", "pnu"):
        runs = {}
        for device in dict.fromkeys((str(plan.device), "cpu")):
            upsampler = pnu.PointCloudUpsampler(model=name, ratio=ratio, device=device).fit()
            runs[device] = partial(upsampler.transform, cloud.numpy())
        yield f"- {plan.compare(f'upsample {points} -> {ratio * points}, {name}, warm', runs, rounds=3)}"


def schedule_lines(plan: Plan) -> Iterator[str]:
    """The paper's schedule for as long as there is time, its checkpoints in the folder."""
    seconds = int(plan.until - time.monotonic()) - 30
    if seconds < 30:
        yield "- schedule: no time was left"
        return
    run = plan.folder / "run"
    length = time.strftime("00:%H:%M:%S", time.gmtime(seconds))
    arguments = [f"run={run}", f"trainer.max_time={length}", "quiet=true"]
    if not (run / "config.yaml").exists():
        workers = max(1, processor_count() - 2)  # with many, samples are cut as fast as the GPU wants them
        arguments += ["scheduler=onecycle", "trainer.max_epochs=-1", f"data.on_device={str(workers < 8).lower()}"]
        arguments += ["scale=small", "data.patches=100"] if plan.small else ["scale=full", "data.patches=4000"]
        if plan.device.type == "cuda":
            arguments += [
                "trainer=gpu",
                f"data.workers={workers}",
                "callbacks=[default,cuda_graph]",
                "callbacks.cuda_graph.tf32=true",
            ]
        else:
            arguments += ["trainer=cpu"]
        if plan.small:
            arguments += ["trainer.max_steps=3", "trainer.val_check_interval=3"]
    started = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "pnu.train", *arguments], capture_output=True, text=True, check=False)
    yield f"- schedule: {' '.join(arguments[1:])}, {time.monotonic() - started:.0f} s, exit code {done.returncode}"
    yield "\n```\n" + "\n".join((done.stdout + done.stderr).splitlines()[-15:]) + "\n```\n"


PARTS: dict[str, Callable[[Plan], Iterator[str]]] = {
    "kernels": kernel_lines,
    "surface": surface_lines,
    "step": step_lines,
    "upsample": upsample_lines,
    "schedule": schedule_lines,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m bench.gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {' '.join(PARTS)}; default: all")
    parser.add_argument("--minutes", type=float, default=14, help="for all of it (default: 14)")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--small", action="store_true", help="sizes that try it without a GPU")
    parser.add_argument("--folder", type=Path, default=Path("outputs/gpu"))
    given = parser.parse_args()
    if unknown := set(given.parts) - set(PARTS):
        parser.error(f"no such part: {' '.join(sorted(unknown))}")
    if given.device.startswith("cuda") and not torch.cuda.is_available():
        parser.error("no GPU that torch sees; --device cpu --small tries the script without one")
    plan = Plan(torch.device(given.device), given.small, given.folder, time.monotonic() + 60 * given.minutes)
    given.folder.mkdir(parents=True, exist_ok=True)
    name = torch.cuda.get_device_name() if plan.device.type == "cuda" else "no GPU, the numbers mean nothing"
    lines = [f"# {name}", "", provenance([1]), ""]
    failed = False
    for part in given.parts or PARTS:
        try:
            for line in PARTS[part](plan):
                lines.append(line)
                print(line, flush=True)
        except Exception as error:  # what comes after can be measured all the same
            failed = True
            lines.append(f"- {part} failed: {type(error).__name__}: {error}")
            print(lines[-1], file=sys.stderr, flush=True)
        with atomic_path(given.folder / "gpu.md") as path:
            path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    sys.exit(failed)


if __name__ == "__main__":
    main()
