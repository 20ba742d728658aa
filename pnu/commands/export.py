"""Keep a trained network as one small file: `pnu export run=FOLDER output=NAME.safetensors`, or as ONNX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pnu.commands._entry import command
from pnu.config.quoting import shell_line
from pnu.config.schema import doc


@dataclass
class Export:
    """Write the best weights of a run, and what the network is, to one file that `run=` of other commands takes."""

    run: str = doc("run folder, file of weights, or name of weights that come with pnu, such as surface")
    output: str | None = doc("file to write; null: named as the run, in the working folder")
    format: Literal["safetensors", "onnx"] | None = doc(
        "safetensors, which pnu reads, or onnx, for other runtimes; null: what output ends with"
    )
    coarse: str | None = doc(
        "of surface models: run or weights of a smaller one (experiment=surface_coarse) for the steps before the last; "
        "null: as the run has it"
    )
    allow: list[str] = doc("packages of your own whose networks a run may name; they run their code")
    quiet: bool = doc("print nothing but errors")


def export(cfg: Any) -> None:
    """Write a run's network as safetensors or ONNX."""
    ending = cfg.format or ("onnx" if str(cfg.output).endswith(".onnx") else "safetensors")
    output = Path(f"{Path(cfg.run).name}.{ending}") if cfg.output is None else Path(cfg.output)
    if output.suffix != f".{ending}":
        other = "" if cfg.format else " or .onnx"
        raise ValueError(f"output={output}: expected a name that ends with .{ending}{other}")
    if not output.parent.is_dir():
        raise ValueError(f"output={output}: the folder {output.parent} does not exist; create it first")

    from pnu.networks import checkpoints

    network = checkpoints.load(cfg.run, cfg.allow)
    if ending == "onnx":
        lines = as_onnx(network, output)
    else:
        lines = as_safetensors(network, cfg.run, output, cfg.coarse and checkpoints.load(cfg.coarse, cfg.allow))
    if not cfg.quiet:
        print(f"output: {output}, {output.stat().st_size / 1e6:.2f} MB")
        print("\n".join(lines))


def as_safetensors(network: Any, run: str, output: Path, coarse: Any = None) -> list[str]:
    """Write a run's network, with another one for its coarse steps where that is given; what to say about it."""
    from pnu import weights
    from pnu.networks import checkpoints

    file = weights.find(run)
    model = checkpoints.run_config(Path(run))["model"] if file is None else weights.read(file).model
    if coarse is not None:
        if not hasattr(network, "with_coarse"):
            raise ValueError(f"coarse: {type(network).__name__} has no coarse steps; leave it out")
        network = network.with_coarse(coarse)
        model = model | {"coarse": network.coarse_width}
    weights.write(output, model, network.state_dict(), getattr(network, "patch_size", None))
    return [f"next:   {shell_line('upsample', run=output, input='cloud.ply', output='dense.ply')}"]


def as_onnx(network: Any, output: Path) -> list[str]:
    """Write a network, compare what the file computes with what torch does, and say it, and what goes in."""
    from pnu.networks import onnx_file

    inputs = onnx_file.example_inputs(network)
    onnx_file.write_onnx(output, network, {"network": type(network).__name__, "ratio": network.ratio})
    apart = onnx_file.difference(output, network, inputs)
    shapes = [f"{name} ({', '.join(map(str, ['any', *value.shape[1:]]))})" for name, value in inputs.items()]
    return [
        f"        onnxruntime and torch differ by {apart:.1e} of the largest value",
        f"        in: {', '.join(shapes)}; out: {', '.join(onnx_file.output_names(network))}",
    ]


main = command(export, Export)

if __name__ == "__main__":
    main()
