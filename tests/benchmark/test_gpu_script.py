"""bench/gpu.py, which is for a GPU, tried without one."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY


@pytest.mark.slow
def test_every_part_runs_small_on_the_cpu(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bench.gpu", "--device", "cpu", "--small", "--minutes", "10", "--folder"]
    done = subprocess.run(
        [*command, str(tmp_path)], cwd=REPOSITORY, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "gpu.md").read_text(encoding="utf-8")
    assert "100.00% of the indices the same" in text
    for words in (
        "training step, bfloat16",
        "upsample 400 -> 1600, surface",
        "exit code 0",
        "16 nearest",
        "surface model, 2 crops",
    ):
        assert words in text
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").exists()


@pytest.mark.parametrize(
    ("arguments", "said"), [(["nonsense"], "no such part: nonsense"), (["--device", "cuda"], "no GPU that torch sees")]
)
def test_what_cannot_be_run_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    from bench import gpu

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu", *arguments])
    with pytest.raises(SystemExit) as stopped:
        gpu.main()
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err
