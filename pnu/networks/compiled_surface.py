"""The surface model without torch: weights read as arrays, its step computed by compiled kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnu import kernels, weights
from pnu.config.instantiate import present_name
from pnu.geometry.neighbor_ranks import neighbor_ranks

Floats = NDArray[np.float64]
Project = Callable[[Floats, Floats, NDArray[np.int64]], Floats]
"""project(queries (m, 6), cloud (n, 6 + messages), their neighbors idx (m, k)) -> (m, 7 + messages): points, unit
normals, logarithm of the expected error, messages."""

TARGET = "pnu.networks.surface.Surface"
WIDTHS = {  # layers: rows and columns of their weights, in widths of the network and features more
    "first": (1, 0, 11), "second": (1, 1, 0), "context": (1, 2, 1), "third": (1, 1, 0),
    "head.0": (2, 3, 0), "head.2": (1, 2, 0), "out": (0, 1, 0),
}  # fmt: skip
OUT, PREFIX, COARSE = 7, "projector.", "coarse."
NEAREST = 16  # points that a coarse network looks at
SETTINGS = (
    "ratio", "neighbors", "reach", "seeds", "candidates", "shortlist", "relaxation", "refinements", "reject", "slide",
    "passes", "sphere", "attention", "fine", "messages",
)  # fmt: skip
TRAINING = ("width", "rounds", "queries", "smoothing", "refining", "coarse")  # that nothing here depends on


class CompiledSurface:
    """What `pnu.networks.surface.Surface` is at work: its settings, as there, and its step.

    Args:
        settings: those of SETTINGS by name.
        parameters: of its projector, float32, by the names of its state dict.
        coarse: the smaller network of its first projections, where it has one.
    """

    predicts_normals = True
    procedure = "surface"
    ratio: int
    neighbors: int
    reach: int
    seeds: float
    candidates: float | None
    shortlist: float | None
    relaxation: int
    refinements: int
    reject: float
    slide: float
    passes: int
    sphere: bool
    attention: bool
    fine: int
    messages: int

    def __init__(
        self, settings: Mapping[str, Any], parameters: Mapping[str, NDArray[np.float32]],
        coarse: CompiledSurface | None = None,
    ) -> None:  # fmt: skip
        vars(self).update({name: settings[name] for name in SETTINGS})
        self.parameters, self.coarse = dict(parameters), coarse
        self.step: Project | None = None

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"step": None}

    def state_dict(self) -> dict[str, NDArray[np.float32]]:
        """The parameters by name."""
        coarse = self.coarse.parameters if self.coarse is not None else {}
        return self.parameters | {f"{COARSE}{name}": value for name, value in coarse.items()}

    def ranks(self, n: int) -> list[int]:
        """Ranks of the neighbors that are looked at, of those that a cloud of n points has."""
        return neighbor_ranks(self.neighbors, self.reach, n)

    def project(self, query: Floats, cloud: Floats, idx: NDArray[np.int64]) -> Floats:
        """See `Project`."""
        if self.step is None:
            self.step = compiled_step(self.parameters, sphere=self.sphere, attention=self.attention)
        return self.step(query, cloud, idx)


def compiled_step(parameters: Mapping[str, NDArray[np.float32]], *, sphere: bool, attention: bool) -> Project:
    """The step of a projector with these parameters."""
    from pnu.kernels.projector import packed, project_queries

    matrices, results = packed(dict(parameters), attention=attention), len(parameters["out.bias"])

    def step(query: Floats, cloud: Floats, idx: NDArray[np.int64]) -> Floats:
        result = np.empty((len(query), results))
        project_queries(*contiguous(query, cloud, idx), sphere, *matrices, result)
        return result

    return step


def compiled_feet(query: Floats, cloud: Floats, idx: NDArray[np.int64]) -> Floats:
    """As `Project`: to the sphere that fits the neighbors (`pnu.geometry.local_frames.feet`), and zeros."""
    from pnu.kernels.frames import project_to_spheres

    result = np.zeros((len(query), 7))
    project_to_spheres(*contiguous(query, cloud, idx), result[:, :6])
    return result


def contiguous(query: Floats, cloud: Floats, idx: NDArray[np.int64]) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """As kernels take them."""
    return (
        np.ascontiguousarray(query, np.float64),
        np.ascontiguousarray(cloud, np.float64),
        np.ascontiguousarray(idx, np.int64),
    )


def is_known(parameters: Mapping[str, Any]) -> bool:
    """Whether parameters (arrays or tensors) are those of a projector as the kernels know it."""
    width = len(parameters.get("first.bias", ()))
    messages = max(0, len(parameters.get("out.bias", ())) - OUT)
    shapes: dict[str, tuple[int, ...]] = {"attention.weight": (width + 2, width)}
    for layer, (rows, columns, more) in WIDTHS.items():
        out, more = rows * width or OUT + messages, more + messages * (layer == "first")
        shapes |= {f"{layer}.weight": (out, columns * width + more), f"{layer}.bias": (out,)}
    return width > 0 and {name: tuple(value.shape) for name, value in parameters.items()} == shapes


def read_compiled(source: str | PathLike[str]) -> CompiledSurface | None:
    """The surface model that a file of weights holds, or shipped weights; None where it is for torch to read.

    That is what holds another network, other settings or other types, what is damaged, and all where no kernels are
    ready.
    """
    path = weights.find(source)
    if path is None or not kernels.ready():
        return None
    try:
        found = weights.read(path, "numpy")
    except (ValueError, TypeError):  # types that NumPy has not, say
        return None
    settings = {key.replace("neighbour", "neighbor"): value for key, value in found.model.items()}
    settings = {"passes": 0, "slide": 1, "fine": 1, "messages": 0} | settings
    parameters, of_coarse = (_parts(found.state, prefix) for prefix in (PREFIX, COARSE + PREFIX))
    target = present_name(str(settings.pop("_target_", "")))
    fits = target == TARGET and {*SETTINGS} <= {*settings} <= {*SETTINGS, *TRAINING}
    single = all(value.dtype == np.float32 for value in found.state.values())
    whole = len(found.state) == len(parameters) + len(of_coarse)
    known = is_known(parameters) and (is_known(of_coarse) if settings.get("coarse") else not of_coarse)
    told = known and len(parameters["out.bias"]) - OUT == settings["messages"]
    told = told and len(of_coarse.get("out.bias", range(OUT))) == OUT
    if not (fits and single and whole and told and _sound(settings)):
        return None
    few = settings | {"neighbors": NEAREST, "reach": NEAREST, "messages": 0}
    return CompiledSurface(settings, parameters, CompiledSurface(few, of_coarse) if of_coarse else None)


def _parts(state: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """The parameters whose names begin so, by what follows."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _sound(settings: Mapping[str, Any]) -> bool:
    """Whether the network takes these settings; what it does not, it says itself."""
    by_case = {name for name in ("candidates", "shortlist") if settings[name] is None}
    numbers = all(isinstance(settings[name], int | float) for name in {*SETTINGS} - by_case)
    one = {"seeds", "candidates", "shortlist", "refinements", "fine"} - by_case
    return (
        numbers
        and 4 <= settings["neighbors"] <= settings["reach"]
        and all(settings[name] >= 1 for name in one)
        and min(settings["reject"], settings["passes"], settings["messages"]) >= 0
        and 0 <= settings["slide"] <= 1
    )
