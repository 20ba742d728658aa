"""A training step as a CUDA graph: its thousand kernels are started at once instead of one by one."""

from typing import Any

import torch
from torch import Tensor, nn

from pnu.extras import needed
from pnu.training.adversarial_module import AdversarialModule
from pnu.training.lightning_module import Batch, UpsamplingModule

with needed("training"):
    import lightning.pytorch as pl


class CudaGraph(pl.Callback):
    """Captures network, loss and gradient at the first step and replays them from then on, for batches of its shape.

    Values and gradients are those of a step that is not captured. The loss must not decide by values: that of pnu does
    not. ValueError where the training has no GPU, several, another precision than 32-true, or several batches a step.

    Args:
        tf32: matrix products in TF32, ten bits of mantissa instead of 23
    """

    def __init__(self, tf32: bool = False) -> None:
        self.tf32 = tf32
        self.precision = ""

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self.check(trainer)
        if isinstance(module, AdversarialModule):
            raise ValueError("callbacks.cuda_graph: a generator and its discriminator cannot be captured; leave it out")
        self.precision = torch.get_float32_matmul_precision()
        if self.tf32:
            torch.set_float32_matmul_precision("high")

    def check(self, trainer: pl.Trainer) -> None:
        """ValueError for a training whose steps cannot be captured."""
        for key, fits in (
            ("accelerator=gpu", trainer.strategy.root_device.type == "cuda"),
            ("devices=1", trainer.world_size == 1),
            ("precision=32-true", trainer.precision == "32-true"),
            ("accumulate_grad_batches=1", trainer.accumulate_grad_batches == 1),
        ):
            if not fits:
                raise ValueError(f"callbacks.cuda_graph: needs trainer.{key}")

    def on_train_batch_start(self, trainer: pl.Trainer, module: pl.LightningModule, batch: Any, batch_idx: int) -> None:
        assert isinstance(module, UpsamplingModule)
        if module.captured is None:
            module.captured = CapturedStep(module, batch)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self.release(module)

    def on_exception(self, trainer: pl.Trainer, module: pl.LightningModule, exception: BaseException) -> None:
        self.release(module)

    def release(self, module: pl.LightningModule) -> None:
        """Free the graph and give products their precision back."""
        assert isinstance(module, UpsamplingModule)
        module.captured = None
        if self.precision:
            torch.set_float32_matmul_precision(self.precision)


class CapturedStep:
    """`UpsamplingModule.values` of batches of one shape, replayed; of another shape as ever."""

    def __init__(self, module: UpsamplingModule, batch: Batch) -> None:
        self.module = module
        self.shapes = shapes(batch)
        step = TensorStep(module, list(self.shapes))
        kept = {name: buffer.clone() for name, buffer in step.named_buffers()}
        tensors = tuple(batch[name].clone() for name in self.shapes)
        self.replay: Any = torch.cuda.make_graphed_callables(step, tensors, allow_unused_input=True)
        for name, buffer in step.named_buffers():  # batch norm has counted the trial runs
            buffer.copy_(kept[name])
        self.names = step.found

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """The terms; only "loss" has a gradient. They last until the next call."""
        if shapes(batch) != self.shapes:
            return self.module.values(batch)
        loss, *others = self.replay(*(batch[name] for name in self.shapes))
        return {"loss": loss, **dict(zip(self.names, others, strict=True))}


class TensorStep(nn.Module):
    """Network and loss as a function from tensors to tensors, which is what can be captured.

    Args:
        module: whose network and loss.
        names: of the tensors in a batch.
    """

    def __init__(self, module: UpsamplingModule, names: list[str]) -> None:
        super().__init__()
        self.network, self.loss, self.values, self.names = module.model, module.loss, module.values, names
        self.found: list[str] = []  # the other terms' names

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """The loss, and the other terms without gradient."""
        values = self.values(dict(zip(self.names, tensors, strict=True)))
        loss = values.pop("loss")
        self.found = list(values)
        return loss, *(value.detach() for value in values.values())


def shapes(batch: Batch) -> dict[str, torch.Size]:
    """Those of a batch's tensors."""
    return {name: value.shape for name, value in batch.items() if isinstance(value, Tensor)}
