"""Files of a folder by the names of what they hold."""

from collections.abc import Collection
from pathlib import Path

from pnu.io.mesh import MESH_SUFFIXES

KINDS = ", ".join(suffix[1:] for suffix in sorted(MESH_SUFFIXES))


def files_of(folder: str | Path, suffixes: Collection[str], *, below: bool = False) -> list[Path]:
    """Files of these suffixes in a folder, in `below` or in its subfolders too, sorted; hidden ones are left out, among
    them those that a killed program left half-written."""
    found = Path(folder).glob("**/*" if below else "*")
    return sorted(path for path in found if path.suffix.lower() in suffixes and not path.name.startswith("."))


def meshes_of(root: str | Path) -> dict[str, Path]:
    """The meshes of a folder and its subfolders by name: the path below the folder, with _ for /.

    Raises:
        ValueError: no such folder, no meshes, or two of one name.
    """
    root = Path(root)
    if not root.is_dir():
        raise ValueError(f"data.root={root}: no such folder; expected one with meshes ({KINDS})")
    found: dict[str, Path] = {}
    for path in files_of(root, MESH_SUFFIXES, below=True):
        name = path.relative_to(root).with_suffix("").as_posix().replace("/", "_")
        if name in found:  # the same shape twice would be in training and in validation
            raise ValueError(f"data.root={root}: {found[name]} and {path} are both named {name}; rename or move one")
        found[name] = path
    if not found:
        raise ValueError(f"data.root={root}: expected meshes ({KINDS}), found none")
    return found
