"""Training of a generator beside its discriminator: two optimizers, stepped in turn."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from pnu.extras import needed
from pnu.losses import AdversarialLoss
from pnu.training.lightning_module import Batch, UpsamplingModule

with needed("training"):
    from lightning.pytorch.utilities.types import OptimizerLRScheduler


class AdversarialModule(UpsamplingModule):
    """As `UpsamplingModule`, with an `AdversarialLoss`: each batch is a step of the discriminator, then one of the
    generator. Steps are counted, logged and saved as in any training; train/discriminator is its loss.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.automatic_optimization = False

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        assert isinstance(self.loss, AdversarialLoss)
        discriminator = self.loss.discriminator
        judge: Any = self.optimizers(use_pl_optimizer=False)
        judge = judge[1]  # not through Lightning, which would count its steps as the training's
        generator: Any = self.optimizers()
        generator = generator[0]
        with torch.autocast(self.device.type, enabled=False):
            with torch.no_grad():
                prediction = self.model.outputs(batch["input"])["prediction"].float()
            verdict = self.loss.verdict(prediction, batch["target"])
        self.manual_backward(verdict)
        for group in judge.param_groups:
            group["lr"] = self.loss.discriminator_lr * generator.param_groups[0]["lr"]
        judge.step()
        judge.zero_grad()
        with frozen(discriminator):
            loss = super().training_step(batch, batch_idx)
            self.micro_batches[-1][0]["discriminator"] = verdict.detach()
            self.manual_backward(loss)
        generator.step()
        generator.zero_grad()
        scheduler: Any = self.lr_schedulers()
        if scheduler is not None:
            scheduler.step()
        return loss.detach()

    def on_fit_start(self) -> None:
        """ValueError for what two optimizers cannot have."""
        if self.trainer.world_size > 1:
            raise ValueError("trainer.devices: a generator and its discriminator train in one process; leave devices=1")

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """The generator's optimizer and schedule, and the discriminator's optimizer, whose rate follows."""
        assert isinstance(self.loss, AdversarialLoss)
        found: Any = self.scheduled(self.optimizer_of(self.model.parameters()))
        schedulers = [found["lr_scheduler"]] if isinstance(found, dict) else []
        first = found["optimizer"] if isinstance(found, dict) else found
        return [first, self.optimizer_of(self.loss.discriminator.parameters())], schedulers


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """A module whose parameters get no gradients for a while."""
    module.requires_grad_(False)
    try:
        yield
    finally:
        module.requires_grad_(True)


def check_manual(options: Mapping[str, Any]) -> None:
    """ValueError for options of the trainer that do not go with steps of one's own."""
    for name, none in (("gradient_clip_val", (None, 0)), ("accumulate_grad_batches", (None, 1))):
        if options.get(name) not in none:
            raise ValueError(f"trainer.{name}={options[name]}: not with loss=adversarial, which steps two optimizers")
