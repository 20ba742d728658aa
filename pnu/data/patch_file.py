"""Patch files: HDF5 with dense patches of meshes. Schema in data/README.md; PU-Net's own file has the same one."""

import functools
import json
import multiprocessing
import multiprocessing.connection
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pnu.data.shapes import unit_mesh
from pnu.extras import needed
from pnu.geometry.farthest_sampling import farthest_points_large
from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.mesh_sampling import sample_area
from pnu.geometry.mesh_topology import open_edges
from pnu.geometry.sharp_edges import sharp_edge_points
from pnu.io import Mesh, atomic_path

with needed("files of patches"):
    import h5py

PATCH_POINTS = 4096
EDGE_POINTS = 256
SHARES = (0.3, 0.1)  # of its shape that a patch covers
OVERSAMPLING = 5  # random points from which each of the evenly spread ones is chosen
LEAST = 64  # different points of a patch
CHECKED = 2**18  # points that are checked at once
DENSEST = 100  # bytes that a byte of the file may stand for; compressed coordinates stay far below, forged headers not


class ShapePatches(NamedTuple):
    """Patches of one shape."""

    clouds: np.ndarray  # (p, 4096, 6) float32, points in the frame of the shape and unit normals
    edges: np.ndarray  # (p, 256, 3) float32, points on the sharp edges near the patch, NaN where there are fewer
    open_edges: int  # of the mesh, see `pnu.geometry.mesh_topology.open_edges`


def cut_patches(mesh: Mesh, count: int, rng: np.random.Generator) -> ShapePatches:
    """Patches of 4096 evenly spread points: centers by farthest points, the nearest points of each by distance, as at
    inference. Half of them are cut from a dense sampling and cover a small share of the shape, half from a sparse one.
    """
    sharp = sharp_edge_points(mesh, spacing=0.01)
    most = round(PATCH_POINTS / min(SHARES))
    area = sample_area(mesh, OVERSAMPLING * most, rng).astype(np.float32)
    even = area[farthest_points_large(area[:, :3], most)]  # so is each front part of it
    clouds = []
    for share, part in zip(SHARES, (count - count // 2, count // 2), strict=True):
        dense = even[: round(PATCH_POINTS / share)]
        centers = dense[farthest_points_large(dense[:, :3], part), :3] if part else dense[:0, :3]
        clouds.append(dense[kd_tree(dense[:, :3]).query(centers, PATCH_POINTS)[1]])
    patches = np.concatenate(clouds)
    edges = np.stack([edges_of(patch, sharp, rng) for patch in patches])
    return ShapePatches(patches, edges, open_edges(mesh))


def edges_of(patch: np.ndarray, sharp: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(256, 3): those of the points on sharp edges that a patch reaches, rows of NaN where there are fewer."""
    chosen = np.full((EDGE_POINTS, 3), np.nan, np.float32)
    if len(sharp):
        tree = kd_tree(patch[:, :3])
        spacing = np.median(tree.query(patch[::16, :3], 2)[0][:, 1])
        near = sharp[tree.query(sharp, distance_upper_bound=2 * spacing)[0] < np.inf]
        kept = near if len(near) <= EDGE_POINTS else near[rng.permutation(len(near))[:EDGE_POINTS]]
        chosen[: len(kept)] = kept
    return chosen


def cut_patch_file(
    path: str | Path,
    shapes: Mapping[str, Callable[[], Mesh]],
    patches: int,
    *,
    seed: int = 0,
    parameters: Mapping[str, Any] | None = None,
    processes: int = 1,
    progress: Callable[[Iterable[Any], int], Iterable[Any]] | None = None,
) -> None:
    """Write a patch file, whole or not at all; the same arguments give the same patches with any number of processes.

    Args:
        shapes: functions that make the meshes, by name.
        patches: of all shapes together, at least one each.
        parameters: kept in the file, so that it can be told from one made otherwise.
        progress: wraps the iterable over shapes, whose length it gets too.
    """
    if not shapes:
        raise ValueError("shapes: expected at least one, found none")
    if patches < len(shapes):
        raise ValueError(f"data.patches: expected at least one for each of the {len(shapes)} shapes, found {patches}")
    names = sorted(shapes)
    counts = [patches // len(names) + (i < patches % len(names)) for i in range(len(names))]
    jobs = [(name, shapes[name], count, seed) for name, count in zip(names, counts, strict=True)]
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        lay_out(temporary, [job[0] for job, count in zip(jobs, counts, strict=True) for _ in range(count)], parameters)
        with h5py.File(temporary, "r+") as file:
            row = 0
            results: Iterable[Any] = results_of(jobs, processes)
            for _, made in progress(results, len(jobs)) if progress else results:
                rows = slice(row, row + len(made.clouds))
                file["poisson_4096"][rows], file["edges"][rows] = made.clouds, made.edges
                file["open_edges"][rows] = made.open_edges
                row = rows.stop


def lay_out(path: Path, names: Sequence[str], parameters: Mapping[str, Any] | None) -> None:
    """A patch file that lacks only the numbers. Their space is taken first: on a full disk HDF5 crashes."""
    reserve(path, len(names) * 4 * (6 * PATCH_POINTS + 3 * EDGE_POINTS + 1) + 2**20)
    whole = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    whole.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    whole.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    with h5py.File(path, "w") as file:
        file.attrs["parameters"] = json.dumps(dict(parameters or {}), sort_keys=True)
        file["name"] = np.array(names, h5py.string_dtype())
        for name, kind, shape in (
            ("poisson_4096", h5py.h5t.IEEE_F32LE, (PATCH_POINTS, 6)),
            ("edges", h5py.h5t.IEEE_F32LE, (EDGE_POINTS, 3)),
            ("open_edges", h5py.h5t.STD_I32LE, ()),
        ):
            h5py.h5d.create(file.id, name.encode(), kind, h5py.h5s.create_simple((len(names), *shape)), whole)
    reserve(path, path.stat().st_size)


def reserve(path: Path, size: int) -> None:
    """Take space on the disk for a file; `OSError` where there is none."""
    with path.open("ab") as handle:
        if hasattr(os, "posix_fallocate"):  # not on macOS
            os.posix_fallocate(handle.fileno(), 0, size)


def results_of(
    jobs: list[tuple[str, Callable[[], Mesh], int, int]], processes: int
) -> Iterable[tuple[str, ShapePatches]]:
    """The patches of each job, as its process ends, in order."""
    if processes <= 1:
        yield from map(job, jobs)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), initializer=end_with_parent) as pool:
        yield from pool.map(job, jobs)


def end_with_parent() -> None:
    """Let this process end when the one that started it is gone: it would wait for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def job(arguments: tuple[str, Callable[[], Mesh], int, int]) -> tuple[str, ShapePatches]:
    """The patches of one shape, whose randomness comes from the seed and its name alone."""
    name, make, count, seed = arguments
    rng = np.random.default_rng([seed, *name.encode()])
    try:
        return name, cut_patches(unit_mesh(make()), count, rng)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


class Contents(NamedTuple):
    """What a patch file holds."""

    patches: int
    points: int
    names: list[str] | None  # shape of each patch
    has_edges: bool
    has_input: bool  # montecarlo_1024
    parameters: dict[str, Any]
    open_edges: dict[str, int] | None  # of the mesh of each shape; None where the file does not tell


def check_patch_file(path: str | Path) -> Contents:
    """What a patch file holds; every patch of it is looked at, once in a process while the file stays as it is.

    Raises:
        ValueError: no such file, no HDF5, or it lacks what training needs; the message says what, and in which patch.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file; expected an HDF5 file of patches as data/README.md describes")
    found = path.stat()
    return checked_contents(path, found.st_ino, found.st_size, found.st_mtime_ns)


@functools.lru_cache(maxsize=16)
def checked_contents(path: Path, *_: int) -> Contents:
    """`check` of a file that has not changed since: its number, size and time are arguments too."""
    with opened(path) as file:
        return contents_of(path, file)


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """A patch file, to read; `ValueError` where its bytes are no HDF5."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError):  # what h5py raises where bytes are missing or wrong
        raise ValueError(f"{path}: expected an HDF5 file of patches, found something else or a damaged file") from None


def contents_of(path: Path, file: h5py.File) -> Contents:
    """What an open file holds, checked."""
    clouds = dataset(path, file, "poisson_4096")
    if clouds is None:
        raise ValueError(f"{path}: lacks the dataset poisson_4096 (patches, points, 6); it has {listing(file)}")
    if clouds.ndim != 3 or clouds.shape[2] != 6 or clouds.shape[0] < 1 or clouds.shape[1] < 64:
        raise ValueError(f"{path}: poisson_4096 must have shape (patches, 64 or more points, 6), found {clouds.shape}")
    names = names_of(path, file, len(clouds))
    given = dataset(path, file, "montecarlo_1024")
    if given is not None and (
        given.ndim != 3 or given.shape[0] != len(clouds) or given.shape[1] < LEAST or given.shape[2] != 6
    ):
        expected = f"({len(clouds)}, {LEAST} or more points, 6)"
        raise ValueError(f"{path}: montecarlo_1024 must have shape {expected}, found {given.shape}")
    edges = dataset(path, file, "edges")
    if edges is not None and (edges.ndim != 3 or edges.shape[0] != len(clouds) or edges.shape[2] != 3):
        raise ValueError(f"{path}: edges must have shape ({len(clouds)}, points, 3), found {edges.shape}")
    for name, values in (("poisson_4096", clouds), ("montecarlo_1024", given), ("edges", edges)):
        if values is not None and values.dtype.kind != "f":
            raise ValueError(f"{path}: {name} must hold floating-point numbers, found {values.dtype}")
    check_clouds(path, "poisson_4096", clouds)
    if given is not None:
        check_clouds(path, "montecarlo_1024", given)
    if edges is not None:
        check_edges(path, edges)
    return Contents(
        clouds.shape[0], clouds.shape[1], names, edges is not None, given is not None, parameters_of(file),
        open_edges_of(path, file, names),
    )  # fmt: skip


def check_clouds(path: Path, name: str, clouds: h5py.Dataset) -> None:
    """ValueError with the first patch that cannot be trained on, of clouds (N, n, 6): NaN or infinity, fewer than 64
    different points, or less than 99 % of unit normals."""
    faults: dict[str, list[int]] = {"values": [], "points": [], "normals": []}
    told: dict[str, str] = {}
    step = max(1, CHECKED // clouds.shape[1])
    for start in range(0, len(clouds), step):
        with np.errstate(over="ignore", invalid="ignore"):
            part = np.asarray(clouds[start : start + step], np.float32)  # as training reads them
            length = np.sqrt(np.einsum("pnc,pnc->pn", part[..., 3:], part[..., 3:]))
            number = different(part[..., :3])
        good = {
            "values": np.isfinite(part).all((1, 2)),
            "points": number >= min(LEAST, clouds.shape[1]),
            "normals": (np.abs(length - 1) < 0.01).mean(1) > 0.99,
        }
        for fault, kept in good.items():
            bad = np.flatnonzero(~kept)
            faults[fault] += (bad + start).tolist()
            if len(bad) and fault not in told:
                row = bad[0]
                told[fault] = {
                    "values": "holds NaN or infinity",
                    "points": f"has {number[row]} different points, {LEAST} or more are needed",
                    "normals": f"has no unit normals in columns 4 to 6, found lengths {length[row].min():.3g} to"
                    f" {length[row].max():.3g}",
                }[fault]
    for fault, rows in faults.items():
        if rows:
            more = f" (and {len(rows) - 1} more patches)" if len(rows) > 1 else ""
            raise ValueError(f"{path}: patch {rows[0]} of {name} {told[fault]}{more}; mend or remove it")


def different(points: np.ndarray) -> np.ndarray:
    """How many different points each cloud of (p, n, 3) float32 has, (p,)."""
    bits = (points + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    keys = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    count: np.ndarray = 1 + (np.diff(np.sort(keys, axis=1), axis=1) != 0).sum(1)
    return count


def check_edges(path: Path, edges: h5py.Dataset) -> None:
    """ValueError with the first patch whose rows of edges are neither points nor empty."""
    step = max(1, CHECKED // max(1, edges.shape[1]))
    for start in range(0, len(edges), step):
        part = np.asarray(edges[start : start + step], float)
        bad = ~(np.isfinite(part).all(2) | np.isnan(part).all(2)).all(1)
        if bad.any():
            raise ValueError(
                f"{path}: patch {start + int(bad.argmax())} of edges holds infinity, or NaN in a part of a row; a row"
                " is a point, or NaN in all three columns"
            )


def open_edges_of(path: Path, file: h5py.File, names: list[str] | None) -> dict[str, int] | None:
    """Open edges of the mesh of each shape, where the file tells them."""
    counts = dataset(path, file, "open_edges")
    if counts is None or names is None or counts.shape != (len(names),) or counts.dtype.kind not in "iu":
        return None
    return dict(zip(names, counts[()].tolist(), strict=True))


def told_open(open_edges: Mapping[str, int]) -> str:
    """How many meshes have open edges, and which, from the numbers of their edges by name."""
    found = {name: number for name, number in open_edges.items() if number}
    if not found:
        return f"0 of {len(open_edges)}"
    listed = ", ".join(f"{name} ({number})" for name, number in list(found.items())[:5])
    return f"{len(found)} of {len(open_edges)}: {listed}" + (", ..." if len(found) > 5 else "")


def dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset | None:
    """A dataset of the file itself; ValueError where the file is far too small for the size that it claims."""
    if not file.id.links.exists(name.encode()):
        return None
    # a file from elsewhere reads no other one here; what a link leads to is not even opened
    found = file.get(name) if is_own(file, name) else None
    if found is None or (isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)):
        raise ValueError(f"{path}: {name} is a link or lies in another file; copy its numbers into this one")
    if not isinstance(found, h5py.Dataset):
        return None
    if found.shape is None or found.size * found.dtype.itemsize > DENSEST * path.stat().st_size:
        raise ValueError(f"{path}: {name} claims the shape {found.shape}, more than the file can hold; it is damaged")
    return found


def is_own(file: h5py.File, name: str) -> bool:
    """Whether an entry of a file is its own, and no link that may lead to another file."""
    hard: bool = file.id.links.get_info(name.encode()).type == h5py.h5l.TYPE_HARD
    return hard


def parameters_of(file: h5py.File) -> dict[str, Any]:
    """What the file was made from; nothing in a foreign file."""
    try:
        parameters = json.loads(file.attrs.get("parameters", "{}"))
    except (TypeError, ValueError):
        return {}
    return parameters if isinstance(parameters, dict) else {}


def listing(file: h5py.File) -> str:
    """The datasets of a file as one line."""

    def told(name: str) -> str:
        item = file[name] if is_own(file, name) else "a link"
        if isinstance(item, h5py.Dataset):
            return f"{name} {item.shape} {'text' if item.dtype.kind in 'OS' else item.dtype}"
        return f"{name} ({'a group' if isinstance(item, h5py.Group) else item})"

    return ", ".join(map(told, file)) or "nothing"


def names_of(path: Path, file: h5py.File, patches: int) -> list[str] | None:
    """The name of each patch's shape, or None where the file has none."""
    names = dataset(path, file, "name")
    if names is None:
        return None
    if names.shape not in ((patches,), (patches, 1)):
        raise ValueError(f"{path}: name must have one entry for each of the {patches} patches, found {names.shape}")
    values = names[()].reshape(-1)
    return [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]


def describe(path: str | Path) -> dict[str, Any]:
    """Figures of a patch file: its datasets, shapes, spacing and extent of patches, range of coordinates, normals."""
    contents = check_patch_file(path)
    with opened(Path(path)) as file:
        clouds = file["poisson_4096"]
        sample = clouds[:: -(-len(clouds) // 32)].astype(float)
        points, normals = sample[..., :3], sample[..., 3:]
        spacing = [np.median(kd_tree(cloud).query(cloud, 2)[0][:, 1]) for cloud in points]
        radius = np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).max(1)
        sharp = float(np.isfinite(file["edges"][:, 0, 0]).mean()) if contents.has_edges else None
        datasets = listing(file)
    return {
        "file": str(path),
        "size_MB": round(Path(path).stat().st_size / 1e6, 1),
        "datasets": datasets,
        "patches": contents.patches,
        "points": contents.points,
        "shapes": len(set(contents.names)) if contents.names else None,
        "spacing_over_radius": float(np.median(np.array(spacing) / radius)),
        "radius_median": float(np.median(radius)),
        "coordinates_from": float(points.min()),
        "coordinates_to": float(points.max()),
        "normals_of_length_1": float((np.abs(np.linalg.norm(normals, axis=-1) - 1) < 1e-3).mean()),
        "share_with_sharp_edges": sharp,
        "meshes_with_open_edges": None if contents.open_edges is None else told_open(contents.open_edges),
        "parameters": contents.parameters,
    }
