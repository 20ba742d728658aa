"""Training with a discriminator: what is stepped, counted and logged, and that it goes on bit for bit."""

import functools
from pathlib import Path
from typing import Any

import pytest
import torch

from pnu.commands.train import module_of
from pnu.losses import AdversarialLoss, CompoundLoss
from pnu.training.adversarial_module import AdversarialModule
from pnu.training.lightning_module import UpsamplingModule
from tests.training.test_lit import Record, Spread, loader, trainer


def module(**options: Any) -> AdversarialModule:
    torch.manual_seed(0)
    adam = functools.partial(torch.optim.Adam, lr=1e-2)
    loss = AdversarialLoss("chamfer", seeds=4)
    return AdversarialModule(Spread(3), loss, **{"optimizer": adam, **options})


def test_both_are_stepped_once_for_each_batch(tmp_path: Path) -> None:
    record, lit = Record(), module(scheduler=functools.partial(torch.optim.lr_scheduler.StepLR, step_size=1, gamma=0.5))
    before = {name: value.clone() for name, value in lit.state_dict().items()}
    fit = trainer(tmp_path, record)
    fit.fit(lit, loader(), loader(2))
    assert fit.global_step == 3
    for name in ("adversarial", "uniform", "repulsion", "cd", "loss", "discriminator", "lr", "gradient_norm"):
        assert record.steps(f"train/{name}") == [0, 1, 2], name
    assert record.values("train/lr") == pytest.approx([1e-2, 5e-3, 2.5e-3])
    assert record.values("val/chamfer_sq")
    moved = {name for name, value in lit.state_dict().items() if not torch.equal(value, before[name])}
    assert {"model.offsets.weight", "loss.discriminator.judge.1.weight"} <= moved
    optimizers: Any = lit.optimizers(use_pl_optimizer=False)
    assert [o.param_groups[0]["lr"] for o in optimizers] == pytest.approx([1.25e-3, 2.5e-4])
    assert all(p.requires_grad for p in lit.loss.discriminator.parameters())


def test_goes_on_bit_for_bit(tmp_path: Path) -> None:
    whole = module()
    trainer(tmp_path, max_steps=4, max_epochs=-1).fit(whole, loader(4), loader(2))
    first = trainer(tmp_path, max_steps=2, max_epochs=-1)
    first.fit(module(), loader(4), loader(2))
    first.save_checkpoint(tmp_path / "last.ckpt")
    second = module()
    torch.nn.init.zeros_(second.model.offsets.weight)
    trainer(tmp_path, max_steps=4, max_epochs=-1).fit(
        second, loader(4), loader(2), ckpt_path=tmp_path / "last.ckpt", weights_only=True
    )
    for name, value in whole.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name


def test_what_does_not_go_with_it() -> None:
    assert module_of(CompoundLoss(), {"gradient_clip_val": 1.0}) is UpsamplingModule
    assert module_of(AdversarialLoss(), {"gradient_clip_val": None, "accumulate_grad_batches": 1}) is AdversarialModule
    with pytest.raises(ValueError, match=r"trainer.gradient_clip_val=1\.0: not with loss=adversarial"):
        module_of(AdversarialLoss(), {"gradient_clip_val": 1.0})
