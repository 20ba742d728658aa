"""Networks as ONNX files. Searches for neighbors stay outside: what they find goes in beside the points.

`surface`: one projection, see `pnu.networks.surface.Projector`; its inputs are a query's neighbors.
Networks of patches: the patch, and the indices that its searches find, which `neighborhoods` gives for any patch.
"""

import copy
import functools
import io
import json
import logging
import math
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pnu.extras import needed
from pnu.geometry.neighbor_search import Neighbors, ball_query, knn
from pnu.geometry.sampling import farthest_points
from pnu.io import atomic_path
from pnu.networks.surface import Surface

SEARCHES: tuple[Callable[..., Any], ...] = (ball_query, farthest_points, knn)
QUERIES = 100  # of the example that a projector is traced with


class WithNeighborhoods(nn.Module):
    """A network of patches whose searches are answered by further inputs, in the order in which it asks."""

    def __init__(self, network: nn.Module, names: list[str]) -> None:
        super().__init__()
        self.network, self.names = network, names

    def forward(self, patch: Tensor, *found: Tensor) -> Tensor:
        """patch (B, n, 6) and what `neighborhoods` gives for it -> prediction (B, ratio n, 3 or 6)."""
        answers = iter(found)

        def answer(search: Callable[..., Any], *arguments: Any, **_: Any) -> Any:
            idx = next(answers)
            if search is not knn:
                return idx
            query, target = arguments[:2]
            batch = torch.arange(idx.shape[0], device=idx.device)[:, None, None]
            return Neighbors((query[:, :, None] - target[batch, idx]).square().sum(-1), idx)

        with _answered_by(answer):
            dense: Tensor = self.network(patch)
        return dense


def neighborhoods(network: nn.Module, patch: Tensor) -> dict[str, Tensor]:
    """What a network's searches find in patches (B, n, 6): inputs of its ONNX file beside "patch", int64.

    Named by the search and its number: "farthest_points_0" (B, m), the order of farthest points; "ball_query_0" and
    "knn_0" (B, m, k), the points that each of m centers looks at.

    Raises:
        ValueError: it searches among points that it has found itself, which nobody can know before.
    """
    found: dict[str, Tensor] = {}

    def answer(search: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        if any(isinstance(given, Tensor) and given.isnan().any() for given in arguments):
            raise ValueError(
                f"format=onnx: {type(network).__name__} searches among points that it has found itself; networks whose"
                " neighborhoods are known before can be written: surface, pnu, pnu_paper, punet, ecnet, pugeo"
            )
        result = search(*arguments, **options)
        number = sum(name.startswith(search.__name__) for name in found)
        found[f"{search.__name__}_{number}"] = result.idx if isinstance(result, Neighbors) else result
        return result

    unknown = copy.deepcopy(network).eval()  # with weights that nothing can depend on and stay a number
    with torch.no_grad(), _answered_by(answer):
        for parameter in unknown.parameters():
            parameter.fill_(math.nan)
        unknown(patch)
    return found


@contextmanager
def _answered_by(answer: Callable[..., Any]) -> Iterator[None]:
    """Calls of the searches, wherever networks import them, go to answer(search, *arguments) for a while."""
    places = [
        (module, name, search)
        for module in list(sys.modules.values())
        for search in SEARCHES
        for name in [search.__name__]
        if vars(module).get(name) is search and module.__name__ != __name__
    ]
    try:
        for module, name, search in places:
            setattr(module, name, functools.partial(answer, search))
        yield
    finally:
        for module, name, search in places:
            setattr(module, name, search)


def example_inputs(network: nn.Module) -> dict[str, Tensor]:
    """Inputs by name, in order, of the file of a network: of a few queries, or of two patches."""
    draw = torch.Generator().manual_seed(0)
    if isinstance(network, Surface):
        shape = (QUERIES, network.neighbors, 3)
        offsets = 0.1 * torch.randn(shape, generator=draw)
        up = torch.tensor([0.0, 0.0, 1.0])
        normals = up + 0.2 * torch.randn(shape, generator=draw)
        hint = up + 0.1 * torch.randn(QUERIES, 3, generator=draw)
        offsets[..., 2] *= 0.1
        offsets = offsets.gather(1, offsets.norm(dim=-1, keepdim=True).argsort(1).expand(shape))  # nearest first
        unit = torch.nn.functional.normalize
        told = {"told": torch.rand((*shape[:2], network.messages), generator=draw)} if network.messages else {}
        return {"offsets": offsets, "normals": unit(normals, dim=-1), "hint": unit(hint, dim=-1), **told}
    points = torch.nn.functional.normalize(torch.randn(2, int(network.patch_size), 3, generator=draw), dim=-1)  # type: ignore[arg-type]
    columns = int(getattr(network, "channels", 3))
    patch = torch.cat([points, points], -1)[..., :columns]
    return {"patch": patch, **neighborhoods(network, patch)}


def output_names(network: nn.Module) -> list[str]:
    """Names of what the file of a network gives."""
    if not isinstance(network, Surface):
        return ["prediction"]
    return ["step", "normal", "log_error", "spacing", *["tells"] * bool(network.messages)]


def traced(network: nn.Module, names: list[str]) -> nn.Module:
    """The part of a network that a file holds, with inputs of these names."""
    return network.projector if isinstance(network, Surface) else WithNeighborhoods(network, names[1:])


def write_onnx(path: str | Path, network: nn.Module, metadata: Mapping[str, Any]) -> None:
    """Write a network, for any number of queries or patches at once; the file appears whole or not at all.

    Raises:
        MissingExtra: the extra `onnx` is not installed.
        ValueError: the network's searches cannot be taken out of it.
    """
    with needed("format=onnx"):
        import onnx
        import onnxscript  # noqa: F401  # torch wants it

    inputs = example_inputs(network)
    module = traced(network, [*inputs]).eval()
    many = torch.export.Dim("count", min=1)
    shapes: Any = [{0: many}] * len(inputs)
    if isinstance(module, WithNeighborhoods):
        shapes = (shapes[0], tuple(shapes[1:]))
    quiet = logging.getLogger("torch.onnx"), logging.getLogger("onnxscript"), logging.getLogger("onnx_ir")
    before = [log.level for log in quiet]
    try:
        for log in quiet:
            log.setLevel(logging.ERROR)
        with torch.no_grad(), warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()):
            program = torch.onnx.export(
                module, tuple(inputs.values()), input_names=[*inputs], output_names=output_names(network),
                dynamic_shapes=shapes, dynamo=True, verbose=False,
                optimize=False,  # it takes the 1e-8 that interpolation divides by for nothing
            )  # fmt: skip
    finally:
        for log, level in zip(quiet, before, strict=True):
            log.setLevel(level)
    assert program is not None
    model = program.model_proto
    for node in [*model.graph.node, *(node for function in model.functions for node in function.node)]:
        del node.metadata_props[:]  # lines of source, and the paths of this machine
    onnx.helper.set_model_props(model, {name: json.dumps(value) for name, value in metadata.items()})
    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(model.SerializeToString())


def difference(path: str | Path, network: nn.Module, inputs: Mapping[str, Tensor]) -> float:
    """Largest difference between what onnxruntime computes from a file and what torch computes, of the largest value.

    Raises:
        MissingExtra: the extra `onnx` is not installed.
    """
    with needed("checking an onnx file"):
        import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    with torch.no_grad():
        expected = traced(network, [*inputs])(*inputs.values())
    expected = expected if isinstance(expected, tuple) else (expected,)
    return max(
        float(np.abs(one - other.numpy()).max() / other.abs().max()) for one, other in zip(found, expected, strict=True)
    )
