"""Cut patches from meshes, or describe a file of patches: `python -m pnu.prepare [key=value ...]`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnu.run import build, command, doc, shell_line
from pnu.run.groups import Data


@dataclass
class Prepare:
    """Cut patches from procedural shapes (data=synthetic) or a folder of meshes (data=meshes data.root=FOLDER) into an
    HDF5 file for training, and describe it; or describe a file that is there (describe=FILE)."""

    describe: str | None = doc("file of patches to check and describe; nothing is cut")
    output: str | None = doc("also name the file so; null: only data.cache, where training finds it by its parameters")
    seed: int = doc("not used by the patches, see data.shape_seed")
    quiet: bool = doc("no progress bar, print the file's path alone")
    data: Data = doc("Data")


def prepare(cfg: Any) -> None:
    from pnu.data.patchset import describe

    path = Path(cfg.describe) if cfg.describe else build(cfg.data, "pnu.data").patch_file()
    if cfg.output and not cfg.describe:
        path = copied(path, Path(cfg.output))
    if cfg.quiet:
        print(path)
        return
    for name, value in describe(path).items():
        if name != "parameters":
            print(f"{name:24s} {'-' if value is None else value if not isinstance(value, float) else f'{value:.4g}'}")
    print(f"next: {shell_line('train', data='patches', **{'data.path': path})}")


def copied(path: Path, output: Path) -> Path:
    """A copy of a file under another name, whole or not at all."""
    import shutil

    from pnu.io import atomic_path

    if output.suffix not in (".h5", ".hdf5"):
        raise ValueError(f"output={output}: expected a name that ends with .h5")
    output.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(output) as temporary:
        shutil.copyfile(path, temporary)
    return output


main = command(prepare, Prepare)

if __name__ == "__main__":
    main()
