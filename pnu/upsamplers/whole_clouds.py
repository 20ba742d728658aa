"""Densify whole clouds with a trained network: no Hydra, no Lightning, usable from a notebook."""

import copy
import hashlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, overload

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from pnu import __version__
from pnu.cleaning import Treatment, clean_cloud
from pnu.fast import accelerated
from pnu.geometry.attributes import carry
from pnu.geometry.cloud_normals import settled_normals
from pnu.geometry.normal_estimation import complete_normals
from pnu.geometry.unit_sphere import Frame, unit_sphere_frame
from pnu.io import Cloud, check_cloud
from pnu.io.library_clouds import Kind, LibraryCloud, kind_of, tensor_like
from pnu.io.sensor import asked_sight
from pnu.networks import checkpoints
from pnu.reconstruction import fill_holes
from pnu.runtime.parts import Parts
from pnu.runtime.progress import Progress, silent
from pnu.runtime.workers import Processes
from pnu.upsamplers import CLASSICAL, Context, Upsampler, classical, upsampler_of
from pnu.upsamplers.density import DENSITIES, Density, count_of_spacing
from pnu.upsamplers.learned_normals import learned_normals
from pnu.upsamplers.patches import with_unit_normals
from pnu.upsamplers.surface_projection import is_clean_and_even

Model: TypeAlias = "nn.Module | Upsampler | LoadedWeights | str | PathLike[str]"

MINIMUM = 16  # points of a cloud
LARGEST = 10**9  # points of an output

# what comes back as the kind that was given, for type checkers and editors; arrays and lists come back as arrays
CloudT = TypeVar("CloudT", bound=Tensor | LibraryCloud)


@overload
def upsample(
    points: CloudT,
    normals: np.ndarray | Tensor | None = None,
    *,
    ratio: float = 4,
    spacing: float | None = None,
    model: Model = "surface",
    patch_size: int | None = None,
    density: Density = "auto",
    keep: bool | Literal["auto"] = "auto",
    outliers: Treatment = "auto",
    lines: Treatment = "auto",
    signs: Treatment = "auto",
    holes: float | None = None,
    device: str = "auto",
    devices: int = 1,
    batch_size: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
    parts: str | PathLike[str] | None = None,
) -> CloudT: ...


@overload
def upsample(
    points: np.ndarray | Sequence[Sequence[float]],
    normals: np.ndarray | Tensor | None = None,
    *,
    ratio: float = 4,
    spacing: float | None = None,
    model: Model = "surface",
    patch_size: int | None = None,
    density: Density = "auto",
    keep: bool | Literal["auto"] = "auto",
    outliers: Treatment = "auto",
    lines: Treatment = "auto",
    signs: Treatment = "auto",
    holes: float | None = None,
    device: str = "auto",
    devices: int = 1,
    batch_size: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
    parts: str | PathLike[str] | None = None,
) -> np.ndarray: ...


def upsample(
    points: Any,
    normals: np.ndarray | Tensor | None = None,
    *,
    ratio: float = 4,
    spacing: float | None = None,
    model: Model = "surface",
    patch_size: int | None = None,
    density: Density = "auto",
    keep: bool | Literal["auto"] = "auto",
    outliers: Treatment = "auto",
    lines: Treatment = "auto",
    signs: Treatment = "auto",
    holes: float | None = None,
    device: str = "auto",
    devices: int = 1,
    batch_size: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
    parts: str | PathLike[str] | None = None,
) -> Any:
    """A denser cloud on the same surface.

    Networks of patches are used as in the paper (`pnu.upsamplers.patches`); "surface" and upsamplers without a network
    take the cloud as a whole. Neither the order of the points nor repeated ones have an influence. A network comes back
    as it was, modes and device too; generators and settings of torch are left alone.

    Args:
        points: (n, 3), or (n, 6) with normals, n >= 16, in any unit and anywhere: an array, a tensor on any device, or
            a cloud of Open3D (`geometry.PointCloud`, `t.geometry.PointCloud`), trimesh (`PointCloud`), PyVista
            (`PolyData`) or PyTorch Geometric (`Data`), whose normals, colors and other values are taken too. Points
            that are not finite, or at the place of another, are left out: n is the number of the others, and
            `pnu.io.check_cloud` tells what it finds.
        normals: (n, 3), of any length; estimated and oriented where missing, zero or NaN here and in points.
        ratio: points out for each point in, any number >= 1.
        spacing: instead of ratio, the distance wanted between points, in their unit; so many come out as have it if
            evenly spread.
        model: network, run folder, file of weights, the name of weights that come with pnu (`pnu.weights`), "newest",
            the run that finished last under outputs/, or an upsampler: "apss", "poisson", "midpoint", or one's own.
            "surface" takes the weights made for estimated normals where none are given.
        patch_size: points of a patch, at least 16; None: what the network was made for. "surface" has no patches.
        density: of the points of "surface". "even" over the surface; "follow": each point becomes `ratio`; "auto": even
            where no place loses points by it, elsewhere those that it has.
        keep: of "surface". True: the points given are among those that come out, first and unmoved, and new ones fill
            between; False: all are new; "auto": kept where they are evenly spread and show no noise.
        outliers: "auto": stray points are taken out first, and not counted less for it: n stays; "keep": none is.
        lines: "auto": scan lines, dense along and sparse across, are thinned out first; "keep": they stay.
        signs: "auto": where given normals contradict each other, their axes are kept and their sides chosen anew;
            "keep": they are taken as they are.
        holes: radius, in the unit of the points, up to which holes are filled, by points beyond round(ratio n) that
            continue the surface smoothly (`pnu.reconstruction.fill_holes`); None: none is.
        device: "auto" (where the given network is; else CUDA where there is one), "cpu", "cuda", "cuda:1" ...
        devices: CUDA devices, or processes on the CPU, that share the work of the network; the result is the same for
            any number. More than one needs `if __name__ == "__main__":` in a script.
        batch_size: patches at once on a GPU, by default 64; on the CPU each thread takes one. Of "surface": points at
            once, by default 65536 on a GPU and 512 a thread on the CPU.
        seed: of models that draw random numbers; the paper's procedure draws none.
        progress: called as progress(stage, done, total).
        parts: folder for finished parts of a long computation; the same call goes on from them after an interruption.

    Returns:
        (round(ratio n), 6) float64: points in the frame and unit of the input, and unit normals; with `holes` those
        that fill them after these. Of the kind that was given: a tensor on its device, float32 where it is, else
        float64; a cloud of that library, with normals and its colors and other values carried over.

    Raises:
        ValueError: in one line, which argument is wrong and what was expected.

    Example:
        >>> import numpy as np
        >>> import pnu
        >>> sphere = np.random.default_rng(0).normal(size=(500, 3))
        >>> sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        >>> dense = pnu.upsample(sphere, ratio=4)
        >>> dense.shape
        (2000, 6)
        >>> bool((abs(np.linalg.norm(dense[:, :3], axis=1) - 1) < 0.05).all())
        True
    """
    kind = kind_of(points)
    expected = "points: expected an array (n, 3), or (n, 6) with normals"
    given = check_cloud(Cloud(*_taken(points, normals, kind, expected, (3, 6))), "points", minimum=MINIMUM)
    count = output_count(len(given.points), ratio if spacing is None else ratio_of_spacing(given.points, spacing))
    sizes = (
        ("patch_size", patch_size, MINIMUM),
        ("batch_size", batch_size, 1),
        ("devices", devices, 1),
        ("seed", seed, 0),
    )
    for name, value, least in sizes:
        if value is not None and not (isinstance(value, Integral) and value >= least):
            raise ValueError(f"{name}={value}: expected a whole number >= {least}")
    if holes is not None and not (isinstance(holes, Real) and 0 < holes < float("inf")):
        raise ValueError(f"holes={_short(holes)}: expected a radius above 0 in the unit of the points")
    if density not in DENSITIES:
        raise ValueError(f"density={density}: expected {', '.join(DENSITIES)}")
    if keep not in (True, False, "auto"):
        raise ValueError(f"keep={keep}: expected true, false or auto")
    given, _, scanned = clean_cloud(given, outliers=outliers, lines="keep" if keep is True else lines, signs=signs)
    network, target = on_device(*_model(model, given.normals, scanned), device)
    upsampler = upsampler_of(network, patch_size)
    if devices > 1 and not getattr(upsampler, "parallel", False):
        raise ValueError(f"devices={devices}: {type(network).__name__} works in one process; leave devices=1")
    names = _names(target, devices)
    sparse, frame = _prepare(given, progress, refine=not getattr(network, "passes", 0))
    if not getattr(upsampler, "follows", False) and (density == "follow" or keep is True):
        asked = "density=follow" if density == "follow" else "keep=true"
        raise ValueError(
            f"{asked}: {type(network).__name__} spreads new points evenly; take model surface (run=surface)"
        )
    follows = getattr(upsampler, "follows", False)
    keeps = (follows and is_clean_and_even(sparse)) if keep == "auto" else keep
    digest = _digest(network, sparse, count, upsampler, density, keeps)
    finished = Parts() if parts is None else Parts(Path(parts) / digest)
    context = Context(
        target, batch_size, torch.Generator().manual_seed(seed), progress, finished, density=density, keep=keeps
    )  # fmt: skip
    with torch.no_grad(), evaluating(network), accelerated(modules_of(network)), ExitStack() as stack:
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        if devices > 1:
            context = replace(context, workers=stack.enter_context(Processes(copy.deepcopy(network).cpu(), names)))
        raw = upsampler.upsample_cloud(sparse.to(target), count, context)
        dense = with_unit_normals(raw.cpu().double(), sparse)
    found = frame.from_unit(dense[None])[0].numpy()
    if keeps:
        found = _measured_first(found, dense, sparse, given)
    if holes is not None:
        progress("holes", 0, 1)
        found = np.vstack([found, fill_holes(found, holes)])
        progress("holes", 1, 1)
    if kind is not None:
        return kind.dense(points, Cloud(found[:, :3], found[:, 3:], attributes(found, given)))
    return tensor_like(points, found) if isinstance(points, Tensor) else found


def _measured_first(found: np.ndarray, unit: Tensor, sparse: Tensor, given: Cloud) -> np.ndarray:
    """The points found (m, 6), those first that were given: in their order, not moved by a bit, with their normals.

    In the unit sphere they are `unit` (m, 6), and those given `sparse` (n, 6), sorted.
    """
    rows = np.empty(len(sparse), np.int64)
    rows[np.lexsort(given.points.T)] = cKDTree(unit[:, :3].numpy()).query(sparse[:, :3].numpy())[1]
    kept = found[rows]
    kept[:, :3] = given.points
    if given.normals is not None:
        known = np.isfinite(given.normals[:, 0])
        kept[known, 3:] = given.normals[known]
    return np.vstack([kept, np.delete(found, rows, axis=0)])


def attributes(dense: np.ndarray, cloud: Cloud) -> dict[str, np.ndarray]:
    """Colors and scalars of a cloud at the points of its denser version (m, 6), see `pnu.geometry.attributes`."""
    if not cloud.attributes:
        return {}
    given = None if cloud.normals is None else torch.from_numpy(cloud.normals)
    normals = complete_normals(torch.from_numpy(cloud.points), given).numpy()
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    sparse = np.hstack([cloud.points, normals / np.maximum(length, 1e-300)])
    return {name: carry(dense, sparse, values) for name, values in cloud.attributes.items()}


def attributes_with_filled(dense: np.ndarray, cloud: Cloud, count: int) -> dict[str, np.ndarray]:
    """`attributes`, and which of the points (m, 6) fill holes, those after the first `count`: 1, else 0."""
    found = attributes(dense, cloud)
    before = found.get("filled", np.zeros(len(dense)))
    return found | {"filled": np.where(np.arange(len(dense)) >= count, 1, before).astype(np.uint8)}


def ratio_of_spacing(points: np.ndarray, spacing: float) -> float:
    """The ratio by which points (n, 3) get that spacing; `ValueError` if that is none, or wider than they have."""
    if not (isinstance(spacing, Real) and 0 < spacing < float("inf")):
        raise ValueError(f"spacing={_short(spacing)}: expected a length > 0 in the unit of the points")
    ratio = count_of_spacing(points, float(spacing)) / len(points)
    if ratio < 1:
        raise ValueError(
            f"spacing={spacing:g}: the points are nearer to each other, {spacing * ratio**0.5:.3g}; give a smaller one"
        )
    return ratio


def output_count(n: int, ratio: float) -> int:
    """round(ratio n), or `ValueError` for a ratio that is no number >= 1 or asks for more than 1e9 points."""
    if not (isinstance(ratio, Real) and 1 <= ratio < float("inf")):
        raise ValueError(f"ratio={_short(ratio)}: expected a number >= 1, the points out for each point in")
    count = round(ratio * n)
    if count > LARGEST:
        raise ValueError(f"ratio={ratio:g}: asks for {count} points, at most {LARGEST:g} are made; lower it")
    return count


@overload
def normals(
    points: CloudT,
    normals: np.ndarray | Tensor | None = None,
    *,
    viewpoint: np.ndarray | Sequence[float] | None = None,
    up: str | np.ndarray | Sequence[float] | None = None,
    side: Literal["out", "in"] | None = None,
    neighbors: int = 16,
    progress: Progress = silent,
) -> CloudT: ...


@overload
def normals(
    points: np.ndarray | Sequence[Sequence[float]],
    normals: np.ndarray | Tensor | None = None,
    *,
    viewpoint: np.ndarray | Sequence[float] | None = None,
    up: str | np.ndarray | Sequence[float] | None = None,
    side: Literal["out", "in"] | None = None,
    neighbors: int = 16,
    progress: Progress = silent,
) -> np.ndarray: ...


def normals(
    points: Any,
    normals: np.ndarray | Tensor | None = None,
    *,
    viewpoint: np.ndarray | Sequence[float] | None = None,
    up: str | np.ndarray | Sequence[float] | None = None,
    side: Literal["out", "in"] | None = None,
    neighbors: int = 16,
    progress: Progress = silent,
) -> Any:
    """Normals of a cloud: estimated where there are none, with signs that agree.

    Without anything that decides the side, they look outward on closed shapes, and to one side on open ones; given
    ones that agree stay as they are, and of those that contradict each other the axes stay. Those of `upsample` where
    it gets none. They depend neither on the order of the points nor on repeated ones.

    Args:
        points: (n, 3), n >= 16, in any unit and anywhere: an array, a tensor on any device, or a cloud of another
            library as `upsample` takes it.
        normals: (n, 3), of any length; estimated where zero or NaN.
        viewpoint: place of the sensor, (3,), or of the sensor of each point, (n, 3), NaN where it is not known: normals
            look to where they were seen from.
        up: the direction from which all was seen, as from the air: "z", "-z", "x" ..., or three numbers.
        side: "out" or "in", of closed shapes, such as rooms and tunnels; on open ones "in" is the other side.
        neighbors: of the plane fits that begin it, at least 3.
        progress: called as progress(stage, done, total).

    Returns:
        (n, 3) float64, of unit length; NaN for points that are not finite. For a tensor a tensor, float32 where it is;
        for a cloud of another library a copy of it with these normals.

    Raises:
        ValueError: in one line, which argument is wrong and what was expected.

    Example:
        >>> import numpy as np
        >>> import pnu
        >>> sphere = np.random.default_rng(0).normal(size=(500, 3))
        >>> sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        >>> normals = pnu.normals(sphere)
        >>> normals.shape
        (500, 3)
        >>> bool(((normals * sphere).sum(axis=1) > 0.9).all())
        True
    """
    kind = kind_of(points)
    array, given, _ = _taken(points, normals, kind, "points: expected an array (n, 3)", widths=(3,))
    asked = asked_sight(viewpoint, up, side)
    places = {}
    if asked is not None and asked.viewpoint is not None and asked.viewpoint.ndim == 2:
        if asked.viewpoint.shape != array.shape:
            raise ValueError(f"viewpoint: expected (3,) or {array.shape}, found shape {asked.viewpoint.shape}")
        places = {"viewpoint": asked.viewpoint}
    cloud = check_cloud(Cloud(array, given, places), "points", minimum=MINIMUM)
    if asked is not None and places:
        asked = asked._replace(viewpoint=cloud.attributes["viewpoint"])
    if not (isinstance(neighbors, Integral) and 3 <= neighbors <= len(cloud.points)):
        raise ValueError(
            f"neighbors={neighbors}: expected a whole number from 3 to {len(cloud.points)}, the different points"
        )
    settled = settled_normals(
        cloud.points, cloud.normals, asked=asked, neighbors=int(neighbors), refine=learned_normals, progress=progress
    )
    finite = np.isfinite(array).all(1)
    found = np.full(array.shape, np.nan)
    found[finite] = settled.normals[cKDTree(cloud.points).query(array[finite])[1]]  # each point is one of them
    if kind is not None:
        return kind.with_normals(points, found)
    return tensor_like(points, found) if isinstance(points, Tensor) else found


def weights_source(
    model: str | PathLike[str], normals: np.ndarray | None, scanned: bool = False
) -> str | PathLike[str]:
    """What `checkpoint.load` takes, for a cloud with these normals: "surface" means one of three, "newest" a run.

    scanned: it lies as scans do, see `pnu.cleaning.Cleaned`.
    """
    if model == "surface" and normals is None:
        return "surface_scans" if scanned else "surface_estimated"
    return checkpoints.resolve(model)


def _taken(
    points: Any, normals: Any, kind: Kind | None, expected: str, widths: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray | None, dict[str, np.ndarray]]:
    """Points (n, 3), normals and attributes as they are given: as arrays, or as an object of that kind."""
    if kind is not None:
        points, own, attributes = kind.read(points)[:3]
    else:
        own, attributes = None, {}
    array = _array(points, expected)
    if array.ndim != 2 or array.shape[1] not in widths:
        raise ValueError(f"{expected}, found shape {array.shape}")
    if array.shape[1] == 6:
        array, own = array[:, :3], array[:, 3:]
    if own is not None and normals is not None:
        there = "in points (n, 6) already" if kind is None else f"in the {kind.where[1]} already"
        raise ValueError(f"normals: are {there}; give points without, or no normals beside them")
    normals = own if normals is None else normals
    return array, None if normals is None else _array(normals, f"normals: expected an array {array.shape}"), attributes


def _array(values: Any, expected: str) -> np.ndarray:
    """An array or a tensor, wherever it lies and whether or not it has a gradient, as float64."""
    try:
        if isinstance(values, Tensor):
            values = values.detach().cpu().double().resolve_conj().resolve_neg().numpy()
        if np.iscomplexobj(values):
            raise ValueError("complex")
        return np.asarray(values, np.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise ValueError(f"{expected}, found {type(values).__name__}") from None


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, Real) else repr(value)[:40]


def modules_of(model: object) -> list[nn.Module]:
    """All modules of a network; of an upsampler without one, none."""
    return list(model.modules()) if isinstance(model, nn.Module) else []


@contextmanager
def evaluating(model: object) -> Iterator[None]:
    """A network in eval mode, each of its modules in its own mode again in the end."""
    training = [module for module in modules_of(model) if module.training]
    for module in training:
        module.training = False
    try:
        yield
    finally:
        for module in training:
            module.training = True


class LoadedWeights:
    """The network of a run folder, of a file of weights or of shipped ones, read when first needed, and kept.

    Args:
        source: what `upsample` takes as `model`, as text or a path.

    Raises:
        ValueError: "newest", and no run has finished.
    """

    def __init__(self, source: str | PathLike[str]) -> None:
        self.source = checkpoints.resolve(source)
        self.read: dict[str, Any] = {}

    def network(self, normals: np.ndarray | None = None, scanned: bool = False) -> Any:
        """That for a cloud with these normals, see `weights_source`."""
        meant = str(weights_source(self.source, normals, scanned))
        if meant not in self.read:
            self.read[meant] = classical(meant) if meant in CLASSICAL else checkpoints.load(meant)
        return self.read[meant]


def _model(model: Any, normals: np.ndarray | None, scanned: bool) -> tuple[Any, bool]:
    """The network or upsampler that is meant, and whether it is the caller's own."""
    if isinstance(model, str | PathLike):
        model = LoadedWeights(model)
    if isinstance(model, LoadedWeights):
        return model.network(normals, scanned), False
    return model, True


def on_device(model: Any, given: bool, device: str) -> tuple[Any, torch.device]:
    """The network on a device, and which; one that is given and lies elsewhere is copied, not moved."""
    tensors = [tensor for module in modules_of(model) for tensor in (*module.parameters(False), *module.buffers(False))]
    if device != "auto":
        try:
            torch.empty(0, device=device)
        except (RuntimeError, AssertionError):
            raise ValueError(f"device={device}: is not here; expected auto, cpu, or cuda where there is one") from None
        target = torch.device(device)
    elif given:
        target = tensors[0].device if tensors else torch.device("cpu")
    else:
        target = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if all(tensor.device == target for tensor in tensors):
        return model, target
    return (copy.deepcopy(model) if given else model).to(target), target


def _names(target: torch.device, devices: int) -> list[str]:
    """Of as many devices as are asked for, of the kind of the target."""
    if devices == 1 or target.type == "cpu":
        return [str(target)] * devices
    here = torch.cuda.device_count()
    if devices > here:
        raise ValueError(f"devices={devices}: expected at most {here}, as many CUDA devices as are here")
    return [f"cuda:{number}" for number in range(devices)]


def _digest(network: Any, sparse: Tensor, count: int, upsampler: object, *options: object) -> str:
    """Of all that the parts of a computation depend on."""
    digest = hashlib.sha256(sparse.numpy().tobytes())
    for name, value in network.state_dict().items() if modules_of(network) else ():
        digest.update(name.encode() + value.cpu().numpy().tobytes())
    plain = [
        (name, value)
        for module in (upsampler, *modules_of(network))
        for name, value in sorted(vars(module).items())
        if name != "training" and isinstance(value, int | float | str)
    ]
    digest.update(repr((type(network).__name__, count, options, plain, __version__, torch.__version__)).encode())
    return digest.hexdigest()[:16]


def _prepare(cloud: Cloud, progress: Progress, *, refine: bool = False) -> tuple[Tensor, Frame]:
    """The points in a fixed order with normals, (n, 6) float64 in the unit sphere, and the way back.

    refine: normals that are missing are found by the surface model, not left to a network that does so itself.
    """
    order = np.lexsort(cloud.points.T)
    unit, frame = _unit_sphere(cloud.points[order])
    given = None if cloud.normals is None else torch.from_numpy(cloud.normals[order])
    missing = torch.ones(len(order), dtype=torch.bool) if given is None else given.isnan().any(1)
    if missing.any():
        progress("normals", 0, 1)
        directions = complete_normals(unit[0], given)
        if refine:
            directions = torch.where(missing[:, None], learned_normals(unit[0], directions, progress), directions)
        progress("normals", 1, 1)
    else:
        assert given is not None
        directions = given
    return torch.cat([unit[0], directions], 1), frame


def _unit_sphere(points: np.ndarray) -> tuple[Tensor, Frame]:
    """Points (n, 3) as (1, n, 3) in the unit sphere, and the way back."""
    cloud = torch.from_numpy(points)[None]
    frame = unit_sphere_frame(cloud)
    unit = frame.to_unit(cloud)
    extent = torch.linalg.svdvals(unit[0] - unit[0].mean(0))
    if extent[1] < 1e-9 * extent[0]:
        raise ValueError(f"points: all {len(points)} points lie on a line; expected points on a surface")
    return unit, frame
