"""Training as Lightning sees it: one step, one validation, the optimizer."""

import inspect
import logging
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR

from pnu.extras import needed
from pnu.fast import accelerate
from pnu.metrics import METRICS, CloudMetrics, Metric
from pnu.networks.checkpoints import write_checkpoint
from pnu.networks.norm import synchronize
from pnu.upsamplers import dense_patches

with needed("training"):
    import lightning.pytorch as pl
    from lightning.fabric.utilities.exceptions import MisconfigurationException
    from lightning.pytorch.callbacks import Timer
    from lightning.pytorch.plugins.layer_sync import TorchSyncBatchNorm
    from lightning.pytorch.utilities.types import OptimizerLRScheduler

Batch = Mapping[str, Any]


# What is not for the user to choose: our own callbacks save, show progress and pictures; the data's sampler knows
# about processes; values are logged at every step.
TRAINER_OPTIONS = {
    "enable_checkpointing": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
    "num_sanity_val_steps": 0,
    "log_every_n_steps": 1,
    "inference_mode": False,  # its tensors would stay in the metrics, of no use to the training after them
    "use_distributed_sampler": False,
}
TIMED_STEPS = 10**6  # into which trainer.max_time is divided where the schedule follows it
NOISE = (  # warnings of Lightning and torch that ask for what is meant as it is
    ".*does not have many workers.*",
    ".*is smaller than the logging interval.*",
    ".*Checkpoint directory .* exists and is not empty.*",
    ".*Found .* module.s. in eval mode at the start of training.*",
    ".*You're resuming from a checkpoint that ended before the epoch ended.*",
    ".*treespec.*is deprecated.*",
)


def quieten() -> None:
    """Silence Lightning's advice and start-up lines; its errors and other warnings stay."""
    for name in ("lightning.pytorch", "lightning.fabric", "pytorch_lightning"):
        logging.getLogger(name).setLevel(logging.ERROR)
    for message in NOISE:
        warnings.filterwarnings("ignore", message=message)


def keep_threads() -> None:
    """Let OMP_NUM_THREADS decide how many threads torch uses: joblib gives its processes an MKL_NUM_THREADS of its own,
    which torch takes instead, and another number of threads rounds differently."""
    if os.environ.get("OMP_NUM_THREADS", "").isdigit():
        torch.set_num_threads(max(1, int(os.environ["OMP_NUM_THREADS"])))


class SynchronizedNorms(TorchSyncBatchNorm):
    """trainer.sync_batchnorm=true, on the CPU as well."""

    def apply(self, model: nn.Module) -> nn.Module:
        return synchronize(model)

    def revert(self, model: nn.Module) -> nn.Module:
        return synchronize(model, False)


def norm_plugins(trainer: Mapping[str, Any]) -> list[SynchronizedNorms]:
    """What Lightning needs for the trainer's sync_batchnorm."""
    return [SynchronizedNorms()] if trainer.get("sync_batchnorm") else []


@contextmanager
def misconfigured() -> Iterator[None]:
    """What Lightning says against a configuration, as a ValueError."""
    try:
        yield
    except MisconfigurationException as error:
        raise ValueError(f"trainer: {' '.join(str(error).split())}") from error


def check_input(model: nn.Module, data: pl.LightningDataModule) -> None:
    """`ValueError` where a network cannot be trained with inputs of the data's size, before any are made."""
    check, size = getattr(model, "check_input", None), getattr(data, "input_size", None)
    if check and size:
        check(*size)


class NonFinite(ValueError):
    """NaN or infinity in the loss or its gradient; the message names the step and the term."""


def joined(batches: Sequence[Batch]) -> dict[str, Any]:
    """Several batches as one: tensors and lists; what else a batch has is left out."""
    return {
        name: torch.cat([batch[name] for batch in batches])
        if isinstance(value, Tensor)
        else [item for batch in batches for item in batch[name]]
        for name, value in batches[0].items()
        if isinstance(value, Tensor | list)
    }


def _finite(value: Tensor) -> bool:
    return math.isfinite(float(value))


class StepValues(NamedTuple):
    """Values of a step that are on their way from the device."""

    step: int
    names: list[str]
    found: Tensor  # (micro-batches, names), on the device
    means: Tensor  # of the names over micro-batches and processes, the gradient's norm, the clock
    ready: torch.cuda.Event | None  # when means have come
    lr: float
    batches: list[Batch]


class UpsamplingModule(pl.LightningModule):
    """A network and its loss.

    A batch has "input" (B, n, 6), "target" (B, m, 6) and whatever else the loss reads. Logged are every loss term at
    every step (train/cd ... train/loss; means over the micro-batches of the step and over processes), the norm of the
    gradient, the learning rate, and the metrics of `CloudMetrics` over validation (val/...) and test (test/...) clouds,
    each in the frame of its patch.

    Args:
        model: maps patches (B, n, 6) to (B, ratio n, 6 or 3).
        loss: called with prediction, target and extra; gives terms by name and their weighted sum as "loss".
        optimizer: called with the parameters.
        scheduler: called with the optimizer, stepped after each step. What it calls `total_steps` or `T_max` is the
            number of steps of the whole training; where trainer.max_time alone ends that, OneCycleLR follows the time.
        metrics: of validation and test, those that are for patches.
    """

    model: Any  # a network: an nn.Module with outputs()

    def __init__(
        self,
        model: nn.Module,
        loss: nn.Module | None = None,
        optimizer: Callable[..., torch.optim.Optimizer] | None = None,
        scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None = None,
        metrics: Sequence[Metric] = METRICS,
    ) -> None:
        super().__init__()
        self.model = accelerate(model)
        self.loss = None if loss is None else accelerate(loss)
        self.optimizer, self.scheduler = optimizer, scheduler
        self.timed_steps = 0  # of a schedule that follows the time
        normals = bool(getattr(model, "predicts_normals", True))
        self.val_metrics, self.test_metrics = CloudMetrics(normals, metrics), CloudMetrics(normals, metrics)
        self.captured: Callable[[Batch], dict[str, Tensor]] | None = None  # `values` as a graph, see `captured_step`
        self.micro_batches: list[tuple[dict[str, Tensor], Batch]] = []  # of this step: values and batch
        self.unread: list[StepValues] = []
        self.last_loss: float | None = None  # that was read
        self.started_at, self.elapsed_s = time.monotonic(), 0.0  # elapsed_s is the same in all processes

    def forward(self, patch: Tensor) -> Tensor:
        return dense_patches(self.model, patch)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        values = (self.captured or self.values)(batch)
        self.micro_batches.append(({name: value.detach() for name, value in values.items()}, batch))
        loss: Tensor = values["loss"]
        return loss

    def values(self, batch: Batch) -> dict[str, Tensor]:
        """Every term of the loss and "loss", with gradient, and the largest coordinate as "prediction"."""
        assert self.loss is not None
        outputs = {name: value.float() for name, value in self.model.outputs(batch["input"]).items()}
        found = {"prediction": outputs["prediction"].detach().abs().amax()}
        try:
            # searches and small differences of coordinates want float32, whatever the network computed in
            with torch.autocast(self.device.type, enabled=False):
                terms = self.loss(outputs["prediction"], batch["target"], {**batch, **outputs})
        except Exception:  # a loss may break at NaN, with words about something else
            self.stop(self.global_step, found, [*self.micro_batches, (found, batch)])
            raise
        values: dict[str, Tensor] = found | terms
        return values

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Means of the step over micro-batches and processes, to be checked and logged. On a GPU they are read while it
        has the next step to do: waiting for each would leave it idle in between."""
        gradients = [p.grad for p in self.parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients) if gradients else torch.zeros((), device=self.device)
        names = list(self.micro_batches[0][0])
        found = torch.stack([values[name].to(norm) for values, _ in self.micro_batches for name in names])
        found = found.view(-1, len(names))
        # written on the device itself: a copy to it would wait for all that it has to do
        clock = torch.full_like(norm, time.monotonic() - self.started_at)
        means = self.trainer.strategy.reduce(torch.cat([found.mean(0), norm[None], clock[None]]), reduce_op="mean")
        self.unread.append(
            StepValues(
                self.global_step, names, found, means.to("cpu", non_blocking=True),
                torch.cuda.current_stream().record_event() if means.device.type == "cuda" else None,
                float(optimizer.param_groups[0]["lr"]), [batch for _, batch in self.micro_batches],
            )
        )  # fmt: skip
        self.micro_batches = []
        self.read_steps(keep=self.steps_behind)
        if self.last_loss is not None:
            # for bars and for stopping early; as a tensor of the CPU, since a number would be sent to the device and
            # back. Lightning takes a millisecond for each, so the others go to the loggers alone
            self.log("train/loss", torch.tensor(self.last_loss), logger=False)

    @property
    def steps_behind(self) -> int:
        """Steps whose values are not waited for before the next."""
        return int(self.device.type == "cuda")

    def read_steps(self, keep: int = 0) -> None:
        """Check and log the values of all steps but the last `keep`."""
        while len(self.unread) > keep:
            step = self.unread.pop(0)
            if step.ready is not None:
                step.ready.synchronize()
            *numbers, gradient_norm, self.elapsed_s = step.means.tolist()
            values = dict(zip(step.names, numbers, strict=True))
            # in mixed precision the scaler expects infinite gradients and skips their step
            checked = values if self.trainer.precision == "16-mixed" else values | {"gradient": gradient_norm}
            if not all(map(math.isfinite, checked.values())):
                rows = [dict(zip(step.names, row.unbind(), strict=True)) for row in step.found]
                self.stop(step.step, checked, list(zip(rows, step.batches, strict=True)))
            del values["prediction"]
            self.last_loss = values["loss"]
            logged = {f"train/{name}": value for name, value in values.items()}
            logged |= {"train/gradient_norm": gradient_norm, "train/lr": step.lr}
            for logger in self.loggers:
                logger.log_metrics(logged, step.step)

    def on_validation_start(self) -> None:
        self.read_steps()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """What led to the state that is saved is checked and written before it: a training that is killed afterwards
        loses no step's values, and a broken state is not kept."""
        self.read_steps()

    def on_train_end(self) -> None:
        self.read_steps()

    def stop(
        self,
        step: int,
        values: Mapping[str, float | Tensor],
        micro_batches: Sequence[tuple[Mapping[str, Tensor], Batch]],
    ) -> None:
        """End the training at NaN or infinity and keep the micro-batches that it comes from for inspection; do nothing
        where all values are finite.

        Args:
            step: whose values these are.
            values: means over micro-batches and processes.
            micro_batches: of the step, each with its own values.

        Raises:
            NonFinite: names the step, the terms and the file with the batch.
        """
        broken = [name for name, value in values.items() if not math.isfinite(float(value))]
        if not broken:
            return
        here = [(terms, batch) for terms, batch in micro_batches if not all(map(_finite, terms.values()))]
        kept = here or micro_batches  # of a gradient alone any of them may be the cause
        path = Path(self.trainer.default_root_dir) / f"nonfinite_step{step}_rank{self.global_rank}.pt"
        terms = {name: float(value) for name, value in (kept[0][0] if here else values).items()}
        write_checkpoint(path, {"step": step, "terms": terms, "batch": joined([batch for _, batch in kept])})
        first = next((name for name in broken if name != "loss"), broken[0])
        raise NonFinite(
            f"step {step}: {first} is {float(values[first])}; the batch is in {path};"
            " a lower optimizer.lr or trainer.gradient_clip_val=1 often cures it"
        )

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self.val_metrics.update(self(batch["input"]).float(), batch["target"])

    def on_validation_epoch_end(self) -> None:
        self.log_metrics("val", self.val_metrics)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        self.test_metrics.update(self(batch["input"]).float(), batch["target"])

    def on_test_epoch_end(self) -> None:
        self.log_metrics("test", self.test_metrics)

    def log_metrics(self, stage: str, metrics: CloudMetrics) -> None:
        """Log the metrics of all processes under val/ or test/, and start them anew."""
        # compute() has added up all processes; sync_dist then means over equal values
        self.log_dict({f"{stage}/{name}": value for name, value in metrics.compute().items()}, sync_dist=True)
        metrics.reset()

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """A step of the schedule; of a training that is as long as its time, to where the time is."""
        timer = self.timer()
        if self.timed_steps and timer:
            passed, left = timer.time_elapsed(), timer.time_remaining() or 0.0
            step = min(int(passed / (passed + left) * self.timed_steps), self.timed_steps - 1)
            scheduler.last_epoch = max(scheduler.last_epoch, step - 1)
        scheduler.step()

    def timer(self) -> Timer | None:
        """What ends the training after trainer.max_time; None without."""
        callbacks: list[pl.Callback] = self.trainer.callbacks  # type: ignore[attr-defined]
        return next((callback for callback in callbacks if isinstance(callback, Timer)), None)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        return self.scheduled(self.optimizer_of(self.parameters()))

    def optimizer_of(self, parameters: Iterator[nn.Parameter]) -> torch.optim.Optimizer:
        """The optimizer; on a GPU in one kernel for all parameters, where it has one and no scaler is in its way."""
        assert self.optimizer is not None
        known = inspect.signature(getattr(self.optimizer, "func", self.optimizer)).parameters
        given = getattr(self.optimizer, "keywords", {})
        fused = self.device.type == "cuda" and self.trainer.precision != "16-mixed" and "fused" in known.keys() - given
        return self.optimizer(parameters, **({"fused": True} if fused else {}))

    def scheduled(self, optimizer: torch.optim.Optimizer) -> OptimizerLRScheduler:
        """An optimizer, with its schedule where there is one."""
        if self.scheduler is None:
            return optimizer
        cls = getattr(self.scheduler, "func", self.scheduler)
        horizon = {"total_steps", "T_max"} & inspect.signature(cls).parameters.keys()
        steps = self.trainer.estimated_stepping_batches
        if horizon and not math.isfinite(steps):
            if self.timer() is None or cls is not OneCycleLR:
                raise ValueError(
                    "scheduler: needs to know the number of steps; give trainer.max_epochs or trainer.max_steps, or for"
                    " scheduler=onecycle trainer.max_time"
                )
            steps = self.timed_steps = TIMED_STEPS
        lengths: dict[str, Any] = {name: int(steps) for name in horizon}
        try:
            scheduler = self.scheduler(optimizer, **lengths)
        except ZeroDivisionError:  # OneCycleLR with one step of warm-up, the first: then without
            scheduler = self.scheduler(optimizer, **lengths, pct_start=0.5 / int(steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}
