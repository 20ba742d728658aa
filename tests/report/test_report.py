"""The report of a sweep: its numbers by hand, its files, its page in a browser; and what TensorBoard answers."""

import csv
import json
import re
import shutil
import socket
import statistics
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from PIL import Image

from pnu.commands.report import main
from pnu.commands.train import main as train
from pnu.metrics import METRICS
from pnu.report import sweep_report
from pnu.report.comparison_tables import tables
from pnu.report.offline_page import write_page
from pnu.report.plots import front, logarithmic, mean_curve, plots
from pnu.report.search_front import search_plots, trials, unbeaten
from pnu.report.sweep_report import differing, write_report
from pnu.report.sweep_results import Setting, collect, effects
from tests.chromium import CHROMIUM, needs_browser
from tests.training.test_train import patch_file  # noqa: F401  a fixture

Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """make(job, setting, seed, chamfer_sq, **loss): a run folder with made-up results; chamfer_sq None: it failed."""

    def run(job: int, setting: str | None, seed: int, value: float | None, **loss: float) -> Path:
        folder = tmp_path / "sweep" / f"{job}"
        folder.mkdir(parents=True)
        config = {"seed": seed, "data": {"seed": seed, "workers": job}, "loss": {"w1": 1.0, "w3": 0.05} | loss}
        (folder / "config.yaml").write_text(yaml.safe_dump(config | {"quiet": bool(job % 2)}))
        status = {"status": "finished"} if value is not None else {"status": "failed", "error": "NonFinite: step 3"}
        record = {"job": job, "setting": setting, "wall_s": 1.0, "git": "abc", **status}
        (folder / "run.json").write_text(json.dumps(record | {"command": "python -m pnu.train -m ablation=x"}))
        if value is not None:
            (folder / "metrics.json").write_text(json.dumps({"test": {"chamfer_sq": value, "normal_deg": 90 * value}}))
        return tmp_path / "sweep"

    return run


def three_settings(make: Make) -> Path:
    """Jobs out of order: the baseline 0.1, 0.2, 0.3; clearly worse 1.0, 1.2; within the spread 0.15, 0.35."""
    for job, setting, seed, value, w3 in [
        *((4, "a/worse", 1, 1.2, 0.5), (0, "default", 0, 0.1, 0.05), (1, "default", 1, 0.2, 0.05)),
        *((2, "default", 2, 0.3, 0.05), (3, "a/worse", 0, 1.0, 0.5), (5, "a/same", 0, 0.15, 0.0)),
        *((6, "a/same", 1, 0.35, 0.0), (7, "a/broken", 0, None, 9.0)),
    ]:
        folder = make(job, setting, seed, value, w3=w3)
    return folder


def test_mean_spread_and_difference_by_hand(make: Make) -> None:
    study = collect(three_settings(make))
    assert [setting.name for setting in study.settings] == ["default", "worse", "same"]
    assert [run.seed for run in study.settings[0].runs] == [0, 1, 2]
    base, worse, same = (study.summary(setting, "chamfer_sq") for setting in study.settings)
    assert base is not None
    assert worse is not None
    assert same is not None
    assert (base.mean, base.difference, base.exceeds) == (pytest.approx(0.2), None, None)
    assert base.spread == pytest.approx(0.1)
    assert (worse.mean, worse.difference, worse.exceeds) == (pytest.approx(1.1), pytest.approx(0.9), True)
    assert worse.spread == pytest.approx(statistics.stdev([1.0, 1.2]))
    # 0.05 apart; two runs differ by sqrt(0.1^2 + 0.1414^2) = 0.173
    assert (same.difference, same.exceeds) == (pytest.approx(0.05), False)
    assert [run.record["error"] for run in study.unfinished] == ["NonFinite: step 3"]


def test_a_step_done_twice_counts_once(make: Make) -> None:
    from torch.utils.tensorboard import SummaryWriter

    folder = make(0, "default", 0, 0.1)
    for start in (0, 2):  # two starts, the second of which does steps 2 to 4 again
        with SummaryWriter(str(folder / "0" / "tensorboard"), filename_suffix=f".{start}") as writer:
            for step in range(start, start + 5):
                writer.add_scalar("val/normal_deg", 10 * start + step, step)
        time.sleep(1.1)  # the name of a file has its second
    curve = mean_curve(collect(folder).settings[0], "val/normal_deg")
    assert curve == [(0, 0), (1, 1), (2, 22), (3, 23), (4, 24), (5, 25), (6, 26)]


def test_a_report_tells_revision_machine_and_seeds(make: Make) -> None:
    folder = three_settings(make)
    for path in folder.glob("*/run.json"):
        record = json.loads(path.read_text())
        path.write_text(json.dumps(record | {"git": "0123456789abcdef+", "machine": "Xeon, 2 threads"}))
    line = "Revision 0123456789+; Xeon, 2 threads; 2 to 3 seeds."
    assert line in sweep_report.facts(collect(folder))
    write_report(collect(folder), folder / "report")
    assert line in (folder / "report" / "report.md").read_text()
    assert line in (folder / "report" / "report.html").read_text()


def test_one_seed_has_no_spread(make: Make) -> None:
    make(0, "default", 0, 0.1)
    study = collect(make(1, "a/other", 0, 0.9, w3=0.0))
    summary = study.summary(study.settings[1], "chamfer_sq")
    assert summary is not None
    assert (summary.spread, summary.exceeds) == (None, None)
    assert summary.difference == pytest.approx(0.8)


def test_another_baseline(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    folder = three_settings(make)
    study = collect(folder, "same")
    assert study.baseline.name == "same"
    assert study.summary(study.baseline, "chamfer_sq").difference is None  # type: ignore[union-attr]
    with pytest.raises(SystemExit):
        main([f"sweep={folder}", "baseline=none"])
    assert "baseline=none: expected one of default, worse, same" in capsys.readouterr().err


def test_of_another_class_the_class_alone_is_told() -> None:
    baseline = Setting("a", {"model._target_": "A", "model.x": 1, "loss.w": 2}, [])
    other = Setting("b", {"model._target_": "B", "model.y": 3, "loss.w": 4}, [])
    assert differing(other, baseline) == "model._target_=B, loss.w=4"
    assert differing(baseline._replace(values=baseline.values | {"model.x": 5}), baseline) == "model.x=5"


def test_settings_without_names_are_named_by_what_differs(make: Make) -> None:
    make(0, None, 0, 0.1)
    study = collect(make(1, None, 0, 0.2, w3=0.5))
    assert [setting.name for setting in study.settings] == ["loss.w3=0.05", "loss.w3=0.5"]


def test_effects_are_of_one_number_alone(make: Make) -> None:
    for job, loss in enumerate([{}, {"w3": 0.0}, {"w3": 0.5}, {"w1": 0.0}, {"w1": 10.0}]):
        folder = make(job, None, 0, 0.1 * job + 0.1, **loss)
    found = effects(collect(folder))
    assert {key: [value for value, _ in pairs] for key, pairs in found.items()} == {
        "loss.w3": [0.0, 0.05, 0.5],
        "loss.w1": [0.0, 1.0, 10.0],
    }


def test_effects_of_a_search_are_of_all_its_trials(make: Make) -> None:
    for job in range(6):
        folder = make(job, None, 0, 0.1 * job + 0.1, w1=float(job), w3=0.1 * job)
    assert {key: len(pairs) for key, pairs in effects(collect(folder)).items()} == {"loss.w1": 6, "loss.w3": 6}


def test_a_search_has_no_baseline(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    for job, w3 in enumerate([0.5, 0.1, 0.02]):
        folder = make(job, None, 0, 0.3 - 0.1 * job, w3=w3)
        config = yaml.safe_load((folder / f"{job}" / "config.yaml").read_text())
        (folder / f"{job}" / "config.yaml").write_text(yaml.safe_dump(config | {"objective": ["chamfer_sq"]}))
    study = collect(folder)
    assert study.baseline is None
    assert all(study.summary(setting, "chamfer_sq").difference is None for setting in study.settings)  # type: ignore[union-attr]
    main([f"sweep={folder}"])
    for name in ("report.md", "report.html", "settings.svg"):
        assert "aseline" not in (folder / "report" / name).read_text(), name
    text = (folder / "report" / "report.md").read_text()
    assert "3 trials of a search, 1 seeds each" in text
    assert "| 0 | loss.w3=0.5 | 300.0000 | 27.00 | loss.w3=0.5 |" in text
    assert collect(folder, "loss.w3=0.1").baseline is not None


def trial(make: Make, job: int, seed: int, place: tuple[float, float], status: str = "finished", **loss: float) -> Path:
    """A run of a search for two objectives: those of its best validation."""
    folder = make(job, None, seed, 0.1, **loss)
    path = folder / f"{job}"
    config = yaml.safe_load((path / "config.yaml").read_text())
    (path / "config.yaml").write_text(yaml.safe_dump(config | {"objective": ["chamfer_sq", "normal_deg"]}))
    validation = dict(zip(["chamfer_sq", "normal_deg"], place, strict=True))
    found = {"test": {"chamfer_sq": 0.1, "normal_deg": 9.0}, "validation": validation}
    (path / "metrics.json").write_text(json.dumps(found))
    if status == "pruned":
        record = json.loads((path / "run.json").read_text())
        (path / "run.json").write_text(json.dumps(record | {"status": status, "pruned": "step 9: worse"}))
        (path / "metrics.json").write_text(json.dumps({"validation": validation}))
    return folder


def test_front_of_a_search_by_hand(make: Make) -> None:
    """Two trials that no other beats, one that is beaten, one pruned; the weights beside them, thrice."""
    for job, place in enumerate([(0.1, 30.0), (0.2, 20.0), (0.3, 25.0)]):
        trial(make, job, 0, place, w3=0.5 + job)
    trial(make, 3, 0, (0.5, 60.0), "pruned", w3=7.0)
    for seed, place in enumerate([(0.1, 10.0), (0.2, 14.0), (0.3, 12.0)]):
        folder = trial(make, 4 + seed, seed, place)
    study = collect(folder)
    assert [(t.number, len(t.places)) for t in trials(study)] == [(0, 1), (1, 1), (2, 1), (3, 3), (None, 1)]
    assert [t.number for t in unbeaten(trials(study))] == [0, 1]
    assert study.unfinished == []
    drawn = search_plots(study)
    text = sweep_report.markdown(study, drawn, [])
    for line in (
        "| 0 | 100.0000 | 30.00 | 1 | loss.w3=0.5 |",
        "| 1 | 200.0000 | 20.00 | 1 | loss.w3=1.5 |",
        "| 3 | 200.0000 ± 100.0000 | 12.00 ± 2.00 | 3 | loss.w3=0.05 |",
        "- 3: step 9: worse",
    ):
        assert f"{line}\n" in text
    assert "| 2 | 300.0000" not in text.split("## ")[1]
    assert "1 runs were pruned, see the end." in text
    assert "<li>3: step 9: worse</li>" in sweep_report.page_html(study, drawn, {})
    for label in ("1 pruned", "3 to the end", "3, 3 seeds"):
        assert label in drawn["search"].svg
    (row,) = (row for row in sweep_report.run_rows(study) if row["status"] == "pruned")
    assert (row["run"], row["error"]) == ("3", "step 9: worse")


def test_no_front_without_two_objectives(make: Make) -> None:
    assert search_plots(collect(make(0, "default", 0, 0.1))) == {}


def test_terms_left_out_are_no_effect_of_a_number(make: Make) -> None:
    for job, loss in enumerate([{}, {"w3": 0.0}, {"w1": 0.0}, {"w1": 0.0, "w3": 0.0}]):
        folder = make(job, None, 0, 0.1 * job + 0.1, **loss)
    assert effects(collect(folder)) == {}


@pytest.mark.parametrize("content", [[], ["failed"]])
def test_nothing_to_report(content: list[str], tmp_path: Path, make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "sweep").mkdir()
    for _ in content:
        shutil.rmtree(tmp_path / "sweep")
        make(0, "default", 0, None)
    with pytest.raises(SystemExit) as stopped:
        main([f"sweep={tmp_path / 'sweep'}"])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert f"found {len(content)} runs, none finished" in error
    assert not (tmp_path / "sweep" / "report").exists()


def test_files_of_a_report(make: Make, tmp_path: Path) -> None:
    folder = three_settings(make)
    main([f"sweep={folder}", f"output={tmp_path / 'out'}"])
    text = (tmp_path / "out" / "report.md").read_text()
    assert "| 0 | default | 200.0000 ± 100.0000 | 18.00 ± 9.00 | baseline |" in text
    assert "| 1 | worse | **1100.0000 ± 141.4214 (+900.0000)** | **99.00 ± 12.73 (+81.00)** | loss.w3=0.5 |" in text
    assert "| 2 | same | 250.0000 ± 141.4214 (+50.0000) |" in text
    assert "- 7: failed: NonFinite: step 3" in text
    assert "python -m pnu.train -m ablation=x" in text
    with open(tmp_path / "out" / "summary.csv") as file:
        rows = [row for row in csv.DictReader(file) if row["metric"] == "chamfer_sq"]
    assert [float(row["mean"]) for row in rows] == pytest.approx([0.2, 1.1, 0.25])
    assert [row["exceeds"] for row in rows] == ["", "True", "False"]
    with open(tmp_path / "out" / "runs.csv") as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == 8
    assert runs[-1]["error"] == "NonFinite: step 3"
    named = set(re.findall(r"\]\((\S+)\)", text))
    assert named == {"settings.svg", "effects.svg", "pareto.svg"}
    for name in named:
        ElementTree.parse(tmp_path / "out" / name)


def test_words_are_escaped(make: Make, tmp_path: Path) -> None:
    make(0, "default", 0, 0.1)
    evil = "<script>alert(1)</script>"
    write_report(collect(make(1, evil.replace("/", "\\"), 0, 0.1, w3=1.0)), tmp_path / "out")
    assert "<script>alert" not in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("low", "high"), [(2.2, 4.5), (2.2, 2.6), (1.01, 1.03), (0.4, 7), (3e-3, 0.9), (3e-4, 3.1), (1e-9, 1e9), (6.0, 6.0)]
)
@pytest.mark.parametrize("name", ["x", "y"])
def test_logarithmic_axes_hold_their_values_and_have_numbers(low: float, high: float, name: str) -> None:
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    axes.plot([low, high], [low, high])
    axis = axes.xaxis if name == "x" else axes.yaxis
    logarithmic(axis, [low, high, -1.0, float("nan")])
    bottom, top = axis.get_view_interval()
    assert bottom < low <= high < top
    assert axis.get_scale() == "log"
    ticks = [place for place in axis.get_majorticklocs() if bottom <= place <= top]
    assert 2 <= len(ticks) <= 13
    assert [float(axis.get_major_formatter()(place)) for place in ticks] == pytest.approx(ticks, rel=1e-3)


@pytest.mark.slow
def test_same_runs_same_bytes_of_the_plots(make: Make) -> None:
    make(8, "a$b$ <i>", 0, 0.4, w3=0.25)  # is no formula
    folder = three_settings(make)
    first, second = (plots(collect(folder)) for _ in range(2))
    assert first == second
    assert "a$b$ &lt;i&gt;" in first["settings"].svg


def test_front_is_what_no_other_beats() -> None:
    assert front([(3, 1), (1, 3), (2, 4), (2, 2), (3, 3)]) == [(1, 3), (2, 2), (3, 1)]


# --- a real sweep ---


@pytest.fixture(scope="module")
def swept(patch_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """Two settings, two seeds, four steps, with pictures."""
    folder = tmp_path_factory.mktemp("swept")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        train(
            ["-m", "data=patches", f"data.path={patch_file}", "data.batch_size=5", "data.input_points=64"]
            + ["data.target_points=256", "trainer.accelerator=cpu", "trainer.max_epochs=1", "quiet=true"]
            + ["trainer.check_val_every_n_epoch=null", "trainer.val_check_interval=2", "callbacks.pictures.size=64"]
            + ["callbacks.pictures.points=100", "callbacks.pictures.clouds=1", "sweep=s", "seed=0,1"]
            + ["setting=default,loss_terms/cd"]
        )
        main([])
    return folder / "outputs" / "sweeps" / "s"


@pytest.mark.slow
def test_report_of_a_real_sweep(swept: Path) -> None:
    folder = swept / "report"
    names = {path.name for path in folder.iterdir()}
    (cloud,) = (name for name in names if name.startswith("cloud_"))
    assert names == {
        *("report.md", "report.html", "summary.csv", "runs.csv", cloud),
        *(f"{name}.{form}" for name in ("settings", "curves", "pareto") for form in ("svg", "png")),
    }
    found = [json.loads(path.read_text())["test"]["chamfer_sq"] for path in sorted(swept.glob("cd*/metrics.json"))]
    with open(folder / "summary.csv") as file:
        (row,) = (r for r in csv.DictReader(file) if (r["setting"], r["metric"]) == ("cd", "chamfer_sq"))
    assert float(row["mean"]) == pytest.approx(statistics.fmean(found))
    assert float(row["spread"]) == pytest.approx(statistics.stdev(found))
    assert row["differs"] == "loss.w2=0, loss.w3=0, loss.w4=0, loss.w5=0"
    assert "2 settings, 2 seeds each, 4 finished runs" in (folder / "report.md").read_text()
    picture = np.asarray(Image.open(folder / cloud).convert("RGB"))
    assert (np.ptp(picture.reshape(-1, 3).astype(int), axis=1) > 60).mean() > 0.01  # colored by normals
    curves = (folder / "curves.svg").read_text()
    for word in ("val/chamfer_sq", "val/normal_deg", "step", "0 default", "1 cd"):
        assert word in curves
    with Image.open(folder / "curves.png") as drawn:
        assert min(drawn.size) > 400


def browse(page: Path, profile: Path, *action: str) -> subprocess.CompletedProcess[str]:
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-sync "
    flags += "--window-size=1300,2600 --virtual-time-budget=4000 --enable-logging=stderr "
    command = [str(CHROMIUM), *flags.split(), f"--user-data-dir={profile}", *action, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)


@needs_browser
@pytest.mark.slow
def test_page_in_a_browser(swept: Path, tmp_path: Path) -> None:
    page = (swept / "report" / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    probe = """<script>
      const drawn = [...document.querySelectorAll("svg")].map((svg) => {
        const box = svg.getBoundingClientRect();
        return [box.width > 300 && box.height > 150, svg.querySelectorAll("use, path").length].join("/");
      });
      const pictures = [...document.images].map((image) => image.complete && image.naturalWidth > 100);
      document.querySelectorAll("thead th")[1].click();
      const values = [...document.querySelectorAll("tbody tr")].map((row) => Number(row.cells[1].dataset.value));
      const sorted = values.every((value, i) => !i || values[i - 1] <= value);
      document.title = JSON.stringify({drawn, pictures, sorted});
    </script></body>"""
    (tmp_path / "a.html").write_text(page.replace("</body>", probe))
    done = browse(tmp_path / "a.html", tmp_path / "profile", "--dump-dom")
    assert "CONSOLE" not in done.stderr
    title = re.search(r"<title>(.*?)</title>", done.stdout)
    assert title is not None
    found = json.loads(title[1])
    assert len(found["drawn"]) == 3
    assert all(text.startswith("true/") and int(text[5:]) >= 2 for text in found["drawn"])
    assert found["pictures"] == [True]
    assert found["sorted"]


@needs_browser
@pytest.mark.slow
def test_tables_fit_a_window_of_1400_pixels(make: Make, tmp_path: Path) -> None:
    """Twenty settings with long names, all metrics, three-digit numbers; and a comparison of fourteen shapes."""
    for job in range(40):
        folder = make(
            job,
            f"a/no_{'_and_no_'.join(['point_knn', 'normal_orth'])}_{job // 2}",
            job % 2,
            0.1 + 0.01 * job,
            w3=job // 2,
        )
        found = {
            "hausdorff_sq": 0.5,
            "spacing_cv": 0.4,
            "normal_deg": 123.4,
            "normal_unsigned_deg": 67.8,
            "flipped": 0.5,
        }
        (folder / f"{job}" / "metrics.json").write_text(json.dumps({"test": {"chamfer_sq": 0.1 + 0.01 * job} | found}))
    main([f"sweep={folder}", f"output={tmp_path / 'out'}", "quiet=true"])
    names = [metric.shown.name for metric in METRICS] + ["seconds", "peak_memory_mb"]
    rows = [
        {"kind": "uniform", "method": method, "shape": f"od_pulley_modification_{i}", "points_in": 5000,
         "points_out": 20000} | dict.fromkeys(names, 0.1234)
        for method in ("a_run_with_a_long_name_of_its_own", "apss", "input") for i in range(14)
    ]  # fmt: skip
    write_page(tmp_path / "out" / "index.html", "Comparison", tables(rows, []))
    probe = """<script>
      const wide = [...document.querySelectorAll(".scroll")].filter((box) => box.scrollWidth > box.clientWidth);
      const root = document.documentElement;
      document.title = JSON.stringify([innerWidth, root.scrollWidth <= root.clientWidth, wide.length]);
    </script></body>"""
    for name in ("report", "index"):
        page = tmp_path / f"{name}_probe.html"
        page.write_text((tmp_path / "out" / f"{name}.html").read_text().replace("</body>", probe))
        done = browse(page, tmp_path / f"profile_{name}", "--window-size=1400,1800", "--dump-dom")
        assert json.loads(re.search(r"<title>(.*?)</title>", done.stdout)[1])[1:] == [True, 0], name  # type: ignore[index]


@needs_browser
def test_an_error_in_the_console_would_be_seen(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text("<script>missing()</script>")
    assert "CONSOLE" in browse(tmp_path / "a.html", tmp_path / "profile", "--dump-dom").stderr


# --- TensorBoard ---


@pytest.fixture(scope="module")
def ask(swept: Path) -> Iterator[Callable[..., Any]]:
    """ask(path, data=None): what TensorBoard answers over HTTP for the sweep's folder."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "tensorboard.main", f"--logdir={swept}", f"--port={port}", "--load_fast=false"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )

    def answer(path: str, data: dict[str, Any] | None = None) -> Any:
        body = None if data is None else json.dumps(data).encode()
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(f"http://127.0.0.1:{port}/{path}", body, headers)
        with urllib.request.urlopen(request, timeout=60) as reply:
            content = reply.read()
            return json.loads(content) if "json" in reply.headers["Content-Type"] else content

    try:
        for _ in range(200):
            assert process.poll() is None, "TensorBoard ended"
            try:
                if len(answer("data/runs")) == 4:
                    break
            except OSError:
                pass
            time.sleep(0.3)
        yield answer
    finally:
        process.terminate()
        process.wait()


@pytest.mark.slow
def test_curves_of_all_runs_have_the_same_names(ask: Callable[..., Any], swept: Path) -> None:
    tags = ask("data/plugin/scalars/tags")
    assert len(tags) == 4
    shared = set.intersection(*(set(names) for names in tags.values()))
    assert {"train/loss", "train/cd", "val/chamfer_sq", "val/normal_deg", "test/chamfer_sq"} <= shared
    assert {Path(run).parts[0] for run in tags} == {path.parent.name for path in swept.glob("*/run.json")}


@pytest.mark.slow
def test_clouds_are_served_with_points_and_colors(ask: Callable[..., Any]) -> None:
    tags = ask("data/plugin/mesh/tags")
    assert len(tags) == 4
    run, clouds = next(iter(tags.items()))
    (shape,) = {name.rpartition("/")[0] for name in clouds}
    assert set(clouds) == {f"{shape}/{name}" for name in ("input", "prediction", "target")}
    query = f"run={run}&tag={shape}/target&sample=0&step=0"
    points = np.frombuffer(ask(f"data/plugin/mesh/data?{query}&content_type=VERTEX"), np.float32).reshape(-1, 3)
    colors = np.frombuffer(ask(f"data/plugin/mesh/data?{query}&content_type=COLOR"), np.uint8).reshape(-1, 3)
    assert points.shape == colors.shape == (86, 3)  # every third of 256: at most 100
    assert np.abs(points).max() < 2
    assert colors.std() > 20


@pytest.mark.slow
def test_hyperparameters_are_served_with_the_final_metrics(ask: Callable[..., Any], swept: Path) -> None:
    experiment = ask("data/plugin/hparams/experiment", {})
    assert "test/chamfer_sq" in {info["name"]["tag"] for info in experiment["metricInfos"]}
    names = [info["name"] for info in experiment["hparamInfos"]]
    differing_keys = {"loss.w2", "loss.w3", "loss.w4", "loss.w5", "seed", "data.seed"}
    assert set(names[:6]) == differing_keys, "what differs comes first"
    assert [info.get("differs", False) for info in experiment["hparamInfos"]] == [True] * 6 + [False] * (len(names) - 6)
    wanted = {"allowedStatuses": ["STATUS_UNKNOWN", "STATUS_SUCCESS", "STATUS_FAILURE", "STATUS_RUNNING"]}
    wanted |= {"colParams": [{"metric": {"tag": "test/chamfer_sq"}}], "startIndex": 0, "sliceSize": 100}
    groups = ask("data/plugin/hparams/session_groups", wanted)["sessionGroups"]
    assert len(groups) == 4
    found = set()
    for group in groups:
        values = {entry["name"]["tag"]: entry["value"] for entry in group["metricValues"]}
        found.add((group["hparams"]["loss.w2"], group["hparams"]["seed"], round(values["test/chamfer_sq"], 6)))
    expected = set()
    for path in swept.glob("*/metrics.json"):
        config = yaml.safe_load((path.parent / "config.yaml").read_text())
        test = json.loads(path.read_text())["test"]
        expected.add((config["loss"]["w2"], config["seed"], round(test["chamfer_sq"], 6)))
    assert found == expected


@pytest.mark.slow
def test_config_is_served_as_text(ask: Callable[..., Any]) -> None:
    tags = ask("data/plugin/text/tags")
    run, names = next(iter(tags.items()))
    assert names == ["config/text_summary"]
    (entry,) = ask(f"data/plugin/text/text?run={run}&tag=config/text_summary")
    assert "w2:" in entry["text"]
