"""What happens beside the training steps: checkpoints, progress, pictures."""

import itertools
import math
import os
import time
from collections.abc import Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from pnu.config.instantiate import PACKAGES, find_class, instantiate
from pnu.config.signature import arguments
from pnu.extras import needed
from pnu.networks.checkpoints import read_checkpoint, write_checkpoint
from pnu.rendering import figure, look_at, render_cloud, save_png
from pnu.rendering.colors import normal_colors
from pnu.runtime.progress import bar
from pnu.training.pruning import keep_values, objective_values, why_hopeless
from pnu.training.run_folder import UNHASHED, UNHASHED_DATA, RunFolder

with needed("training"):
    import lightning.pytorch as pl
    from lightning.pytorch.loggers import Logger, TensorBoardLogger
    from lightning.pytorch.plugins.io import TorchCheckpointIO
    from torch.utils.tensorboard.summary import hparams

CLOUDS_3D = 4  # shapes in TensorBoard's 3D tab


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints that appear whole or not at all; reads tensors and plain types only."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        write_checkpoint(path, checkpoint)

    def load_checkpoint(self, path: Any, map_location: Any = "cpu", weights_only: bool | None = True) -> dict[str, Any]:
        return read_checkpoint(path)


class Checkpoints(pl.Callback):
    """Saves last.ckpt at intervals and at the end, and best.ckpt when a validation value is the smallest so far.

    Args:
        run: whose checkpoints these are; its metrics.json gets the best validation
        every_n_steps: training steps between two last.ckpt; 0: count time only
        every_minutes: minutes between two last.ckpt; 0: count steps only
        monitor: validation value that is best when smallest
    """

    def __init__(
        self, run: RunFolder, every_n_steps: int = 500, every_minutes: float = 5, monitor: str = "val/chamfer_sq"
    ) -> None:
        if every_n_steps < 0 or every_minutes < 0:
            raise ValueError("callbacks.checkpoints: expected every_n_steps and every_minutes of 0 or more")
        self.run, self.monitor = run, monitor
        self.every_n_steps, self.every_s = every_n_steps, 60 * every_minutes
        self.best = math.inf
        self.saved_step, self.saved_at, self.due = 0, 0.0, False

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best = float(state_dict["best"])

    def on_train_batch_end(self, trainer: pl.Trainer, module: Any, *_: Any) -> None:
        step = trainer.global_step
        if step == self.saved_step:  # gradients are still being accumulated
            return
        by_steps = self.every_n_steps and step % self.every_n_steps == 0
        # all processes must save together, and the module's clock is theirs in common
        by_time = self.every_s and module.elapsed_s - self.saved_at >= self.every_s
        self.due = bool(by_steps or by_time or ends(trainer))
        # Lightning takes a validation for done when it goes on from a checkpoint between the step and the validation
        if self.due and not validation_follows(trainer):
            self.save_last(trainer)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.state.fn != "fit" or trainer.sanity_checking:
            return
        found = {name: float(value) for name, value in trainer.callback_metrics.items() if name.startswith("val/")}
        if self.monitor not in found:
            known = ", ".join(sorted(found))
            raise ValueError(f"callbacks.checkpoints.monitor={self.monitor}: expected one of {known}")
        if found[self.monitor] < self.best:
            self.best = found[self.monitor]
            trainer.save_checkpoint(self.run.best, weights_only=True)
            self.run.add_metrics("validation", [found, {"step": trainer.global_step}])
        if self.due or trainer.should_stop:
            self.save_last(trainer)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.global_step != self.saved_step or not self.run.last.exists():
            self.save_last(trainer)

    def save_last(self, trainer: pl.Trainer) -> None:
        """Write last.ckpt, after the curves up to it."""
        for logger in trainer.loggers:
            logger.save()  # what is logged reaches the disk no later than the checkpoint
        trainer.save_checkpoint(self.run.last)
        module: Any = trainer.lightning_module
        self.saved_step, self.saved_at, self.due = trainer.global_step, module.elapsed_s, False


def ends(trainer: pl.Trainer) -> bool:
    """Whether the step that just ended is the last. It is saved here and not at the end of the training, where
    Lightning counts the epoch as done: a run that is made longer then would not go on within it."""
    epoch_ends = trainer.fit_loop.epoch_loop.batch_progress.is_last_batch
    last_epoch = trainer.max_epochs is not None and 0 < trainer.max_epochs <= trainer.current_epoch + 1
    last_step = 0 < trainer.max_steps <= trainer.global_step
    return trainer.should_stop or last_step or (epoch_ends and last_epoch)


def validation_follows(trainer: pl.Trainer) -> bool:
    """Whether Lightning validates after the step that just ended."""
    loop = trainer.fit_loop
    assert loop._data_fetcher is not None
    return loop.epoch_loop._should_check_val_fx(loop._data_fetcher)


def network(module: pl.LightningModule) -> torch.nn.Module:
    """The network that a training trains."""
    assert isinstance(module.model, torch.nn.Module)
    return module.model


class EMA(pl.Callback):
    """Keeps an exponential moving average of the weights: validation, its pictures and best.ckpt are of the average.

    last.ckpt has the weights as they are, to go on from, and the average beside them. Without validation there is no
    best.ckpt, and the average is of no use.

    Args:
        decay: share of the average that stays at a step; at first less, (1 + step) / (10 + step)
    """

    def __init__(self, decay: float = 0.999) -> None:
        if not 0 <= decay < 1:
            raise ValueError(f"callbacks.ema.decay={decay}: expected a number from 0 to below 1")
        self.decay = decay
        self.average: dict[str, Tensor] = {}
        self.step = 0
        self.swapped = False

    def state_dict(self) -> dict[str, Any]:
        return {"average": self.average, "step": self.step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.average, self.step = dict(state_dict["average"]), int(state_dict["step"])

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        now = network(module).state_dict()
        self.average = {
            name: self.average.get(name, value).detach().to(value, copy=True) for name, value in now.items()
        }

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        if trainer.global_step == self.step:  # gradients are still being accumulated
            return
        self.step = trainer.global_step
        decay = min(self.decay, (1 + self.step) / (10 + self.step))
        for name, value in network(module).state_dict().items():
            if value.is_floating_point():
                self.average[name].lerp_(value, 1 - decay)
            else:
                self.average[name].copy_(value)

    def on_validation_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.state.fn == "fit" and self.average:
            self.swap(module)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self.swapped:
            self.swap(module)

    def on_save_checkpoint(self, trainer: pl.Trainer, module: pl.LightningModule, checkpoint: dict[str, Any]) -> None:
        """Training goes on from its own weights, also where last.ckpt is saved after a validation."""
        if self.swapped:
            self.swap(module)
            checkpoint["state_dict"] = {name: value.clone() for name, value in module.state_dict().items()}
            checkpoint["callbacks"][self.state_key] = {
                "average": {name: value.clone() for name, value in self.average.items()},
                "step": self.step,
            }
            self.swap(module)

    def swap(self, module: pl.LightningModule) -> None:
        """The weights for their average, and back."""
        for name, value in network(module).state_dict().items():
            kept = value.clone()
            value.copy_(self.average[name])
            self.average[name].copy_(kept)
        self.swapped = not self.swapped


class Pruning(pl.Callback):
    """Ends a trial of a search that is worse than the median of the sweep's other runs at the same step in all metrics
    of the objective: the median stopping rule (Golovin et al. 2017, "Google Vizier"), with the trial's best values so
    far as in Optuna's `MedianPruner`, and pruned runs among the others as far as they came.

    The result of a pruned trial is its best validation. A run that is no job of a sweep is not pruned, nor is a job
    that `resume=true` goes on with by itself. Runs of one sweep are compared by their step alone, so that they should
    be of one length.

    Args:
        run: the run that may be pruned; its validations.json gets what is compared
        objective: validation metrics that are compared
        startup: other runs that must have got as far before one is pruned
        warmup: steps before which none is pruned
    """

    def __init__(self, run: RunFolder, objective: Sequence[str] | None, startup: int = 5, warmup: int = 0) -> None:
        if startup < 1 or warmup < 0:
            raise ValueError("callbacks.pruning: expected startup >= 1 and warmup >= 0")
        if not objective:
            raise ValueError("callbacks.pruning: compares validation metrics; name them, as objective=[chamfer_sq]")
        self.run, self.objective, self.startup, self.warmup = run, objective, startup, warmup

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.state.fn != "fit" or trainer.sanity_checking or "job" not in self.run.facts:
            return
        found = {name.removeprefix("val/"): float(value) for name, value in trainer.callback_metrics.items()}
        step = trainer.global_step
        keep_values(self.run, step, objective_values(self.objective, found))
        if step >= self.warmup and not ends(trainer):
            self.run.pruned = why_hopeless(self.run, step, self.objective, self.startup)
            trainer.should_stop = trainer.should_stop or bool(self.run.pruned)


class ProgressBar(pl.Callback):
    """One bar for the whole training: step, loss, validation and time left; a line at each validation where there is
    no terminal."""

    def __init__(self) -> None:
        self.validation = ""
        self.started_at = (0.0, 0)

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        total = trainer.estimated_stepping_batches
        self.bar = bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            unseen=False,
        )
        step = trainer.global_step
        self.task = self.bar.add_task(
            "train", total=int(total) if math.isfinite(total) else None, completed=step, text=""
        )
        self.started_at = (time.monotonic(), step)
        if self.bar.console.is_terminal:
            self.bar.start()

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if trainer.is_global_zero:
            loss = float(trainer.callback_metrics.get("train/loss", math.nan))
            text = f"epoch {trainer.current_epoch + 1}  loss {loss:.4g}  {self.validation}"
            self.bar.update(self.task, completed=trainer.global_step, text=text)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.state.fn != "fit" or trainer.sanity_checking or not trainer.is_global_zero:
            return
        self.validation = f"val CD {1e3 * float(trainer.callback_metrics['val/chamfer_sq']):.4g}e-3"
        if not self.bar.console.is_terminal:
            seconds, steps = time.monotonic() - self.started_at[0], trainer.global_step - self.started_at[1]
            total = self.bar.tasks[0].total
            left = f", {clock((total - trainer.global_step) * seconds / steps)} left" if total and steps else ""
            print(f"step {trainer.global_step}: {self.validation} ({clock(seconds)}{left})", flush=True)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.is_global_zero:
            self.bar.stop()

    def on_exception(self, trainer: pl.Trainer, module: pl.LightningModule, exception: BaseException) -> None:
        if hasattr(self, "bar"):
            self.bar.stop()


def clock(seconds: float) -> str:
    """Hours, minutes and seconds, 0:02:43, after days where there are any."""
    return str(timedelta(seconds=round(seconds)))


class Pictures(pl.Callback):
    """Shows the same validation clouds during training: as 3D clouds in TensorBoard, colored by normal, and as PNGs,
    there and in the run folder, beside input and target.

    Args:
        run: whose folder pictures/ gets the PNGs
        clouds: validation clouds, each of another shape as far as there are as many; 0: none; four at most in 3D
        points: points of a cloud in TensorBoard's 3D view at most; more make the tab slow
        every: validations from one picture to the next; the last one of a training is always drawn
        size: pixels of a panel's side
    """

    def __init__(self, run: RunFolder, clouds: int = 4, points: int = 2048, every: int = 10, size: int = 320) -> None:
        if clouds < 0 or min(points, every, size) < 1:
            raise ValueError("callbacks.pictures: expected clouds >= 0 and points, every, size >= 1")
        self.folder, self.clouds, self.points, self.every, self.size = run.pictures, clouds, points, every, size
        self.seen = 0
        self.drawn = -1
        self.samples: list[dict[str, Any]] = []

    def state_dict(self) -> dict[str, Any]:
        return {"seen": self.seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.seen = int(state_dict["seen"])

    def on_validation_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        """Choose the clouds while the first validation runs: the first of each shape."""
        for i, shape in enumerate(batch["shape"]):
            if len(self.samples) < self.clouds and shape not in {sample["shape"] for sample in self.samples}:
                cloud = {name: batch[name][i].float().cpu() for name in ("input", "target")}
                self.samples.append({"shape": shape, **cloud})

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.sanity_checking:
            return
        if self.seen % self.every == 0:
            self.draw(trainer, module)
        self.seen += 1

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self.drawn != trainer.global_step:
            self.draw(trainer, module)

    def draw(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """Put the clouds as they are now into TensorBoard and the run folder; inputs and targets the first time."""
        if not trainer.is_global_zero:
            return
        first, self.drawn = self.drawn < 0, trainer.global_step
        training, writer = module.training, board(trainer)
        module.eval()
        for index, sample in enumerate(self.samples):
            with torch.no_grad():
                prediction = module(sample["input"][None].to(module.device))[0].float().cpu()
            clouds = {"prediction": prediction.numpy()}
            if first:
                clouds |= {name: sample[name].numpy() for name in ("input", "target")}
            for name, cloud in clouds.items():
                if writer is not None and index < CLOUDS_3D:
                    shown = cloud[:: -(-len(cloud) // self.points)]
                    writer.add_mesh(
                        f"{sample['shape']}/{name}",
                        shown[None, :, :3],
                        normal_colors(shown_normals(shown))[None],
                        config_dict={"material": {"cls": "PointsMaterial", "size": point_size(shown[:, :3])}},
                        global_step=self.drawn,
                    )
            picture = self.picture(sample, prediction.numpy())
            if picture is not None:
                name = sample["shape"].replace("/", "_")  # a shape of a folder, or "procedural/apple"
                save_png(self.folder / f"{name}_{self.drawn:07d}.png", picture)
                if writer is not None:
                    writer.add_image(sample["shape"], picture, self.drawn, dataformats="HWC")
        module.train(training)

    def picture(self, sample: dict[str, Any], prediction: np.ndarray) -> np.ndarray | None:
        """Input, prediction and target side by side (h, w, 3); None where the prediction is no picture yet."""
        clouds = {"input": sample["input"].numpy(), "prediction": prediction, "target": sample["target"].numpy()}
        for camera in (look_at(clouds["target"]), look_at(*clouds.values())):
            try:
                panels = [
                    render_cloud(cloud[:, :3], normal_colors(shown_normals(cloud)), camera=camera, size=self.size)
                    for cloud in clouds.values()
                ]
                return figure(panels, list(clouds))
            except ValueError:  # an untrained network may put all points where the camera does not look
                continue
        return None


class Board(pl.Callback):
    """Writes to TensorBoard what is known once: the config as text, and at the end the hyperparameters with the final
    metrics."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self.config = config

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.is_global_zero and (writer := board(trainer)) is not None:
            text = OmegaConf.to_yaml(OmegaConf.create(dict(self.config)))
            writer.add_text("config", "".join(f"    {line}\n" for line in text.splitlines()), trainer.global_step)

    def on_test_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.is_global_zero and (writer := board(trainer)) is not None:
            metrics = {
                name: float(value) for name, value in trainer.callback_metrics.items() if name.startswith("test/")
            }
            # without the first summary, a list of all keys, TensorBoard makes its own: those first that differ
            for summary in hparams(hyperparameters(self.config), metrics)[1:]:
                writer.file_writer.add_summary(summary)
            writer.flush()


def point_size(points: np.ndarray) -> float:
    """About the distance of neighbors among points (n, 3) on a surface; TensorBoard's own size is hardly to be seen."""
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    return float(f"{max(extent, 1e-3) / len(points) ** 0.5:.3g}")


def hyperparameters(config: Mapping[str, Any], prefix: str = "") -> dict[str, bool | int | float | str]:
    """The config's values under their dotted keys, as TensorBoard wants them; without those that change no result."""
    flat: dict[str, bool | int | float | str] = {}
    unused = {"": UNHASHED, "data.": UNHASHED_DATA}.get(prefix, ())
    for name, value in config.items():
        if name in unused:
            continue
        if isinstance(value, Mapping):
            flat |= hyperparameters(value, f"{prefix}{name}.")
        elif value is not None and not str(name).startswith("_partial_"):
            flat[f"{prefix}{name}"] = value if isinstance(value, bool | int | float | str) else str(value)
    return flat


def board(trainer: pl.Trainer) -> Any:
    """TensorBoard's SummaryWriter, or None."""
    return next((x.experiment for x in trainer.loggers if isinstance(x, TensorBoardLogger)), None)


def shown_normals(cloud: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) of a cloud (n, 6); zeros, shown gray, for a cloud without normals."""
    if cloud.shape[1] < 6:
        return np.zeros((len(cloud), 3))
    normals: np.ndarray = cloud[:, 3:6] / np.maximum(np.linalg.norm(cloud[:, 3:6], axis=1, keepdims=True), 1e-12)
    return normals


KEEPERS = (Checkpoints, Pictures, Pruning)


def build_all(config: Mapping[str, Any], run: RunFolder) -> list[pl.Callback]:
    """The callbacks of a training. Checkpoints save what the others have become, EMA then takes the average away again.

    As Lightning's `fast_dev_run` writes neither checkpoints nor curves, ours keep nothing of it."""
    trainer = config["trainer"]
    progress = [] if config["quiet"] or trainer.get("enable_progress_bar") else [ProgressBar()]
    found: list[pl.Callback] = [Board(config), *progress]
    for group in (config["callbacks"] or {}).values():
        if trainer.get("fast_dev_run") and find_class(group["_target_"], "pnu", ("lightning",)) in KEEPERS:
            continue
        known = arguments(str(group["_target_"])) or {}
        own = {n: v for n, v in {"run": run, "objective": config["objective"]}.items() if n in known}
        found.append(instantiate(group, PACKAGES["callbacks"], allow=config.get("allow") or (), **own))
    return sorted(found, key=lambda callback: (isinstance(callback, EMA), isinstance(callback, Checkpoints)))


def build_loggers(config: Mapping[str, Any], run: RunFolder) -> list[Logger]:
    """The loggers of a training. What TensorBoard's has after a run's last checkpoint is taken back."""
    groups = config["logger"] or {}
    purge = {"purge_step": read_checkpoint(run.last)["global_step"]} if run.last.exists() else {}
    found = []
    for group in [groups] if "_target_" in groups else groups.values():  # runs of earlier versions have one, unnamed
        kind = str(group["_target_"]).rpartition(".")[2]
        more: dict[str, Any] = purge if kind == "TensorBoardLogger" else {}
        if kind == "CSVLogger":  # which would write over what it has
            group = {**group, "version": unused_name(run.path / (group.get("name") or ""), str(group.get("version")))}
        folder = run.path
        if kind == "MLFlowLogger":
            folder = run.path.absolute() / "mlflow"
            os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # later versions want a database otherwise
        found.append(
            instantiate(group, PACKAGES["logger"], allow=config.get("allow") or (), save_dir=str(folder), **more)
        )
    return found


def unused_name(folder: Path, name: str) -> str:
    """A name that nothing in a folder has: csv, csv_2, csv_3 ..."""
    names = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
    return next(one for one in names if not (folder / one).exists())
