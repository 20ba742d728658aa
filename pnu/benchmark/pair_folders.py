"""Folders of pairs, inputs with their truths as files: the project's own form, and that of the public ones."""

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pnu.io import CLOUD_SUFFIXES, files_of

Warn = Callable[[str], None]
MESH_FOLDERS = ("meshes", "original_meshes")


class PairFolders(NamedTuple):
    """Where inputs and truths lie."""

    inputs: Path
    samples: Path  # of the true surface
    meshes: Path | None
    public: bool  # gt_8192/NAME.xyz; else NAME_<count>.npy beside the meshes

    def sample_file(self, shape: str, count: int, warn: Warn) -> Path | None:
        """The file of a shape's samples: of `count` of them, or of the most where there is none of so many; None
        without any."""
        if self.public:
            return next((path for path in files_of(self.samples, CLOUD_SUFFIXES) if path.stem == shape), None)
        found = {named_count(p): p for p in files_of(self.samples, {".npy"}) if p.stem.rpartition("_")[0] == shape}
        found.pop(None, None)
        if not found:
            return None
        chosen = count if count in found else max(n for n in found if n is not None)
        if chosen != count:
            warn(f"{found[chosen]}: is compared with, since there is no {shape}_{count}.npy (truth_points={count})")
        return found[chosen]


def pair_folders(root: str | Path) -> PairFolders:
    """The folders of pairs below a root.

    Raises:
        ValueError: there are none, or several of inputs or of truths.
    """
    root = Path(root)
    if (root / "clouds").is_dir() and (root / "truth").is_dir():
        return PairFolders(root / "clouds", root / "truth", root / "truth", False)
    found = numbered(root, "input"), numbered(root, "gt")
    for name, folders in zip(("input", "gt"), found, strict=True):
        if len(folders) != 1:
            listed = ", ".join(folder.name for folder in folders) or "none"
            raise ValueError(f"data.root={root}: expected one folder {name}_<points>, found {listed}")
    places = [place / name for place in (root, root.parent) for name in MESH_FOLDERS]
    meshes = next((place for place in places if place.is_dir()), None)
    return PairFolders(found[0][0], found[1][0], meshes, True)


def numbered(root: Path, name: str) -> list[Path]:
    """Folders such as input_2048."""
    found = sorted(root.glob(f"{name}_*")) if root.is_dir() else []
    return [path for path in found if path.is_dir() and re.fullmatch(rf"{name}_\d+", path.name)]


def is_pairs_folder(root: str | Path) -> bool:
    """Whether a folder holds pairs: in clouds/ and truth/, or in input_2048/ and gt_8192/."""
    root = Path(root)
    own = (root / "clouds").is_dir() and (root / "truth").is_dir()
    return own or bool(numbered(root, "input") and numbered(root, "gt"))


def pair_files(root: str | Path) -> list[Path]:
    """The input clouds of a folder of pairs."""
    folder = pair_folders(root).inputs
    clouds = files_of(folder, CLOUD_SUFFIXES)
    if not clouds:
        raise ValueError(f"{folder}: expected clouds ({', '.join(sorted(CLOUD_SUFFIXES))}), found none")
    for one, other in itertools.pairwise(sorted(clouds, key=lambda path: path.stem)):
        if one.stem == other.stem:  # their rows would be taken for those of one cloud
            raise ValueError(f"{one} and {other}: are both named {one.stem}; rename or remove one")
    return clouds


def named_count(path: Path) -> int | None:
    """The count in NAME_<count>.npy."""
    digits = path.stem.rpartition("_")[2]
    return int(digits) if digits.isdecimal() else None
