"""The median stopping rule, on sweep folders made by hand, and in a search."""

import json
import math
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from pnu.commands.train import main
from pnu.io import read_json, write_json
from pnu.training.callbacks import Pruning
from pnu.training.pruning import behind, keep_values, read_values, why_hopeless
from pnu.training.run_folder import RunFolder
from tests.training.test_sweep import records, small
from tests.training.test_train import patch_file, resume  # noqa: F401  a fixture

BOTH = ("chamfer_sq", "normal_deg")


def job(sweep: Path, name: str, values: dict[int, tuple[float, float]], status: str = "finished") -> RunFolder:
    """A run of a sweep: at each step its Chamfer distance and normal error."""
    run = RunFolder(sweep / name)
    run.path.mkdir(parents=True)
    write_json(run.record_path, {"status": status, "job": 0})
    for step, pair in values.items():
        keep_values(run, step, dict(zip(BOTH, pair, strict=True)))
    return run


def five(sweep: Path) -> None:
    """At step 10 medians of 3 and 30, at step 20, where three are left, of 2 and 20."""
    for name, first, second in [
        *(("a", (1, 50), (1, 40)), ("b", (2, 10), (2, 10)), ("c", (3, 30), (3, 20))),
        *(("d", (4, 20), None), ("e", (5, 40), None)),
    ]:
        job(sweep, name, {10: first} | ({20: second} if second else {}), "finished" if second else "pruned")


@pytest.mark.parametrize(
    ("pair", "pruned"),
    [((3.1, 31), True), ((3, 31), False), ((3.1, 30), False), ((9, 5), False), ((math.nan, math.nan), True)],
)
def test_worse_than_the_median_in_all_objectives(pair: tuple[float, float], pruned: bool, tmp_path: Path) -> None:
    five(tmp_path)
    run = job(tmp_path, "own", {10: pair}, "running")
    reason = why_hopeless(run, 10, BOTH, startup=5)
    assert bool(reason) is pruned
    if pair == (3.1, 31):
        assert reason == (
            "step 10: chamfer_sq 3.1 and normal_deg 31, worse than the medians 3 and 30 of 5 other runs there"
        )
    assert why_hopeless(run, 10, BOTH, startup=5) == reason
    assert why_hopeless(run, 10, BOTH, startup=6) == ""


def test_the_best_so_far_is_compared_with_those_at_the_same_step(tmp_path: Path) -> None:
    five(tmp_path)
    assert why_hopeless(job(tmp_path, "good once", {10: (1, 60), 20: (9, 15)}), 20, BOTH, startup=3) == ""
    run = job(tmp_path, "own", {10: (4, 21), 20: (5, 35), 30: (0, 0)})  # what a restart will do again does not count
    assert why_hopeless(run, 20, BOTH, startup=4).startswith("step 20: chamfer_sq 4 and normal_deg 21, worse than")
    assert why_hopeless(run, 20, BOTH, startup=5) == "", "four others have got that far"
    assert why_hopeless(run, 15, BOTH, startup=1) == "", "nobody validated there"


def test_one_objective(tmp_path: Path) -> None:
    five(tmp_path)
    reason = why_hopeless(job(tmp_path, "own", {10: (3.5, 0)}), 10, BOTH[:1], startup=5)
    assert reason == "step 10: chamfer_sq 3.5, worse than the median 3 of 5 other runs there"


def test_of_two_objectives_some_other_run_is_better_in_both() -> None:
    """Also of an even number, where those better in one and those better in the other could be different halves."""
    others = [{"a": 1.0, "b": 4.0}, {"a": 2.0, "b": 3.0}, {"a": 3.0, "b": 2.0}, {"a": 4.0, "b": 1.0}]
    assert behind({"a": 2.9, "b": 2.9}, others) == {}
    assert behind({"a": 3.1, "b": 3.1}, others) == {"a": 3.0, "b": 3.0}


def test_runs_without_values_and_files_being_written_are_left_out(tmp_path: Path) -> None:
    five(tmp_path)
    job(tmp_path, "no values yet", {}, "running")
    job(tmp_path, "another objective", {10: (0, 0)}).validations.write_text('{"10": {"p2f": 1}}')
    job(tmp_path, "not a number", {10: (math.nan, 0)})
    (tmp_path / "a" / ".validations.json.tmp").write_text("{")
    assert why_hopeless(job(tmp_path, "own", {10: (9, 99)}), 10, BOTH, startup=5).endswith("of 5 other runs there")


def callback(run: RunFolder, **options: Any) -> Any:
    return Pruning(run, BOTH, **options)


def validated(pruning: Any, step: int, pair: tuple[float, float], last: bool = False) -> bool:
    """Whether the training stops after a validation."""
    loop = SimpleNamespace(epoch_loop=SimpleNamespace(batch_progress=SimpleNamespace(is_last_batch=False)))
    values = {f"val/{name}": value for name, value in zip(BOTH, pair, strict=True)}
    trainer = SimpleNamespace(
        **{"state": SimpleNamespace(fn="fit"), "sanity_checking": False, "should_stop": False, "fit_loop": loop},
        **{"global_step": step, "max_steps": step if last else 1000, "current_epoch": 0, "max_epochs": -1},
        callback_metrics=values,
    )
    pruning.on_validation_end(trainer, None)
    return bool(trainer.should_stop)


def test_the_callback_keeps_values_and_stops(tmp_path: Path) -> None:
    five(tmp_path)
    run = job(tmp_path, "own", {})
    assert not validated(callback(run), 10, (9, 99)), "not a job of a sweep"
    assert read_values(run) == {}
    run.facts = {"job": 5}
    assert not validated(callback(run), 10, (2, 99))
    assert read_values(run) == {"10": {"chamfer_sq": 2.0, "normal_deg": 99.0}}
    assert not validated(callback(run, warmup=11), 10, (9, 99))
    assert not validated(callback(run, startup=6), 10, (9, 99))
    assert not validated(callback(run), 10, (9, 99), last=True), "it ends there anyway"
    assert run.pruned == ""
    assert validated(callback(run), 10, (9, 99))
    assert run.pruned.startswith("step 10: chamfer_sq 9 and normal_deg 99, worse than the medians 3 and 30")


@pytest.mark.parametrize(
    ("objective", "options", "message"),
    [
        (BOTH, {"startup": 0}, "callbacks.pruning: expected startup >= 1 and warmup >= 0"),
        (None, {}, "callbacks.pruning: compares validation metrics; name them, as objective=[chamfer_sq]"),
    ],
)
def test_refused(objective: Any, options: dict[str, int], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        Pruning(RunFolder(tmp_path), objective, **options)


def test_a_metric_that_is_not_measured_is_named(tmp_path: Path) -> None:
    run = job(tmp_path, "own", {})
    run.facts = {"job": 0}
    with pytest.raises(ValueError, match=re.escape("objective=['cd']: expected some of chamfer_sq, normal_deg")):
        validated(Pruning(run, ["cd"]), 10, (1, 1))


@pytest.mark.slow
@pytest.mark.usefixtures("untraced")
def test_a_sweep_prunes_skips_reports_and_goes_on(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Beside two runs that are perfect, made by hand, the first job is the third, the second one is judged."""
    monkeypatch.chdir(tmp_path)
    sweep = tmp_path / "outputs" / "sweeps" / "s"
    for name in "ab":
        os.utime(job(sweep, name, {1: (0, 0), 2: (0, 0)}).record_path, (0, 0))
    line = [one for one in small(patch_file) if one != "quiet=true"]
    line += ["sweep=s", "objective=[chamfer_sq,normal_deg]", "callbacks=[default,pruning]"]
    line += ["callbacks.pruning.startup=3", "seed=0,1"]
    main(line)
    out = capsys.readouterr().out
    assert "(3 finished, 1 pruned)" in out
    (name,) = (name for name, record in records(sweep).items() if record["status"] == "pruned")
    record = records(sweep)[name]
    assert record["pruned"].startswith("step 1: chamfer_sq ")
    assert f"job 1 pruned: {sweep / name}: {record['pruned']}" in out
    found = read_json(sweep / name / "metrics.json")
    assert "test" not in found
    assert found["validation"]["step"] == 1
    before = records(sweep)
    main(line)
    out = capsys.readouterr().out
    assert (out.count("has finished before, skipped"), out.count("was pruned before, skipped")) == (1, 1)
    assert records(sweep) == before

    from pnu.commands.report import main as report

    report([f"sweep={sweep}"])
    assert "1 settings, 1 finished runs, 1 pruned, 2 unfinished" in capsys.readouterr().out
    assert f"- {name}: {record['pruned']}" in (sweep / "report" / "report.md").read_text()

    resume(sweep / name)  # by itself it goes on to its end
    after = json.loads((sweep / name / "run.json").read_text())
    assert after["status"] == "finished"
    assert "test" in read_json(sweep / name / "metrics.json")


@pytest.mark.slow
def test_the_search_for_weights_prunes(
    patch_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    monkeypatch.chdir(tmp_path)
    main([*small(patch_file), "hparams_search=loss_weights", "sweep=s", "hydra.sweeper.n_trials=1"])
    (run,) = (tmp_path / "outputs" / "sweeps" / "s").glob("*/run.json")
    config = yaml.safe_load((run.parent / "config.yaml").read_text())
    assert config["callbacks"]["pruning"]["startup"] == 5
    assert list(read_json(run.parent / "validations.json")) == ["1", "2"]
