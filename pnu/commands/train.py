"""Train an upsampling network: `python -m pnu.train [key=value ...]`; `--help` lists the keys."""

import functools
from dataclasses import dataclass
from typing import Any, ClassVar

from pnu.commands._entry import command
from pnu.config.instantiate import PACKAGES, find_metric, instantiate
from pnu.config.schema import Group, Groups, doc
from pnu.extras import needed
from pnu.runtime.provenance import machine


@dataclass
class Train:
    """Train an upsampling network; `task=normals`, which is `experiment=normals`, one of normals. Ends with its test
    metrics and a run folder for `pnu upsample`."""

    also: ClassVar = {"task": "experiment"}
    seed: int = doc("of the weights, the order of the data and their augmentation")
    name: str = doc("last part of the run folder's name")
    run: str | None = doc("run folder; null: outputs/<date>/<time>_<name>")
    resume: bool = doc("go on with the run in run=FOLDER, with its config, from its last checkpoint")
    weights: str | None = doc(
        "to start from: run folder, or weights that come with pnu; previous: of the job before, in a sweep; null: "
        "drawn by the seed"
    )
    threads: int | None = doc("threads of a training on the CPU; null: one for each core; small patches want one")
    quiet: bool = doc("print the run folder alone")
    sweep: str | None = doc("name of a sweep (-m) below outputs/sweeps; null: made of the command line")
    metrics: list[str] = doc("classes of metrics of your own, measured beside pnu's: [mylab.Roughness]")
    objective: list[str] | None = doc("validation metrics that a search (hparams_search) makes small")
    allow: list[str] = doc("packages of your own whose classes a config may name, as loss._target_=mylab.Laplacian")
    data: Group = doc("Data")
    model: Group = doc("Network")
    loss: Group = doc("Loss")
    optimizer: Group = doc("Optimizer")
    scheduler: Group = doc("Learning rate, stepped after each training step")
    trainer: Group = doc("Training, by Lightning's Trainer")
    callbacks: Groups = doc("Beside the training")
    logger: Groups = doc("Where curves go")


def train(cfg: Any) -> list[float] | None:
    """Train as the config says; the best validation's values of what the config names as objective."""
    from pnu.training.closing_lines import closing_lines, job_line, objective
    from pnu.training.resuming import open_run
    from pnu.training.run_folder import is_main_process

    run, config = open_run(cfg, Train)
    if run.skip:
        run.unlock()
        print(f"{run}: {run.skip}")
        return objective(config, run)
    with run.recorded(config) as record:
        with needed("training"):
            import lightning.pytorch as pl  # seconds: only once the config is known to be good
        import torch

        from pnu import metrics, networks
        from pnu.networks import checkpoints
        from pnu.runtime import denormals
        from pnu.training import callbacks, lightning_module, sweeps

        lightning_module.quieten()
        lightning_module.keep_threads()
        if config["threads"]:
            torch.set_num_threads(config["threads"])
        pl.seed_everything(config["seed"], verbose=False)
        allow = config["allow"]
        parts = {
            group: instantiate(config[group], PACKAGES[group], allow=allow)
            for group in ("data", "loss", "optimizer", "scheduler")
        }
        model, data = networks.build_network(config["model"], allow), parts.pop("data")
        lightning_module.check_input(model, data)
        source = config.get("weights")
        if source and not run.last.exists():  # a run that goes on has its own
            if source == "previous":
                record["weights"] = source = str(sweeps.weights_before(run))
            checkpoints.start_from(model, checkpoints.load(source, allow), source)
        find = functools.partial(find_metric, allow=allow)
        chosen = metrics.with_own(config.get("metrics") or (), find)
        record["metrics"] = {m.shown.name: m.shown._asdict() for m in chosen if m not in metrics.METRICS}
        module = module_of(parts["loss"], config["trainer"])(model, **parts, metrics=chosen)
        options: Any = {
            name: value for name, value in lightning_module.TRAINER_OPTIONS.items() if name not in config["trainer"]
        }
        with lightning_module.misconfigured():
            trainer = instantiate(
                config["trainer"],
                PACKAGES["trainer"],
                callbacks=callbacks.build_all(config, run),
                logger=callbacks.build_loggers(config, run) or False,
                plugins=[callbacks.AtomicCheckpointIO(), *lightning_module.norm_plugins(config["trainer"])],
                default_root_dir=run.path,
                **options,
            )
        record |= {
            "task": getattr(model, "task", "upsampling"),
            "device": str(trainer.strategy.root_device),
            "machine": machine(),
        }
        start = run.last if run.last.exists() else None
        with denormals.as_zero():
            if start is None:
                run.add_metrics("start" if source else "untrained", trainer.validate(module, data, verbose=False))
            trainer.fit(module, data, ckpt_path=start, weights_only=True)
            if run.best.exists():
                module.load_state_dict(checkpoints.read_checkpoint(run.best)["state_dict"])
            if not run.pruned:
                run.add_metrics("test", trainer.test(module, data, verbose=False))
        result = objective(config, run)
    if is_main_process():
        print(run if config["quiet"] else job_line(run) if "job" in run.facts else closing_lines(run))
    return result


def module_of(loss: Any, trainer: Any) -> Any:
    """The Lightning module that trains with a loss; ValueError where the trainer's options do not go with it."""
    from pnu.losses import AdversarialLoss
    from pnu.training import adversarial_module, lightning_module

    if not isinstance(loss, AdversarialLoss):
        return lightning_module.UpsamplingModule
    adversarial_module.check_manual(trainer)
    return adversarial_module.AdversarialModule


main = command(train, Train)

if __name__ == "__main__":
    main()
