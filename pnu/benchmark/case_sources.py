"""From the config group `data` of training to the cases of an evaluation."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pnu.benchmark.cases import KINDS, SCANS, Case, mesh_cases, pair_cases
from pnu.benchmark.pair_folders import Warn, is_pairs_folder, pair_files, pair_folders
from pnu.data import shapes
from pnu.data.patch_dataset import split_shapes
from pnu.io import Mesh, meshes_of, read_mesh
from pnu.io.cloud import columns_of

PARTS = ("train", "val", "test", "all")


class CaseSource(NamedTuple):
    """Where cases come from."""

    name: str
    shapes: list[str]
    kinds: list[str]
    cases: Iterator[Case]


def case_source(
    data: Mapping[str, Any],
    kinds: Sequence[str] = KINDS,
    *,
    part: str | None = None,
    only: Sequence[str] | None = None,
    points: int = 5000,
    truth_points: int = 20000,
    seed: int = 0,
    normals: bool = True,
    columns: str | None = None,
    warn: Warn = print,
    inputs: str = "poisson",
    noise_limit: float | None = None,
) -> CaseSource:
    """Cases of `data`, drawn as they are asked for; what is wrong with the arguments is said at once.

    Args:
        data: a choice of conf/data: with `root` a folder of meshes, or of prepared pairs in clouds/ and truth/ (whose
            clouds are the inputs, whatever `kinds`); with `kinds` the procedural shapes.
        kinds: of input, some of `KINDS` and `SCANS`.
        part: of the shapes, split as training splits them: train, val, test or all; default: test of the procedural
            shapes, all of a folder.
        only: names of shapes to take; default: all of the part.
        points: of an input cloud; a quarter of them where it is sparse.
        truth_points: evenly spread on the true surface, to compare with.
        seed: of all that is drawn.
        normals: whether inputs have normals.
        columns: of prepared clouds that are text or arrays without names, such as "x,y,z,_,nx,ny,nz".
        inputs: how they are drawn from meshes, noise_limit: greatest offset by noise; see `pnu.benchmark.Protocol`.
    """
    if unknown := [kind for kind in kinds if kind not in (*KINDS, *SCANS)]:
        raise ValueError(f"kinds={unknown[0]}: expected some of {', '.join((*KINDS, *SCANS))}")
    if part not in (None, *PARTS):
        raise ValueError(f"part={part}: expected one of {', '.join(PARTS)}")
    for name, value, least in (("points", points, 64), ("truth_points", truth_points, 150)):
        if value < least:
            raise ValueError(f"{name}={value}: expected at least {least}")
    options: dict[str, Any] = {"truth_points": truth_points, "seed": seed, "normals": normals, "warn": warn}
    if data.get("root") and is_pairs_folder(data["root"]):
        root = Path(data["root"])
        paths = pair_files(root)
        names = chosen_names([path.stem for path in paths], data, part or "all", only)
        columns_of([path for path in paths if path.stem in names], columns, str(pair_folders(root).inputs))
        return CaseSource(root.resolve().name, names, ["given"], pair_cases(root, names, columns=columns, **options))
    if columns is not None:
        raise ValueError(f"columns={columns}: is for prepared pairs, data=meshes data.root=FOLDER with clouds/, truth/")
    name, makers = shape_makers(data, part, only)
    names = list(makers)
    return CaseSource(
        name,
        names,
        list(kinds),
        mesh_cases(makers, kinds, points=points, inputs=inputs, noise_limit=noise_limit, **options),
    )


def shape_makers(
    data: Mapping[str, Any], part: str | None = None, only: Sequence[str] | None = None
) -> tuple[str, dict[str, Callable[[], Mesh]]]:
    """The name of `data`, and what makes the meshes of its shapes: of a folder, or procedural."""
    makers: dict[str, Callable[[], Mesh]]
    if data.get("root"):
        name, part = Path(data["root"]).resolve().name, part or "all"
        makers = {name: functools.partial(read_mesh, path) for name, path in meshes_of(data["root"]).items()}
    elif data.get("kinds"):
        name, part = "synthetic", part or "test"
        makers = {name: functools.partial(shapes.make, name) for name in shapes.names(*data["kinds"])}
    else:
        raise ValueError(
            "data: evaluation takes whole shapes: data=synthetic, or data=meshes data.root=FOLDER, a folder of meshes "
            "or one with clouds/ and truth/"
        )
    return name, {shape: makers[shape] for shape in chosen_names(list(makers), data, part, only)}


def chosen_names(names: list[str], data: Mapping[str, Any], part: str, only: Sequence[str] | None) -> list[str]:
    """The names of a part, or of `only`."""
    if only:
        if missing := [name for name in only if name not in names]:
            raise ValueError(f"shapes={missing[0]}: expected some of {', '.join(names)}")
        return list(only)
    if part == "all":
        return names
    shares = {"val": float(data.get("val_share", 0.1)), "test": float(data.get("test_share", 0.1))}
    names = sorted(names)
    return [names[row] for row in split_shapes(names, len(names), **shares, seed=0)[part]]
