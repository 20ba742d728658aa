"""`python -m bench` beside the committed ratios, with made-up rows."""

import json
import sys
from pathlib import Path

import pytest
import torch

from bench import __main__ as bench
from bench.timing import Row, entries, slower


def row(ours: float, plain: float = 10.0, peer: float = 2.0) -> Row:
    return Row("search", {"pnu": ours, "plain": plain, "peer": peer})


def test_what_takes_a_tenth_longer_beside_an_alternative_is_slower() -> None:
    committed = entries([row(1.0)], "then")
    assert committed == {
        "search, beside plain": {"ratio": 10.0, "made": "then"},
        "search, beside peer": {"ratio": 2.0, "made": "then"},
    }
    assert slower([row(1.09), row(0.5)], committed) == {}
    assert slower([row(3.0, plain=30.0, peer=6.0)], committed) == {}, "a slower machine is none"
    found = slower([row(1.2, plain=12.0), Row("new", {"pnu": 9.0, "plain": 1.0})], committed)
    assert found == {"search, beside peer": pytest.approx(1.2)}


@pytest.fixture
def committed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "committed.json"
    monkeypatch.setattr(bench, "COMMITTED", path)
    return path


def run(monkeypatch: pytest.MonkeyPatch, folder: Path, seconds: list[float], *options: str) -> int:
    """The exit code, where our search takes so many seconds each time it is measured."""
    left = iter(seconds)
    monkeypatch.setattr(bench, "PARTS", {"ops": lambda: [row(next(left))]})
    threads = str(torch.get_num_threads())
    monkeypatch.setattr(sys, "argv", ["bench", "ops", "--threads", threads, "--folder", str(folder), *options])
    try:
        bench.main()
    except SystemExit as stopped:
        return int(stopped.code or 0)
    finally:
        assert list(left) == []
    return 0


def test_slower_twice_is_said_and_fails(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, committed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    committed.write_text(json.dumps({"other": {"ratio": 3.0, "made": "once"}}))
    assert run(monkeypatch, tmp_path, [1.0]) == 0, "nothing to compare with"
    assert run(monkeypatch, tmp_path, [0.8, 1.0], "--commit") == 0
    assert list(json.loads(committed.read_text())) == ["other", "search, beside plain", "search, beside peer"]
    assert run(monkeypatch, tmp_path, [1.05]) == 0
    assert run(monkeypatch, tmp_path, [1.3, 1.0]) == 0, "something else was slow"
    assert "Slower than committed by more than 10%" not in capsys.readouterr().out
    assert run(monkeypatch, tmp_path, [1.3, 1.25]) == 1
    said = "Slower than committed by more than 10%:\n\n- search, beside plain: 1.25 times as long as committed ("
    assert said in capsys.readouterr().out
    assert said in (tmp_path / "ops.md").read_text(encoding="utf-8")
    assert run(monkeypatch, tmp_path, [1.3, 1.2], "--commit") == 0
    assert run(monkeypatch, tmp_path, [1.3]) == 0
