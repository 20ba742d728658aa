"""A metric from a package of the user's own, declared once: training, TensorBoard, report, evaluate and compare."""

import csv
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pnu import metrics
from pnu.commands.compare import main as compare
from pnu.commands.evaluate import main as evaluate
from pnu.commands.report import main as report
from pnu.commands.train import main as train
from pnu.config.instantiate import find_metric
from pnu.io import read_json
from tests.refusals import refused
from tests.training.test_train import patch_file  # noqa: F401  a fixture

PACKAGE = """
from pnu.metrics import Metric, Pair, Shown


class Reach(Metric):
    shown = Shown("reach", "reach, x 1e3 of the radius", "reach", 1e3, "length", ".1f", better="higher")
    needs = ()

    def __call__(self, pair: Pair):
        return pair.prediction[..., :3].norm(dim=-1).amax(1)


class Silent(Metric):
    pass


class Chamfer(Reach):
    shown = Reach.shown._replace(name="chamfer_sq")


class Total(Reach):
    def __call__(self, pair: Pair):
        return pair.prediction.sum(-1)
"""
OWN = ["metrics=[mylab.Reach]", "allow=[mylab]", "quiet=true"]
SMALL = ["data.kinds=[organic]", "shapes=[pear]", "part=all", "kinds=[uniform]", "points=300", "truth_points=600"]


@pytest.fixture(scope="module", autouse=True)
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("own")
    (folder / "mylab.py").write_text(PACKAGE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        yield folder
    sys.modules.pop("mylab", None)


@pytest.mark.slow
def test_training_tensorboard_and_report_show_it(patch_file: Path, place: Path) -> None:  # noqa: F811
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(
        ["-m", "data=patches", f"data.path={patch_file}", "data.batch_size=5", "data.input_points=64", *OWN]
        + ["data.target_points=256", "trainer.accelerator=cpu", "trainer.max_epochs=1", "callbacks.pictures.clouds=0"]
        + ["trainer.check_val_every_n_epoch=null", "trainer.val_check_interval=2", "sweep=s", "seed=0,1"]
        + ["model.local_features=false"]
    )
    report(["quiet=true"])
    sweep = place / "outputs" / "sweeps" / "s"
    runs = [path.parent for path in sorted(sweep.glob("*/run.json"))]
    assert len(runs) == 2
    for run in runs:
        found = read_json(run / "metrics.json")
        assert found["validation"]["reach"] > 0
        assert found["test"]["reach"] > 0
        events = EventAccumulator(str(run / "tensorboard")).Reload()
        assert {"val/reach", "test/reach"} <= set(events.Tags()["scalars"])
    mean = sum(read_json(run / "metrics.json")["test"]["reach"] for run in runs) / 2
    text = (sweep / "report" / "report.md").read_text()
    assert "| reach, x 1e3 of the radius |" in text
    assert f"| {1e3 * mean:.1f} ± " in text
    assert "val/reach" in (sweep / "report" / "curves.svg").read_text()
    with (sweep / "report" / "summary.csv").open() as file:
        assert "reach" in {row["metric"] for row in csv.DictReader(file)}


def test_a_report_of_a_metric_whose_package_is_gone(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes what the run's record says, and a name alone where that says nothing."""
    shown = metrics.Shown.read("reach", {"title": "reach x 1e3", "factor": 1000, "form": 7, "better": "higher"})
    assert shown == metrics.Shown("reach", "reach x 1e3", factor=1000.0, better="higher")
    assert metrics.Shown.read("other", None) == metrics.Shown("other", "other")


@pytest.mark.slow
def test_evaluate_and_compare_show_it(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate(["method=midpoint", *SMALL, *OWN[:2], "ratio=2", "output=found"])
    assert "reach" in capsys.readouterr().out
    rows = {row["method"]: row["reach"] for row in read_json(place / "found" / "metrics.json")["rows"]}
    assert set(rows) == {"midpoint", "floor", "input"}
    assert rows["input"] == pytest.approx(1, abs=0.05)
    compare(["methods=[midpoint]", *SMALL, *OWN, "ratio=2", "surfaces=[]", "size=64", "output=page"])
    page = (place / "page" / "index.html").read_text()
    assert '<th scope="col">reach</th>' in page
    found = {row["method"]: row["reach"] for row in read_json(place / "page" / "metrics.json")["rows"]}
    assert found == rows
    assert f">{1e3 * rows['midpoint']:.1f}<" in page


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["metrics=[mylab.Reach]"], "_target_=mylab.Reach: expected a class of pnu.metrics"),
        (
            ["metrics=[mylab.Silent]", "allow=[mylab]"],
            "metrics=mylab.Silent: expected a subclass of pnu.metrics.Metric",
        ),
        (["metrics=[mylab.Chamfer]", "allow=[mylab]"], "metrics=mylab.Chamfer: the name chamfer_sq is taken"),
        (["metrics=[pnu.metrics.ChamferDistance]"], "expected a subclass of pnu.metrics.Metric"),
        (["metrics=[mylab.Total]", "allow=[mylab]"], "reach: expected a value for each cloud, found "),
    ],
)
def test_what_is_no_metric_is_refused(arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, evaluate, ["method=midpoint", *SMALL, *arguments, "output=none", "quiet=true"])
    assert text in line


def test_a_package_that_is_not_allowed_is_not_even_imported(place: Path) -> None:
    (place / "forbidden.py").write_text("raise RuntimeError('ran')")
    with pytest.raises(ValueError, match="expected a class of pnu.metrics"):
        find_metric("forbidden.Metric", allow=["mylab"])


def test_every_metric_says_how_it_is_shown() -> None:
    names = [metric.shown.name for metric in metrics.METRICS]
    assert len(set(names)) == len(names)
    for metric in metrics.METRICS:
        assert metric.shown.title
        assert metric.shown.better in ("lower", "higher")
        assert set(metric.needs) <= {"target", "mesh", "normals"}
        format(metric.shown.factor * 0.5, metric.shown.form)
