"""Config, schema, errors, `build` and the run folder."""

import dataclasses
import importlib
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

import pnu
from pnu.commands._arguments import renamed
from pnu.commands._entry import command, launcher_arguments
from pnu.commands.compare import Compare
from pnu.commands.train import Train
from pnu.commands.train import main as train
from pnu.config.compose import compose_config, composer, config_folder, flatten, spell, variations
from pnu.config.instantiate import instantiate
from pnu.config.schema import checked_config, doc, fields, groups, known_keys, nearest_key, unsaid_keys
from pnu.training.run_folder import RunFolder, config_hash, new_path
from tests.refusals import refused

COMMANDS = sorted(path.stem for path in config_folder().glob("*.yaml") if path.stem != "command")
GROUPS = sorted(path.name for path in config_folder().iterdir() if path.is_dir())


def schema_of(name: str) -> type:
    return importlib.import_module(f"pnu.commands.{name}").main.schema


# --- every key has a line of documentation ---


@pytest.mark.parametrize("name", COMMANDS)
def test_schema_and_values_have_the_same_keys(name: str) -> None:
    schema = schema_of(name)
    own = OmegaConf.to_container(OmegaConf.load(config_folder() / f"{name}.yaml"))
    assert isinstance(own, dict)
    assert set(own) - {"defaults", "hydra"} | set(groups(schema)) == set(fields(schema)), (
        "conf/ and the dataclass differ"
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_every_key_is_documented_in_a_line(name: str) -> None:
    schema = schema_of(name)
    unsaid = unsaid_keys(schema)  # arguments of libraries, some of which have no words
    for key, text in known_keys(schema).items():
        assert text.strip() or key in unsaid, key
        assert "\n" not in text, key


def test_a_key_without_documentation_would_be_found() -> None:
    @dataclasses.dataclass
    class Bare:
        w9: float = doc("")

    assert not known_keys(Bare)["w9"].strip()


@pytest.mark.parametrize(
    "choice", [f"{group}={path.stem}" for group in GROUPS for path in sorted((config_folder() / group).glob("*.yaml"))]
)
def test_every_choice_of_a_group_composes(choice: str) -> None:
    group, _, name = choice.partition("=")
    try:
        cfg = compose_config(Compare if group == "protocol" else Train, [choice], complete=False)
    except ValueError as error:
        pytest.fail(f"{choice}: {error}")
    if group in Train.__dataclass_fields__:
        chosen = OmegaConf.to_container(cfg)[group]
        assert set(flatten(chosen)) >= group_keys_of(config_folder() / group / f"{name}.yaml")


def group_keys_of(path: Path) -> set[str]:
    return {key for key in flatten(OmegaConf.to_container(OmegaConf.load(path))) if key != "defaults"}


def test_defaults_are_the_papers() -> None:
    cfg = compose_config(Train)
    assert cfg.model._target_ == "pnu.networks.pnu.PNU"
    assert cfg.optimizer._target_ == "torch.optim.Adam"
    assert (cfg.optimizer.lr, cfg.optimizer.weight_decay) == (1e-3, 1e-5)
    assert (cfg.data.batch_size, cfg.trainer.max_epochs) == (20, 500)
    assert [cfg.loss[f"w{i}"] for i in range(1, 6)] == [1, 0.1, 0.05, 1e-4, 1e-4]
    assert cfg.loss.k == 15
    assert cfg.scheduler == {}


# --- mistakes ---


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("loss.w9=1", r"unknown key 'loss\.w9': did you mean 'loss\.w[1-5]'\?"),
        ("trainr.max_steps=3", r"unknown key 'trainr\.max_steps': did you mean 'trainer\.max_steps'\?"),
        ("epochs=3", r"unknown key 'epochs': did you mean 'trainer\.max_epochs'\?"),
        ("modle=pnu", r"unknown key 'modle': did you mean 'model'\?"),
        ("experimnt=quickstart", r"unknown key 'experimnt': did you mean 'experiment'\?"),
        ("+loss.w9=1", r"unknown key 'loss\.w9'"),
        ("model=foo", r"model=foo: expected one of densepcr, ecnet, "),
        ("loss.w1=abc", r"loss\.w1=abc: expected float \(weight of the point term"),
        ("trainer.max_steps=1.5", r"trainer\.max_steps=1\.5: expected int \("),
        ("resume=maybe", r"resume=maybe: expected bool \("),
        ("trainer.max_time=[1]", r"trainer\.max_time=\[1\]: expected str or a group of keys or null \("),
        ("loss=3", r"loss=3: expected one of"),
        ("loss.w1=[", r"cannot read 'loss\.w1=\[': special characters want quotes, 'loss\.w1=\"\[\"'$"),
        ("--what", r"cannot read '--what': expected key=value"),
        ("scheduler.max_lr=1", r"key 'scheduler\.max_lr' has no use with this scheduler"),
    ],
)
def test_mistakes_get_one_line(override: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        compose_config(Train, [override])
    assert "\n" not in str(caught.value)


def test_two_ways_to_run_at_once_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, train, ["-m", "--cfg", "job"]) == "error: --multirun and --cfg: one of them at a time"


def test_a_key_that_a_swept_overlay_shows_is_added_where_it_is_not() -> None:
    """Hydra composes the config without `scale` first, where data=patches shows no batch_size."""
    with composer("train") as compose:
        line = ["data=patches", "scale=small,full", "data.batch_size=4"]
        assert spell(line, Train, compose) == [*line[:2], "++data.batch_size=4"]


@pytest.mark.parametrize(("choice", "extra"), [("joblib", "sweeps"), ("ray", "ray")])
def test_a_missing_extra_says_how_to_get_it(choice: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from hydra.core.config_store import ConfigStore

    with composer("train") as compose:  # which loads the plugins
        kept = ConfigStore.instance().repo["hydra"]["launcher"]["basic.yaml"]
        monkeypatch.setitem(ConfigStore.instance().repo["hydra"], "launcher", {"basic.yaml": kept})
        with pytest.raises(ValueError, match=rf"{choice}: is not here; pip install 'pnu\[{extra}\]'"):
            compose([f"hydra/launcher={choice}"], True)


def test_numbers_become_the_type_of_their_key() -> None:
    cfg = compose_config(Train, ["loss.w1=2", "trainer.limit_val_batches=3", "trainer.devices=[0,1]"])
    assert isinstance(cfg.loss.w1, float)
    assert isinstance(cfg.trainer.limit_val_batches, int)
    assert list(cfg.trainer.devices) == [0, 1]


def test_a_value_that_must_be_given_is_asked_for() -> None:
    @dataclasses.dataclass
    class Need:
        input: str = doc("file to read")

    with pytest.raises(ValueError, match=r"^input=\.\.\. is required: file to read$"):
        checked_config(OmegaConf.create({"input": "???"}), Need)
    assert OmegaConf.is_missing(checked_config(OmegaConf.create({"input": "???"}), Need, complete=False), "input")


def test_nearest_key_of_several() -> None:
    assert nearest_key("data.bathc_size", ["data.batch_size", "data.seed", "loss.k"]) == "data.batch_size"
    assert nearest_key("lr", ["loss.w1", "optimizer.lr", "seed"]) == "optimizer.lr"


def test_variations_try_each_value_once() -> None:
    assert list(variations(["a=1,2", "b=3", "c=range(0,3)"])) == [
        ["a=1", "b=3", "c=0"],
        ["a=2", "b=3", "c=0"],
        ["a=1", "b=3", "c=1"],
        ["a=1", "b=3", "c=2"],
    ]


def test_composing_leaves_hydra_as_it_was() -> None:
    from hydra.core.global_hydra import GlobalHydra

    with composer("train"):
        assert GlobalHydra.instance().is_initialized()
    assert not GlobalHydra.instance().is_initialized()


# --- a command of one's own, run as people run it ---

SCRIPT = """
from dataclasses import dataclass
from pnu.commands._entry import command
from pnu.commands.upsample import Upsample as Real
from pnu.config.schema import doc

@dataclass
class Upsample(Real):
    "Densify a cloud."
    ratio: float = doc("points out for each point in")

def work(cfg: Upsample) -> None:
    if cfg.ratio < 1:
        raise ValueError("ratio=0.5: expected 1 or more,\\n found less")
    if cfg.ratio == 7:
        raise RuntimeError("a bug")
    print("worked", cfg.ratio)

main = command(work, Upsample)
if __name__ == "__main__":
    main()
"""


@pytest.fixture
def script(tmp_path: Path) -> Any:
    (tmp_path / "tool.py").write_text(textwrap.dedent(SCRIPT))

    def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "tool.py", *arguments],
            cwd=tmp_path,
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=False,
        )

    return run


def test_command_ends_well_and_writes_nothing_of_its_own(script: Any, tmp_path: Path) -> None:
    done = script("input=a", "output=b", "ratio=2")
    assert (done.returncode, done.stdout, done.stderr) == (0, "worked 2.0\n", "")
    assert [path.name for path in tmp_path.iterdir()] == ["tool.py"]


def test_a_key_may_be_added_to_hydras_own(script: Any) -> None:
    done = script("input=a", "output=b", "ratio=2", "+hydra.job.env_set.MINE=1")
    assert (done.returncode, done.stdout, done.stderr) == (0, "worked 2.0\n", "")


@pytest.mark.parametrize(
    ("choice", "given", "added"), [("ray", {}, 1), ("ray", {"object_store_memory": 9}, 0), ("a", {}, 0)]
)
def test_ray_is_left_its_own_object_store(choice: str, given: dict[str, int], added: int) -> None:
    hydra = {"runtime": {"choices": {"hydra/launcher": choice}}, "launcher": {"ray": {"init": given}}}
    found = launcher_arguments(OmegaConf.create({"hydra": hydra}))
    assert found == ["+hydra.launcher.ray.init.object_store_memory=null"][:added]


@pytest.mark.parametrize(
    "arguments",
    [
        ["output=b"],
        ["input=a", "output=b", "ratio=0.5"],
        ["input=a", "output=b", "ratoi=2"],
        ["input=a", "output=b", "ratio=2,4"],  # without -m
        ["input=a (1).ply", "output=b"],
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(script: Any, arguments: list[str]) -> None:
    done = script(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a (1).ply", "a=b.ply", "a,b.ply", "a b/c.ply"])
def test_the_quotes_that_a_message_asks_for_help(script: Any, name: str) -> None:
    done = script(f'input="{name}"', "output=b")
    assert (done.returncode, done.stdout) == (0, "worked 4.0\n")


def test_home_is_expanded_and_the_version_is_ours() -> None:
    assert renamed("model=~/run", {"model": "run"}) == f"run={Path.home()}/run"
    done = subprocess.run([sys.executable, "-m", "pnu.train", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"pnu {pnu.__version__}\n"


@pytest.mark.usefixtures("untraced")
def test_in_a_multirun_the_other_jobs_go_on(script: Any) -> None:
    done = script("-m", "input=a", "output=b", "ratio=0.5,2")
    assert done.returncode != 0
    assert "worked 2.0" in done.stdout
    assert "error: ratio=0.5: expected 1 or more, found less" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_mistake_in_a_multirun_stops_it_before_the_first_job(script: Any) -> None:
    done = script("-m", "input=a", "output=b", "ratio=2,many")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: ratio=many: expected float (points out for each point in)\n"


def test_a_bug_keeps_its_traceback(script: Any) -> None:
    done = script("input=a", "output=b", "ratio=7")
    assert done.returncode == 1
    assert "RuntimeError: a bug" in done.stderr


def test_full_errors_on_request(script: Any) -> None:
    done = script("input=a", "output=b", "ratio=0.5", HYDRA_FULL_ERROR="1")
    assert done.returncode != 0
    assert "Traceback" in done.stderr


def test_help_lists_keys_values_and_documentation(script: Any) -> None:
    done = script("--help", "ratio=3")
    assert done.returncode == 0
    assert "Densify a cloud." in done.stdout
    assert "ratio=3" in done.stdout
    assert "points out for each point in" in done.stdout
    assert "input=..." in done.stdout


def test_main_takes_its_arguments_from_python_too(capsys: pytest.CaptureFixture[str]) -> None:
    from pnu.commands.train import main

    with pytest.raises(SystemExit) as stopped:
        main(["loss.w9=1"])
    assert stopped.value.code == 2
    assert "did you mean" in capsys.readouterr().err
    assert callable(command)


# --- build ---


def test_build_and_partial() -> None:
    import torch

    layer = torch.nn.Linear(2, 1)
    config = {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 0.5}
    optimizer = instantiate(config, "torch.optim")(layer.parameters())
    assert isinstance(optimizer, torch.optim.Adam)
    assert optimizer.defaults["lr"] == 0.5
    assert instantiate({}, "torch.optim") is None
    assert instantiate(None, "torch.optim") is None


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "pnu.io.os.system",
        "torch.optim.adam.cast",
        "torch.nn.Linear",
        "torch.optim.Nothing",
        "torch.optim",
        "torch.optimal.X",
        "Adam",
        "",
    ],
)
def test_build_refuses_what_the_package_does_not_define(target: str) -> None:
    with pytest.raises(ValueError, match=r"expected a class of torch\.optim"):
        instantiate({"_target_": target}, "torch.optim")


def test_build_names_a_wrong_argument() -> None:
    with pytest.raises(ValueError, match=r"torch\.optim\.Adam: .*rate"):
        instantiate({"_target_": "torch.optim.Adam", "rate": 1}, "torch.optim", params=[])


# --- run folder ---

CONFIG = {"run": None, "name": "test", "seed": 3, "model": {"ratio": 4}, "loss": {"w1": 1.0}}


def test_two_runs_of_one_second_get_two_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = {new_path("test") for _ in range(5)}
    assert len(paths) == 5
    assert all(path.is_dir() and path.parts[0] == "outputs" and "_test" in path.name for path in paths)


def test_record_tells_running_then_finished(tmp_path: Path) -> None:
    run = RunFolder.create({**CONFIG, "run": str(tmp_path / "run")})
    assert OmegaConf.load(run.config).loss.w1 == 1.0
    with run.recorded(CONFIG) as record:
        assert run.read_record()["status"] == "running"
        record["device"] = "cpu"
    found = run.read_record()
    assert found["status"] == "finished"
    assert (found["device"], found["seed"], found["ratio"]) == ("cpu", 3, 4)
    assert {"python", "torch", "lightning", "numpy"} <= set(found["versions"])
    assert found["wall_s"] >= 0
    assert found["config_hash"] == config_hash(CONFIG)


def test_record_tells_the_failure(tmp_path: Path) -> None:
    run = RunFolder.create({**CONFIG, "run": str(tmp_path / "run")})
    with pytest.raises(ValueError, match="bad"), run.recorded(CONFIG):
        raise ValueError("bad\nnews")
    assert run.read_record()["status"] == "failed"
    assert run.read_record()["error"] == "ValueError: bad news"


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), SystemExit(1)])
def test_an_interruption_tells_how_to_go_on(
    tmp_path: Path, stop: BaseException, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunFolder.create({**CONFIG, "run": str(tmp_path / "run")})
    with pytest.raises(SystemExit) as ended, run.recorded(CONFIG):
        raise stop
    assert ended.value.code == 130
    assert run.read_record()["error"] == "interrupted"
    assert capsys.readouterr().err == f"stopped; go on with: pnu train resume=true run={run}\n"
    job = RunFolder.create({**CONFIG, "run": str(tmp_path / "job")})
    job.facts = {"job": 0}
    with pytest.raises(SystemExit), job.recorded(CONFIG):
        raise stop
    assert capsys.readouterr().err == "", "the sweep tells at its end, how to go on with it"


def test_options_may_stand_between_overrides(script: Any) -> None:
    done = script("input=a", "-m", "output=b", "ratio=2,3")
    assert (done.returncode, done.stdout) == (0, "worked 2.0\nworked 3.0\n")


def test_wall_time_adds_up_when_a_run_goes_on(tmp_path: Path) -> None:
    run = RunFolder.create({**CONFIG, "run": str(tmp_path / "run")})
    with run.recorded(CONFIG):
        pass
    record = run.read_record()
    run.record_path.write_text(json.dumps({**record, "wall_s": 100.0}))
    with run.recorded(CONFIG):
        pass
    assert run.read_record()["wall_s"] >= 100
    assert run.read_record()["started"] == record["started"]
    assert len(run.read_record()["resumed"]) == 1


def test_a_folder_with_a_run_is_not_overwritten(tmp_path: Path) -> None:
    config = {**CONFIG, "run": str(tmp_path / "run")}
    with RunFolder.create(config).recorded(CONFIG):
        pass
    with pytest.raises(ValueError, match=r"holds a run \(finished\); resume=true goes on with it"):
        RunFolder.create(config)


@pytest.mark.parametrize("path", [None, "nowhere", "."])
def test_what_is_no_run_folder_is_refused(path: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"run=FOLDER|expected a run folder with config\.yaml"):
        RunFolder.existing(path)


def test_hash_is_of_what_is_computed() -> None:
    assert config_hash(CONFIG) == config_hash({**CONFIG, "name": "other", "quiet": True, "run": "x"})
    assert config_hash(CONFIG) != config_hash({**CONFIG, "loss": {"w1": 2.0}})


def test_metrics_are_put_together(tmp_path: Path) -> None:
    run = RunFolder.create({**CONFIG, "run": str(tmp_path / "run")})
    run.add_metrics("untrained", [{"val/chamfer_sq": 2.0}])
    run.add_metrics("test", [{"test/chamfer_sq": 1.0}, {"test/flipped": 0.5}])
    content = json.loads(run.metrics.read_text())
    assert content == {"untrained": {"chamfer_sq": 2.0}, "test": {"chamfer_sq": 1.0, "flipped": 0.5}}


def test_a_reader_that_goes_is_no_error() -> None:
    command = f"{sys.executable} -m pnu upsample --help | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True, timeout=60)
    assert done.stderr == ""
