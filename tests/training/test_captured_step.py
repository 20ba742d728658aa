"""A step as a CUDA graph, with a stand-in for the capture where there is no GPU: what goes in, what comes out."""

import copy
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from torch import Tensor, nn

from pnu.losses import AdversarialLoss, CompoundLoss
from pnu.training.adversarial_module import AdversarialModule
from pnu.training.captured_step import CapturedStep, CudaGraph
from pnu.training.lightning_module import TRAINER_OPTIONS, UpsamplingModule, quieten

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


class Normed(nn.Module):
    """Four points around each, by a layer with batch norm."""

    ratio = 4

    def __init__(self) -> None:
        super().__init__()
        self.layer, self.norm = nn.Linear(6, 24), nn.BatchNorm1d(24)

    def outputs(self, patch: Tensor) -> dict[str, Tensor]:
        offsets = self.norm(self.layer(patch).flatten(0, 1)).view(*patch.shape[:2], 4, 6)
        return {"prediction": (patch[:, :, None] + 0.1 * offsets).flatten(1, 2)}


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> UpsamplingModule:
    def capture(step: nn.Module, tensors: tuple[Tensor, ...], **_: Any) -> Callable[..., tuple[Tensor, ...]]:
        for _ in range(3):
            step(*tensors)
        return step

    if DEVICE == "cpu":
        monkeypatch.setattr(torch.cuda, "make_graphed_callables", capture)
    torch.manual_seed(0)
    return UpsamplingModule(Normed(), CompoundLoss(k=3), functools.partial(torch.optim.Adam)).to(DEVICE).train()


def batch(points: int = 32, seed: int = 0) -> dict[str, Any]:
    cloud = torch.randn(2, 4 * points, 6, generator=torch.Generator().manual_seed(seed)).to(DEVICE)
    return {"input": cloud[:, :points], "target": cloud, "index": torch.arange(2, device=DEVICE), "shape": ["a", "b"]}


def test_a_captured_step_is_the_step(module: UpsamplingModule) -> None:
    """Same terms, gradients and statistics; what capturing did to the statistics is undone."""
    other = copy.deepcopy(module)
    captured = CapturedStep(module, batch())
    for seed in (1, 2):
        expected, found = other.values(batch(seed=seed)), captured(batch(seed=seed))
        assert set(found) == set(expected)
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value)
        assert [name for name, value in found.items() if value.requires_grad] == ["loss"]
        for step, values in ((other, expected), (module, found)):
            step.zero_grad()
            values["loss"].backward()
        for one, two in zip(other.parameters(), module.parameters(), strict=True):
            torch.testing.assert_close(two.grad, one.grad)
    for one, two in zip(other.buffers(), module.buffers(), strict=True):
        torch.testing.assert_close(two, one)


def test_batches_of_another_shape_are_not_replayed(module: UpsamplingModule, monkeypatch: pytest.MonkeyPatch) -> None:
    captured = CapturedStep(module, batch())
    monkeypatch.setattr(captured, "replay", None)
    assert captured(batch(points=16))["loss"].isfinite()


@pytest.mark.skipif(DEVICE == "cuda", reason="there is a GPU here")
def test_it_needs_a_gpu(module: UpsamplingModule, tmp_path: Path) -> None:
    quieten()
    trainer = pl.Trainer(accelerator="cpu", default_root_dir=tmp_path, logger=False, **TRAINER_OPTIONS)
    with pytest.raises(ValueError, match=r"callbacks\.cuda_graph: needs trainer\.accelerator=gpu"):
        CudaGraph().on_fit_start(trainer, module)


def test_a_generator_and_its_discriminator_are_not_captured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CudaGraph, "check", lambda *_: None)
    with pytest.raises(ValueError, match="a generator and its discriminator cannot be captured"):
        CudaGraph().on_fit_start(None, AdversarialModule(Normed(), AdversarialLoss()))  # type: ignore[arg-type]
