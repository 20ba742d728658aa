"""Cut patches from meshes, or describe a file of patches: `pnu prepare [key=value ...]`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnu.commands._entry import command
from pnu.config.instantiate import instantiate
from pnu.config.quoting import shell_line
from pnu.config.schema import Group, doc

BATCH = 20  # patches of a training step, as conf/data/patches.yaml has it


@dataclass
class Prepare:
    """Cut patches from procedural shapes (data=synthetic) or a folder of meshes (data=meshes data.root=FOLDER) into an
    HDF5 file for training, and describe it; or describe a file that is there (describe=FILE)."""

    describe: str | None = doc("file of patches to check and describe; nothing is cut")
    output: str | None = doc("also name the file so; null: only data.cache, where training finds it by its parameters")
    seed: int = doc("not used by the patches, see data.shape_seed")
    quiet: bool = doc("no progress bar, print the file's path alone")
    data: Group = doc("Data")


def prepare(cfg: Any) -> None:
    """Cut patches, or describe a file of them."""
    from pnu.data.patch_file import describe

    if cfg.output and not cfg.describe and Path(cfg.output).suffix not in (".h5", ".hdf5"):
        raise ValueError(f"output={cfg.output}: expected a name that ends with .h5")
    path = Path(cfg.describe) if cfg.describe else instantiate(cfg.data, "pnu.data").patch_file()
    if cfg.output and not cfg.describe:
        path = copied(path, Path(cfg.output))
    figures = describe(path)
    if cfg.quiet:
        print(path)
        return
    for name, value in figures.items():
        if name != "parameters":
            print(f"{name:24s} {'-' if value is None else value if not isinstance(value, float) else f'{value:.4g}'}")
    print(next_line(path))


def next_line(path: Path) -> str:
    """The training that a file of patches is fit for, or why it is fit for none."""
    from pnu.data.patch_dataset import Options, split_shapes
    from pnu.data.patch_file import check_patch_file

    contents, usual = check_patch_file(path), Options()
    target = min(usual.target_points, contents.points)
    points = min(usual.input_points, target // 4)
    if points < 64:
        return f"no training: a patch needs 256 points or more, these have {contents.points}"
    try:
        train = split_shapes(contents.names, contents.patches, val=0.1, test=0.1, seed=0)["train"]
    except ValueError as error:
        return f"no training: {error}"
    options: dict[str, Any] = {"data.path": path}
    if target < usual.target_points:
        options |= {"data.input_points": points, "data.target_points": target}
    if len(train) < BATCH:
        options["data.batch_size"] = len(train)
    return f"next: {shell_line('train', data='patches', **options)}"


def copied(path: Path, output: Path) -> Path:
    """A copy of a file under another name, whole or not at all."""
    import shutil

    from pnu.io import atomic_path

    output.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(output) as temporary:
        shutil.copyfile(path, temporary)
    return output


main = command(prepare, Prepare)

if __name__ == "__main__":
    main()
