"""Fixtures shared by all tests."""

import os
import signal
from pathlib import Path

import pytest
import torch

from pnu.kernels import compilation

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # before anything imports triton: kernels then run on the CPU

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts what runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)  # else no child of a test could be interrupted

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference material beside the repository; tests that need it skip where it is missing."""
    folder = REPOSITORY.parent / "shared"
    if not (folder / "reference").is_dir():
        pytest.skip("reference material (../shared) is not here")
    return folder


@pytest.fixture
def untraced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands run without coverage, which slows them down, writes a file, and which Hydra takes for a debugger."""
    monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)
    monkeypatch.setattr("hydra._internal.utils.is_under_debugger", lambda: False)


@pytest.fixture(scope="session")
def compiled() -> None:
    """Kernels are compiled, as `make setup` does it; tests of them skip where numba is missing."""
    if not compilation.compile_all():
        pytest.skip("kernels cannot be compiled here")
