"""Keep a trained network as one small file: `pnu export run=FOLDER output=NAME.safetensors`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnu.commands._entry import command
from pnu.config.quoting import shell_line
from pnu.config.schema import doc


@dataclass
class Export:
    """Write the best weights of a run, and what the network is, to one file that `run=` of other commands takes."""

    run: str = doc("run folder")
    output: str = doc("file to write, NAME.safetensors")
    allow: list[str] = doc("packages of your own whose networks a run may name; they run their code")
    quiet: bool = doc("print nothing but errors")


def export(cfg: Any) -> None:
    """Write a run's network as safetensors."""
    if not cfg.output.endswith(".safetensors"):
        raise ValueError(f"output={cfg.output}: expected a name that ends with .safetensors")
    if not (folder := Path(cfg.output).parent).is_dir():
        raise ValueError(f"output={cfg.output}: the folder {folder} does not exist; create it first")

    from pnu import weights
    from pnu.networks import checkpoints

    network = checkpoints.load(cfg.run, cfg.allow)
    model = checkpoints.run_config(Path(cfg.run))["model"]
    weights.write(cfg.output, model, network.state_dict(), getattr(network, "patch_size", None))
    if not cfg.quiet:
        print(f"output: {cfg.output}, {Path(cfg.output).stat().st_size / 1e6:.2f} MB")
        print(f"next:   {shell_line('upsample', run=cfg.output, input='cloud.ply', output='dense.ply')}")


main = command(export, Export)

if __name__ == "__main__":
    main()
