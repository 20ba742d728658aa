"""Use weights of the authors' released code: `pnu convert input=epoch_N.pt output=FOLDER`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pnu.commands._entry import command
from pnu.config.quoting import shell_line
from pnu.config.schema import doc


@dataclass
class Convert:
    """Make a run folder from a checkpoint epoch_N.pt of the authors' released code."""

    input: str = doc("checkpoint: a dict with epoch, model_state_dict, optimizer_state_dict and loss")
    output: str = doc("run folder to make; it must not exist yet")
    quiet: bool = doc("print nothing but errors")


def convert(cfg: Any) -> None:
    """Write a run folder from a checkpoint of the released code."""
    output = Path(cfg.output)
    if not Path(cfg.input).is_file():
        raise ValueError(f"input={cfg.input}: no such file; expected a checkpoint epoch_N.pt of the released code")
    if output.exists():
        raise ValueError(f"output={output}: exists already; give the name of a new folder")
    if not output.parent.is_dir():
        raise ValueError(f"output={output}: the folder {output.parent} does not exist; create it first")

    from pnu.networks import checkpoints
    from pnu.networks.pnu import PNU
    from pnu.networks.released import from_released

    content = checkpoints.read_checkpoint(cfg.input)
    state = content.get("model_state_dict")
    if not isinstance(state, dict):
        raise ValueError(f"{cfg.input}: expected a dict with model_state_dict, as the released code saves, found none")
    network = PNU(ratio=4)
    try:
        checkpoints.fill(network, from_released(state), cfg.input)
    except ValueError as error:
        reason = str(error).removeprefix(f"{cfg.input}: ")
        raise ValueError(f"{cfg.input}: is not of the released network: {reason}") from None
    epoch = content.get("epoch")
    record = {"source": Path(cfg.input).name, "epoch": epoch, "training_loss": content.get("loss")}
    checkpoints.save(output, network, {"_target_": "pnu.networks.pnu.PNU", "ratio": 4}, record)
    if not cfg.quiet:
        print(f"input:  {cfg.input}, epoch {epoch}")
        print(f"run:    {output}")
        print(f"next:   {shell_line('upsample', run=output, input='cloud.ply', output='dense.ply')}")


main = command(convert, Convert)

if __name__ == "__main__":
    main()
