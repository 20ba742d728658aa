"""Train an upsampling network: `python -m pnu.train [key=value ...]`; `--help` lists the keys."""

import functools
from dataclasses import dataclass
from typing import Any

from pnu.run import build, closing, command, doc, find_metric, is_main_process, job_line, objective, open_run
from pnu.run.groups import Callbacks, Data, Logger, Loss, Model, Optimizer, Scheduler, Trainer
from pnu.run.provenance import machine


@dataclass
class Train:
    """Train an upsampling network. Ends with its test metrics and a run folder for `python -m pnu.upsample`."""

    seed: int = doc("of the weights, the order of the data and their augmentation")
    name: str = doc("last part of the run folder's name")
    run: str | None = doc("run folder; null: outputs/<date>/<time>_<name>")
    resume: bool = doc("go on with the run in run=FOLDER, with its config, from its last checkpoint")
    weights: str | None = doc("to start from: run folder, or weights that come with pnu; null: drawn by the seed")
    threads: int | None = doc("threads of a training on the CPU; null: one for each core; small patches want one")
    quiet: bool = doc("print the run folder alone")
    sweep: str | None = doc("name of a sweep (-m) below outputs/sweeps; null: made of the command line")
    metrics: list[str] = doc("classes of metrics of your own, measured beside pnu's: [mylab.Roughness]")
    allow: list[str] = doc("packages of your own whose classes may be named, such as [mylab]")
    objective: list[str] | None = doc("validation metrics that a search (hparams_search) makes small")
    data: Data = doc("Data")
    model: Model = doc("Network")
    loss: Loss = doc("Loss")
    optimizer: Optimizer = doc("Optimizer")
    scheduler: Scheduler = doc("Learning rate, stepped after each training step")
    trainer: Trainer = doc("Training, by Lightning's Trainer")
    callbacks: Callbacks = doc("Beside the training")
    logger: Logger = doc("Logger")


def train(cfg: Any) -> list[float] | None:
    """Train as the config says; the best validation's values of what the config names as objective."""
    run, config = open_run(cfg, Train)
    if run.skip:
        run.unlock()
        print(f"{run}: {run.skip}")
        return objective(config, run)
    with run.recorded(config) as record:
        import lightning.pytorch as pl  # seconds: only once the config is known to be good
        import torch

        from pnu import callbacks, checkpoint, lit, metrics, networks

        lit.quieten()
        lit.keep_threads()
        if config["threads"]:
            torch.set_num_threads(config["threads"])
        pl.seed_everything(config["seed"], verbose=False)
        data = build(config["data"], "pnu.data")
        model = networks.build(config["model"])
        if source := config.get("weights"):
            checkpoint.fill(model, checkpoint.load(source).state_dict(), source)
        loss = build(config["loss"], "pnu.losses")
        optimizer = build(config["optimizer"], "torch.optim")
        scheduler = build(config["scheduler"], "torch.optim.lr_scheduler")
        find = functools.partial(find_metric, allow=config.get("allow"))
        chosen = metrics.with_own(config.get("metrics") or (), find)
        record["metrics"] = {m.shown.name: m.shown._asdict() for m in chosen if m not in metrics.METRICS}
        module = lit.UpsamplingModule(model, loss, optimizer, scheduler, chosen)
        trainer = build(
            config["trainer"],
            "lightning.pytorch",
            callbacks=callbacks.build_all(config, run),
            logger=callbacks.build_logger(config, run),
            plugins=[callbacks.AtomicCheckpointIO(), *lit.norm_plugins(config["trainer"])],
            default_root_dir=run.path,
            **lit.TRAINER_OPTIONS,
        )
        record |= {"device": str(trainer.strategy.root_device), "machine": machine()}
        start = run.last if run.last.exists() else None
        if start is None:
            run.add_metrics("start" if source else "untrained", trainer.validate(module, data, verbose=False))
        trainer.fit(module, data, ckpt_path=start, weights_only=True)
        if run.best.exists():
            module.load_state_dict(checkpoint.read(run.best)["state_dict"])
        run.add_metrics("test", trainer.test(module, data, verbose=False))
        result = objective(config, run)
    if is_main_process():
        print(run if config["quiet"] else job_line(run) if "job" in run.facts else closing(run))
    return result


main = command(train, Train)

if __name__ == "__main__":
    main()
