"""Densify whole clouds with a trained network: no Hydra, no Lightning, usable from a notebook."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, get_args, overload

import numpy as np

from pnu import __version__
from pnu.cleaning import Character, Cleaned, Treatment, clean_cloud
from pnu.geometry.attributes import carry
from pnu.geometry.cloud_normals import check_not_a_line, settled_normals, settled_through_noise
from pnu.geometry.cloud_statistics import FAINT
from pnu.geometry.normal_estimation import complete_normals
from pnu.geometry.point_tree import PointTree
from pnu.geometry.unit_sphere import Frame, unit_sphere_frame
from pnu.io import Cloud, check_cloud
from pnu.io.library_clouds import Kind, LibraryCloud, kind_of, tensor_like
from pnu.io.scan_columns import tells_apart
from pnu.io.sensor import asked_sight
from pnu.networks.compiled_surface import CompiledSurface
from pnu.runtime.parts import Parts
from pnu.runtime.progress import Progress, silent
from pnu.runtime.threads import thread_count, torch_if_loaded
from pnu.runtime.workers import Processes
from pnu.upsamplers.context import Context, Merge, Upsampler
from pnu.upsamplers.density import DENSITIES, Density, count_of_spacing
from pnu.upsamplers.inference import LoadedWeights, inferring, modules_of, on_device
from pnu.upsamplers.learned_normals import learned_normals
from pnu.upsamplers.poor_axes import poor_axes
from pnu.upsamplers.selection import upsampler_of
from pnu.upsamplers.surface_projection import SurfaceProjection, is_even, noise_in_spacings
from pnu.upsamplers.unit_normals import with_unit_normals

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

Model: TypeAlias = "nn.Module | CompiledSurface | Upsampler | LoadedWeights | str | PathLike[str]"

MINIMUM = 16  # points of a cloud
LARGEST = 10**9  # points of an output

# what comes back as the kind that was given, for type checkers and editors; arrays and lists come back as arrays
CloudT = TypeVar("CloudT", bound="Tensor | LibraryCloud")


@overload
def upsample(
    points: CloudT,
    normals: np.ndarray | Tensor | None = None,
    *,
    ratio: float = 4,
    spacing: float | None = None,
    model: Model = "surface",
    patch_size: int | None = None,
    merge: Merge = "farthest",
    density: Density = "auto",
    keep: bool | Literal["auto"] = "auto",
    outliers: Treatment = "auto",
    lines: Treatment = "auto",
    noise: Treatment = "auto",
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
    merge: Merge = "farthest",
    density: Density = "auto",
    keep: bool | Literal["auto"] = "auto",
    outliers: Treatment = "auto",
    lines: Treatment = "auto",
    noise: Treatment = "auto",
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
    merge: Merge = "farthest",
    density: Density = "auto",
    keep: bool | Literal["auto"] = "auto",
    outliers: Treatment = "auto",
    lines: Treatment = "auto",
    noise: Treatment = "auto",
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
        merge: of networks of patches. "farthest": the farthest points of all predictions, as in the paper; "agreed":
            points lie on the spheres that the predictions around them fit, in half as much time again.
        density: of the points of "surface". "even" over the surface; "follow": each point becomes `ratio`; "auto": even
            where no place loses points by it, elsewhere those that it has.
        keep: of "surface" and networks of patches. True: the points given are among those that come out, first and
            unmoved, and new ones fill between; False: all are new; "auto": "surface" keeps them where they are evenly
            spread and show no noise.
        outliers: "auto": stray points are taken out first, and not counted less for it: n stays; "keep": none is.
        lines: "auto": scan lines, dense along and sparse across, are thinned out first; "keep": they stay.
        noise: "auto": where points lie in a layer thicker than their spacing, means take their place, and where depths
            come in wider steps than that, points move within half a step; "keep": they stay, and are only smoothed.
        signs: "auto": where given normals contradict each other, their axes are kept and their sides chosen anew; where
            they are poor, as planes fitted to neighbors are, their sides are kept and their axes found anew; "keep":
            they are taken as they are.
        holes: radius, in the unit of the points, up to which holes are filled, by points beyond round(ratio n) that
            continue the surface smoothly (`pnu.reconstruction.fill_holes`); None: none is.
        device: "auto" (where the given network is; else CUDA where there is one), "cpu", "cuda", "cuda:1" ...
        devices: CUDA devices, or processes on the CPU, that share the work of the network; the result is the same for
            any number. More than one needs `if __name__ == "__main__":` in a script.
        batch_size: patches at once on a GPU, by default 64; on the CPU each thread takes as many as have 1024 points.
            Of "surface": points at once, by default 65536 on a GPU and 512 a thread on the CPU.
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
    options = Densification(patch_size, merge, density, keep, holes, devices, batch_size, seed)
    if keep is True:
        lines = noise = "keep"
    cleaned = clean_cloud(given, outliers=outliers, lines=lines, noise=noise, signs=signs, doubts=poor_axes)
    found = densified(cleaned, count, options, model=model, device=device, progress=progress, parts=parts)
    given = cleaned.cloud
    if kind is not None:
        return kind.dense(points, Cloud(found[:, :3], found[:, 3:], attributes(found, given)))
    return tensor_like(points, found) if is_tensor(points) else found


@dataclass(frozen=True)
class Densification:
    """Arguments of `upsample` by these names; `ValueError` where one cannot be."""

    patch_size: int | None = None
    merge: Merge = "farthest"
    density: Density = "auto"
    keep: bool | Literal["auto"] = "auto"
    holes: float | None = None
    devices: int = 1
    batch_size: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("patch_size", MINIMUM), ("batch_size", 1), ("devices", 1), ("seed", 0)):
            value: Any = getattr(self, name)
            if value is not None and (not isinstance(value, Integral) or int(value) < least):
                raise ValueError(f"{name}={value}: expected a whole number >= {least}")
        if self.holes is not None and not (isinstance(self.holes, Real) and 0 < self.holes < float("inf")):
            raise ValueError(f"holes={_short(self.holes)}: expected a radius above 0 in the unit of the points")
        if self.density not in DENSITIES:
            raise ValueError(f"density={self.density}: expected {', '.join(DENSITIES)}")
        if self.merge not in get_args(Merge):
            raise ValueError(f"merge={self.merge}: expected {' or '.join(get_args(Merge))}")
        if self.keep not in (True, False, "auto"):
            raise ValueError(f"keep={self.keep}: expected true, false or auto")


def densified(
    cleaned: Cleaned,
    count: int,
    options: Densification,
    *,
    model: Model = "surface",
    device: str = "auto",
    progress: Progress = silent,
    parts: str | PathLike[str] | None = None,
) -> np.ndarray:
    """So many points, and those that fill holes, with unit normals, of a cloud that is clean: (count + filled, 6).

    Where the cloud has no normals, `cleaned.estimated` begins with the sides that they say. All else as in `upsample`.
    """
    merge, density, keep, devices = options.merge, options.density, options.keep, options.devices
    network, target = on_device(*_model(model, cleaned.cloud.normals, cleaned.character, device), device)
    upsampler = upsampler_of(network, options.patch_size)
    if devices > 1 and not getattr(upsampler, "parallel", False):
        raise ValueError(f"devices={devices}: {type(network).__name__} works in one process; leave devices=1")
    if merge == "agreed" and not getattr(upsampler, "merges", False):
        raise ValueError(f"merge=agreed: {type(network).__name__} has no patches that overlap; leave it out")
    names = _names(target, devices)
    sparse, frame = _prepare(cleaned, progress, refine=not getattr(network, "passes", 0))
    follows, can_keep = (getattr(upsampler, name, False) for name in ("follows", "keeps"))
    if (density == "follow" and not follows) or (keep is True and not can_keep):
        asked = "density=follow" if density == "follow" and not follows else "keep=true"
        raise ValueError(
            f"{asked}: {type(network).__name__} spreads new points evenly; take model surface (run=surface)"
        )
    even = follows and keep == "auto" and is_even(sparse)
    clean = even and noise_in_spacings(sparse) < FAINT
    keeps = clean if keep == "auto" else keep
    digest = _digest(network, sparse, count, upsampler, density, keeps, even, merge)
    finished = Parts() if parts is None else Parts(Path(parts) / digest)
    context = Context(
        target, options.batch_size, int(options.seed), progress, finished,
        density=density, keep=keeps, smooth=even and not clean, merge=merge,
    )  # fmt: skip
    with inferring(network), ExitStack() as stack:
        if devices > 1:
            theirs = copy.deepcopy(network).cpu() if modules_of(network) else network
            context = replace(context, workers=stack.enter_context(Processes(theirs, names)))
        dense = with_unit_normals(_upsampled(upsampler, sparse, count, context), sparse)
    found = frame.from_unit(dense)
    if keeps:
        found = _measured_first(found, dense, sparse, cleaned.cloud)
    if options.holes is not None:
        from pnu.reconstruction.hole_filling import fill_holes

        progress("holes", 0, 1)
        found = np.vstack([found, fill_holes(found, options.holes)])
        progress("holes", 1, 1)
    return found


def _upsampled(upsampler: Upsampler, sparse: np.ndarray, count: int, context: Context) -> np.ndarray:
    """What an upsampler makes of a cloud (n, 6): (count, 3 or 6) float64."""
    if isinstance(upsampler, SurfaceProjection):
        return upsampler.upsample_cloud(sparse, count, context)
    import torch

    raw = upsampler.upsample_cloud(torch.from_numpy(sparse).to(context.device), count, context)
    return raw.cpu().double().numpy()


def _measured_first(found: np.ndarray, unit: np.ndarray, sparse: np.ndarray, given: Cloud) -> np.ndarray:
    """The points found (m, 6), those first that were given: in their order, not moved by a bit, with their normals.

    In the unit sphere they are `unit` (m, 6), and those given `sparse` (n, 6), sorted.
    """
    rows = np.empty(len(sparse), np.int64)
    near = PointTree(unit[:, :3]).nearest(sparse[:, :3], 1, threads=thread_count())[1]
    rows[np.lexsort(given.points.T)] = near[:, 0]
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
    normals = complete_normals(cloud.points, cloud.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    sparse = np.hstack([cloud.points, normals / np.maximum(length, 1e-300)])
    return {name: carry(dense, sparse, values, kinds=tells_apart(name)) for name, values in cloud.attributes.items()}


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
    viewpoint: np.ndarray | Sequence[float] | str | None = None,
    up: str | np.ndarray | Sequence[float] | None = None,
    side: Literal["out", "in"] | None = None,
    scans: np.ndarray | Sequence[int] | None = None,
    neighbors: int = 16,
    progress: Progress = silent,
) -> CloudT: ...


@overload
def normals(
    points: np.ndarray | Sequence[Sequence[float]],
    normals: np.ndarray | Tensor | None = None,
    *,
    viewpoint: np.ndarray | Sequence[float] | str | None = None,
    up: str | np.ndarray | Sequence[float] | None = None,
    side: Literal["out", "in"] | None = None,
    scans: np.ndarray | Sequence[int] | None = None,
    neighbors: int = 16,
    progress: Progress = silent,
) -> np.ndarray: ...


def normals(
    points: Any,
    normals: np.ndarray | Tensor | None = None,
    *,
    viewpoint: np.ndarray | Sequence[float] | str | None = None,
    up: str | np.ndarray | Sequence[float] | None = None,
    side: Literal["out", "in"] | None = None,
    scans: np.ndarray | Sequence[int] | None = None,
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
        viewpoint: place of the sensor, (3,), or of the sensor of each point, (n, 3), NaN where it is not known, or
            a file of its places, of which some saw each point: normals look to where they were seen from.
        up: the direction from which all was seen, as from the air: "z", "-z", "x" ..., or three numbers.
        side: "out" or "in", of closed shapes, such as rooms and tunnels; on open ones "in" is the other side.
        scans: (n,) numbers, which scan each point is of: the scanner of each is looked for by itself.
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
    if scans is not None:
        if np.shape(scans) != array.shape[:1]:
            raise ValueError(f"scans: expected a number for each of {len(array)} points, found shape {np.shape(scans)}")
        places["scans"] = np.asarray(scans)
    cloud = check_cloud(Cloud(array, given, places), "points", minimum=MINIMUM)
    if asked is not None and "viewpoint" in places:
        asked = asked._replace(viewpoint=cloud.attributes["viewpoint"])
    if not (isinstance(neighbors, Integral) and 3 <= neighbors <= len(cloud.points)):
        raise ValueError(
            f"neighbors={neighbors}: expected a whole number from 3 to {len(cloud.points)}, the different points"
        )
    settled = settled_through_noise(
        cloud.points,
        cloud.normals,
        asked=asked,
        scans=cloud.attributes.get("scans"),
        neighbors=int(neighbors),
        refine=learned_normals,
        progress=progress,
    )
    finite = np.isfinite(array).all(1)
    found = np.full(array.shape, np.nan)
    same = PointTree(cloud.points).nearest(array[finite], 1)[1][:, 0]  # each point is one of them
    found[finite] = settled.normals[same]
    if kind is not None:
        return kind.with_normals(points, found)
    return tensor_like(points, found) if is_tensor(points) else found


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
        if is_tensor(values):
            values = values.detach().cpu().double().resolve_conj().resolve_neg().numpy()
        if np.iscomplexobj(values):
            raise ValueError("complex")
        return np.asarray(values, np.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise ValueError(f"{expected}, found {type(values).__name__}") from None


def is_tensor(values: object) -> bool:
    """Whether values are a tensor of torch."""
    torch = torch_if_loaded()
    return torch is not None and isinstance(values, torch.Tensor)


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, Real) else repr(value)[:40]


def _model(model: Any, normals: np.ndarray | None, character: Character, device: str) -> tuple[Any, bool]:
    """The network or upsampler that is meant, and whether it is the caller's own."""
    if isinstance(model, str | PathLike):
        model = LoadedWeights(model)
    if isinstance(model, LoadedWeights):
        return model.network(normals, character, device), False
    return model, True


def _names(target: torch.device | str, devices: int) -> list[str]:
    """Of as many devices as are asked for, of the kind of the target."""
    if devices == 1 or str(target).startswith("cpu"):
        return [str(target)] * devices
    import torch

    here = torch.cuda.device_count()
    if devices > here:
        raise ValueError(f"devices={devices}: expected at most {here}, as many CUDA devices as are here")
    return [f"cuda:{number}" for number in range(devices)]


def _digest(network: Any, sparse: np.ndarray, count: int, upsampler: object, *options: object) -> str:
    """Of all that the parts of a computation depend on."""
    digest = hashlib.sha256(sparse.tobytes())
    for name, value in network.state_dict().items() if hasattr(network, "state_dict") else ():
        digest.update(name.encode() + (value.cpu().numpy() if is_tensor(value) else value).tobytes())
    torch = torch_if_loaded() if modules_of(network) else None
    plain = [
        (name, value)
        for module in (upsampler, *(modules_of(network) or [network]))
        for name, value in sorted(vars(module).items())
        if name != "training" and isinstance(value, int | float | str)
    ]
    versions = __version__, torch and torch.__version__
    digest.update(repr((type(network).__name__, count, options, plain, versions)).encode())
    return digest.hexdigest()[:16]


def _prepare(cleaned: Cleaned, progress: Progress, *, refine: bool = False) -> tuple[np.ndarray, Frame]:
    """The points in a fixed order with normals, (n, 6) float64 in the unit sphere, and the way back.

    refine: normals that are missing are found by the surface model, not left to a network that does so itself.
    """
    cloud = cleaned.cloud
    order = np.lexsort(cloud.points.T)
    unit, frame = _unit_sphere(cloud.points[order])
    given = None if cloud.normals is None else cloud.normals[order]
    missing = np.ones(len(order), bool) if given is None else np.isnan(given).any(1)
    if missing.any():
        progress("normals", 0, 1)
        if given is None:
            estimated = cleaned.estimated or settled_normals(cloud.points, None, found=cleaned.sight)
            directions = estimated.normals[order]
        else:
            directions = complete_normals(unit, given)
        if refine:
            directions = np.where(missing[:, None], learned_normals(unit, directions, progress), directions)
        progress("normals", 1, 1)
    else:
        assert given is not None
        directions = given
    return np.hstack([unit, directions]), frame


def _unit_sphere(points: np.ndarray) -> tuple[np.ndarray, Frame]:
    """Points (n, 3) in the unit sphere, and the way back."""
    frame = unit_sphere_frame(points)
    unit = frame.to_unit(points)
    check_not_a_line(unit)
    return unit, frame
