"""Open the run folder of a training: a new one, or the one to go on with."""

import json
import os
import shlex
from collections.abc import Sequence
from typing import Any

from pnu.config.compose import flatten, in_multirun
from pnu.config.quoting import shell_line
from pnu.config.schema import checked_config
from pnu.io import remove_leftovers
from pnu.training import sweeps
from pnu.training.run_folder import RunFolder, is_main_process

# What may change when a run goes on: how long, where and how loud, not what is learnt.
FREE = (
    "run",
    "resume",
    "quiet",
    "allow",
    "data.workers",
    "trainer.max_epochs",
    "trainer.max_steps",
    "trainer.max_time",
    "trainer.accelerator",
    "trainer.devices",
    "trainer.num_nodes",
    "trainer.strategy",
    "trainer.profiler",
    "trainer.limit_test_batches",
    "callbacks.checkpoints.every_n_steps",
    "callbacks.checkpoints.every_minutes",
    "callbacks.pictures.every",
)
VARIABLE = "PNU_RUN"  # tells the processes that a distributed training starts which folder is the run's


def open_run(cfg: Any, schema: type) -> tuple[RunFolder, dict[str, Any]]:
    """The run folder and the plain config of a training.

    With `resume` the config is the folder's own; the command line may change what `FREE` lists. Without, the folder is
    new, or `run` where given; in a multirun it is the job's folder below the sweep's, see `pnu.training.sweeps`.

    Raises:
        ValueError: not a run folder, a run where a new one shall be, or an override that a run cannot take.
    """
    from omegaconf import OmegaConf

    config: Any = OmegaConf.to_container(cfg, resolve=True)
    if in_multirun():
        sweeps.check_job(config)
        run = sweeps.job_folder(config)
        if not run.skip:
            run.prepare(config)
        return run, config
    overrides = task_overrides()
    if config["resume"]:
        run = RunFolder.existing(config["run"])
        config = restored(run, config, overrides, schema)
        if is_main_process():
            run.lock = sweeps.locked(run.path)
            remove_leftovers(run.path)
            if not run.last.exists():
                if run.best.exists() and run.read_record().get("status") == "finished":
                    cure = shell_line("train", weights=run)
                    raise ValueError(
                        f"run={run}: has finished, and has no last.ckpt to go on from; {cure} starts from it"
                    )
                run.start_anew()
            run.prepare(config)
        return run, config
    if not is_main_process():
        path = os.environ.get(VARIABLE) or config["run"]
        if path is None:
            raise ValueError("run=FOLDER must be given where torchrun or SLURM starts the processes: all need the same")
        return RunFolder(path), config
    run = RunFolder.create(config)
    run.lock = sweeps.locked(run.path)
    os.environ[VARIABLE] = str(run.path.absolute())
    return run, config


def task_overrides() -> list[str]:
    """The overrides of the command line."""
    from hydra.core.hydra_config import HydraConfig

    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def restored(run: RunFolder, config: dict[str, Any], overrides: Sequence[str], schema: type) -> dict[str, Any]:
    """The config of a run folder, with those values of `config` that the overrides set and a run can take."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        written: Any = OmegaConf.load(run.config)
        if "${" in json.dumps(OmegaConf.to_container(written), default=str):  # it could ask for ${oc.env:SECRET}
            raise ValueError(f"{run.config}: expected plain values, found ${{...}}; write out what it stands for")
        if "allow" in config:  # whose code may run is said anew, never by a folder
            written["allow"] = config["allow"]
        saved = checked_config(written, schema)
    except (OmegaConfBaseException, YAMLError, AttributeError, TypeError, RecursionError) as error:
        raise ValueError(f"{run.config}: expected the config of a run, found {' '.join(str(error).split())}") from None
    for key in config.keys() - saved.keys():  # of a later version than the run's
        OmegaConf.update(saved, key, config[key], force_add=True)
    known = {argument.lstrip("+") for argument in shlex.split(str(run.read_record().get("command", "")))}
    values = flatten(config)
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key in FREE:
            OmegaConf.update(saved, key, values[key], force_add=True)
        elif override.lstrip("+") not in known:  # repeating the command that started the run does no harm
            raise ValueError(f"{override}: a run that goes on keeps its config; what may change: {', '.join(FREE)}")
    return OmegaConf.to_container(saved)  # type: ignore[return-value]
