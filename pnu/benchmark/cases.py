"""What is evaluated: true surfaces, and input clouds drawn from them or read beside them."""

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pnu import reconstruction
from pnu.benchmark.pair_folders import PairFolders, Warn, named_count, pair_files, pair_folders
from pnu.data import scanner
from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.mesh_sampling import face_areas, sample_area, sample_poisson_disk
from pnu.geometry.mesh_topology import open_edges
from pnu.geometry.sampling import nonuniform_points
from pnu.geometry.unit_sphere import Frame
from pnu.io import MESH_SUFFIXES, Mesh, files_of, read_cloud, read_mesh
from pnu.io.cloud import columns_of

KINDS = ("uniform", "random", "nonuniform", "sparse", "noise_0.5", "noise_1", "noise_2")
"""Kinds of input: evenly spread (Poisson-disk), random by area, denser around three places, evenly spread with a
quarter of the points, evenly spread with Gaussian noise of 0.5 %, 1 % and 2 % of the radius in each coordinate.
Evenly spread where the protocol says so: it may have them random, or a subset of the truth's."""

SCANS = tuple(scanner.KINDS)
"""Kinds that a simulated scanner gives (`pnu.data.scanner`), with as many points as it sees, and normals only where it
knows some. They are compared with the part of the true surface that the scan has seen."""

LINE = 0.06  # from scan lines, a tenth of whose points would do, the surface counts as seen that far,
SEEN = 3.0  # and else so many spacings from the points

STRENGTH, CENTERS, CANDIDATES = 2.0, 3, 4  # nonuniform: e^2 times denser, around 3 points, out of 4 times as many
UNIT = 0.01  # how far a unit sphere's radius may be from 1, and its usual centers from the origin
NEARLY = 0.05  # how far the radius about the centroid may be from 1 where no usual center is the origin


class Truth(NamedTuple):
    """A true surface in the frame of the comparison, where its radius is 1."""

    shape: str
    mesh: Mesh | None
    samples: np.ndarray  # (m, 6) evenly spread points with normals, or (m, 3) without
    frame: str  # the frame in words
    unit: float = 1.0  # length of the frame's unit in that of the files


class Case(NamedTuple):
    """An input cloud, and the surface that it was drawn from."""

    kind: str
    points: np.ndarray  # (n, 3)
    normals: np.ndarray | None  # (n, 3)
    truth: Truth


def mesh_cases(
    meshes: Mapping[str, Callable[[], Mesh]],
    kinds: Sequence[str] = KINDS,
    *,
    points: int = 5000,
    truth_points: int = 20000,
    seed: int = 0,
    normals: bool = True,
    warn: Warn = print,
    inputs: str = "poisson",
    noise_limit: float | None = None,
) -> Iterator[Case]:
    """Inputs of all kinds from each mesh, brought to its unit sphere; drawn by (seed, shape, kind) alone.

    normals: with the true normals of the surface (also beside noisy points), or without. inputs, noise_limit: see
    `pnu.benchmark.Protocol`.
    """
    for shape, make in meshes.items():
        truth = truth_of_mesh(shape, make(), truth_points, seed, warn=warn)
        scanned = scanner.Scanner(truth.mesh) if truth.mesh is not None and set(kinds) & set(SCANS) else None
        for kind in kinds:
            if scanned is not None and kind in SCANS:
                scan = scanner.KINDS[kind](scanned, generator(seed, shape, kind))
                seen = truth._replace(samples=seen_samples(truth.samples, scan, kind))
                yield Case(kind, scan.points, scan.normals if normals else None, seen)
                continue
            cloud = draw_input(truth, kind, points, generator(seed, shape, kind), inputs, noise_limit)
            yield Case(kind, cloud[:, :3], cloud[:, 3:] if normals else None, truth)


def seen_samples(samples: np.ndarray, scan: scanner.SimulatedScan, kind: str) -> np.ndarray:
    """Those of the samples (m, 3 or 6) of a true surface that lie where a scan of one of `SCANS` has points."""
    there = scan.clean[np.isfinite(scan.clean[:, 0]), :3]
    tree = kd_tree(there)
    reach = LINE if kind == "lines" else SEEN * float(np.median(tree.query(there, 4)[0][:, 3]))
    found: np.ndarray = samples[tree.query(samples[:, :3])[0] < reach]
    return found


def draw_input(
    truth: Truth, kind: str, n: int, rng: np.random.Generator, inputs: str = "poisson", noise_limit: float | None = None
) -> np.ndarray:
    """An input of one of `KINDS` with the surface's normals, (n, 6); (n // 4, 6) if sparse."""
    assert truth.mesh is not None
    if kind == "random":
        return sample_area(truth.mesh, n, rng)
    if kind == "nonuniform":
        dense = sample_area(truth.mesh, CANDIDATES * n, rng)
        draws = torch.Generator().manual_seed(int(rng.integers(2**62)))
        places = torch.from_numpy(dense[None, :, :3])
        idx = nonuniform_points(places, n, strength=STRENGTH, centers=CENTERS, generator=draws)
        drawn: np.ndarray = dense[idx[0].numpy()]
        return drawn
    cloud = drawn_points(truth, n // 4 if kind == "sparse" else n, inputs, rng)
    if kind.startswith("noise_"):
        noise = rng.normal(scale=float(kind.removeprefix("noise_")) / 100, size=(n, 3))
        cloud[:, :3] += noise if noise_limit is None else noise.clip(-noise_limit, noise_limit)
    return cloud


def drawn_points(truth: Truth, n: int, inputs: str, rng: np.random.Generator) -> np.ndarray:
    """n points of a true surface, (n, 6): evenly spread, random by area, or some of the truth's own samples.

    ValueError for a subset of fewer points than n.
    """
    assert truth.mesh is not None
    if inputs == "poisson":
        return sample_poisson_disk(truth.mesh, n, rng)
    if inputs == "random":
        return sample_area(truth.mesh, n, rng)
    if n > len(truth.samples):
        raise ValueError(f"points={n}: a subset of the truth has at most its {len(truth.samples)} points")
    chosen: np.ndarray = truth.samples[rng.choice(len(truth.samples), n, replace=False)]
    return chosen


def truth_of_mesh(shape: str, mesh: Mesh, count: int, seed: int, *, warn: Warn = print) -> Truth:
    """A mesh as truth, with `count` Poisson-disk samples, in its unit sphere."""
    if holes := open_edges(mesh):
        warn(f"{shape}: is not watertight ({holes} open edges); taken as an open surface")
    samples = sample_poisson_disk(mesh, count, generator(seed, shape, "truth"))
    frame, name = frame_of(samples, mesh)
    return Truth(shape, moved_mesh(mesh, frame), moved(samples, frame), name, frame.scale.item())


def pair_cases(
    root: str | Path,
    shapes: Collection[str] | None = None,
    *,
    truth_points: int = 20000,
    seed: int = 0,
    normals: bool = True,
    columns: str | None = None,
    warn: Warn = print,
) -> Iterator[Case]:
    """Prepared pairs of a folder: clouds/NAME.xyz (or ply ...) and truth/NAME.ply, the true mesh in the same frame.

    Or as the public ones lie: input_2048/NAME.xyz, gt_8192/NAME.xyz, and the meshes, for P2F, in meshes/ or
    original_meshes/ there or beside the folder.

    truth/NAME_<count>.npy, where there is one, holds the evenly spread points of the truth, (count, 3 or 6); without a
    mesh it is the truth. Of several, that of `truth_points` is taken, or the largest. Both are brought to the truth's
    unit sphere if they are not in one.

    columns: of clouds that are text or arrays without names, as `pnu.io.read_cloud` takes them.

    Raises:
        ValueError: cloud, mesh and samples are not in one frame, or two files have the same name.
    """
    folders = pair_folders(root)
    paths = [path for path in pair_files(root) if shapes is None or path.stem in shapes]
    for path, names in zip(paths, columns_of(paths, columns, str(folders.inputs)), strict=True):
        truth, frame = read_truth(folders, path.stem, truth_points, seed, warn)
        points, given, _, notes = read_cloud(path, normals=normals, columns=names)
        for note in notes:
            warn(f"{path}: {note}")
        points = moved(points, frame)
        check_pair(points, truth, path)
        yield Case("given", points, given, truth)


def read_truth(folders: PairFolders, shape: str, count: int, seed: int, warn: Warn) -> tuple[Truth, Frame]:
    """The true surface of a shape in a folder of pairs: its mesh, or samples of it."""
    folder = folders.meshes
    meshes = [path for path in files_of(folder, MESH_SUFFIXES) if path.stem == shape] if folder else []
    samples = folders.sample_file(shape, count, warn)
    if not meshes and samples is None:
        expected = f"{shape}.ply, the true mesh of clouds/{shape}, or {shape}_<count>.npy"
        if folders.public:
            expected = f"{shape}.xyz, the truth of {folders.inputs}/{shape}"
        raise ValueError(f"{folders.samples}: expected {expected}")
    if not meshes and folders.public:
        warn(f"{shape}: has no mesh, so no P2F; expected it in {folders.inputs.parent}/meshes")
    if len(meshes) > 1:
        raise ValueError(f"{meshes[0]} and {meshes[1]}: expected one true mesh of {shape}; remove or rename the other")
    mesh = read_mesh(meshes[0]) if meshes else None
    if mesh is not None and (holes := open_edges(mesh)):
        warn(f"{meshes[0]}: is not watertight ({holes} open edges); taken as an open surface")
    if samples is not None:
        cloud = read_cloud(samples)
        if not folders.public and len(cloud.points) != named_count(samples):
            raise ValueError(f"{samples}: holds {len(cloud.points)} points, its name says another number; rename it")
        if mesh is not None:
            reconstruction.check_frame(cloud.points, mesh, name=str(samples), truth_name=str(meshes[0]))
        even = cloud.points if cloud.normals is None else np.hstack([cloud.points, cloud.normals])
    else:
        assert mesh is not None
        even = sample_poisson_disk(mesh, count, generator(seed, shape, "truth"))
    frame, name = frame_of(even, mesh)
    scaled = mesh and moved_mesh(mesh, frame)
    return Truth(shape, scaled, moved(even, frame), name, frame.scale.item()), frame


def check_pair(points: np.ndarray, truth: Truth, path: Path) -> None:
    """ValueError if the cloud does not lie on the truth: another frame, unit or shape."""
    mesh = truth.mesh
    if mesh is None:  # a triangle at each sample is surface enough for this
        corners = truth.samples[:, None, :3] + 1e-3 * np.eye(3)
        mesh = Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    reconstruction.check_frame(points, mesh, name=str(path), truth_name=f"the truth of {truth.shape}")


def generator(seed: int, shape: str, what: str) -> np.random.Generator:
    """Randomness from the names alone, so that one shape's inputs do not depend on the others."""
    return np.random.default_rng([seed, zlib.crc32(f"{shape}/{what}".encode())])


def frame_of(samples: np.ndarray, mesh: Mesh | None) -> tuple[Frame, str]:
    """The truth's unit sphere: centroid and greatest distance, of the mesh if there is one, else of the samples.

    A truth that is in a unit sphere already stays as it is: its radius about the origin is 1, and the origin is its
    center, be it the centroid, the mean of the vertices or the middle of the box. Where it is neither, the radius about
    the centroid has to be nearly 1 too, since a small shape beside the origin may reach just as far from it.
    """
    points = samples[:, :3] if mesh is None else mesh.vertices[np.unique(mesh.faces)]
    center = points.mean(0) if mesh is None else centroid(mesh)
    scale = radius(points - center)
    centers = np.stack([center, points.mean(0), (points.min(0) + points.max(0)) / 2])
    centered = np.linalg.norm(centers, axis=1).min() < UNIT or abs(scale - 1) < NEARLY
    if centered and abs(radius(points) - 1) < UNIT:
        center, scale, name = np.zeros(3), 1.0, "as given, a unit sphere"
    else:
        name = "unit sphere of the truth"
    return Frame(torch.from_numpy(center)[None, None], torch.full((1, 1, 1), scale, dtype=torch.float64)), name


def radius(points: np.ndarray) -> float:
    """Largest distance from the origin."""
    return float(np.linalg.norm(points, axis=1).max())


def centroid(mesh: Mesh) -> np.ndarray:
    """Of the surface: middles of the faces weighted by area."""
    return np.average(mesh.vertices[mesh.faces].mean(1), axis=0, weights=face_areas(mesh))


def moved(cloud: np.ndarray, frame: Frame) -> np.ndarray:
    """A cloud (n, 6) brought into a frame; normals stay."""
    return frame.to_unit(torch.from_numpy(cloud[None].astype(np.float64)))[0].numpy()


def moved_mesh(mesh: Mesh, frame: Frame) -> Mesh:
    """A mesh brought into a frame."""
    return Mesh(moved(mesh.vertices, frame), mesh.faces)
