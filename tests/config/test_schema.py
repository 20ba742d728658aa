"""The keys of conf/ are the arguments of classes, read from their source."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
import yaml
from omegaconf import OmegaConf

from pnu.commands.train import Train
from pnu.config.compose import compose_config, composer, config_folder
from pnu.config.help_text import help_text, reference, written
from pnu.config.schema import as_type, class_arguments, library, settable, targets, type_name
from pnu.config.signature import REQUIRED, Class, arguments, described, summary

GROUPS = ("callbacks", "data", "logger", "loss", "model", "optimizer", "protocol", "scheduler", "trainer")
CLASSES = sorted(
    {(group, target) for group in GROUPS for named in targets(group).values() for target in named.values()}
)


# --- arguments as the source has them ---

SOURCE = {
    "thing/__init__.py": "from .inner import Thing as Thing, Open\n",
    "thing/inner.py": '''
        raise RuntimeError("imported")
        from typing import Literal, Optional, Union
        from thing.base import Base, Kind

        class Thing(Base):
            """A thing. More on it.

            Args:
                a, b: of two
                c: words that
                    go on: "here"
                kind (Kind, optional): which
            Raises:
                d: no argument
            """

            def __init__(self, a: int, b: float = 1.5, *, c: "list[str] | None" = None, kind: Kind = "x",
                         d: Optional[Union[Base, str]] = None, e=UNKNOWN, size: tuple[float, int] = (1, 2), **options):
                pass

        class Open:
            def __init__(self, a=1, **more):
                pass
        ''',
    "thing/base.py": '''
        from typing import Literal
        Kind = Literal["x", "y"]
        class Base:
            """What is above.

            Args:
                below: an argument of the class above
            """
            def __init__(self, below: bool, a: str = "") -> None:
                pass
        ''',
}


@pytest.fixture
def thing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    for name, text in SOURCE.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(tmp_path)
    return "thing"


def test_arguments_are_read_without_importing(thing: str) -> None:
    found = arguments(f"{thing}.Thing")
    assert found is not None
    assert list(found) == ["a", "b", "c", "kind", "d", "e", "size", "below"]
    assert [found[name].default for name in ("a", "b", "c", "kind", "size")] == [REQUIRED, 1.5, None, "x", [1, 2]]
    assert found["a"].hint is int
    assert type_name(found["c"].hint) == "list of str or null"
    assert type_name(found["kind"].hint) == "x or y"
    assert found["e"].hint is Any
    assert found["below"].hint is bool
    assert {name: found[name].words for name in ("a", "b", "c", "kind", "d", "below")} == {
        "a": "of two", "b": "of two", "c": 'words that go on: "here"', "kind": "which", "d": "",
        "below": "an argument of the class above",
    }  # fmt: skip
    assert summary(f"{thing}.Thing") == "A thing"
    assert list(arguments(f"{thing}.Open") or {}) == ["a", "**"]
    assert "thing" not in sys.modules


@pytest.mark.parametrize("target", ["thing.Nothing", "thing.inner.Literal", "nowhere.Thing", "thing", "", ".", "a b.C"])
def test_what_is_no_class_is_none(thing: str, target: str) -> None:
    assert arguments(target) is None


@pytest.mark.parametrize(("group", "target"), CLASSES)
def test_source_and_imported_class_agree(group: str, target: str) -> None:
    """Against Python's own reading of the imported class."""
    import importlib
    import inspect

    module, _, name = target.rpartition(".")
    cls = getattr(importlib.import_module(module), name)
    found = arguments(target)
    assert found is not None
    for parameter in inspect.signature(cls).parameters.values():
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        argument = found[parameter.name]
        assert (argument.default is REQUIRED) == (parameter.default is parameter.empty), parameter
        if isinstance(argument.default, bool | int | float | str | None):
            assert argument.default == parameter.default, parameter


def test_described_ends_with_the_section() -> None:
    text = "Title.\n\nArgs:\n    a: one\n    *b: two\n\nSource: c: three\n"
    assert described(text) == {"a": "one", "b": "two"}


# --- types ---


@pytest.mark.parametrize(
    ("value", "hint", "right"),
    [
        (1, float, 1.0), ("3", int, 3), ("1e-3", float, 1e-3), (7, str, "7"), (None, int | None, None),
        (2, int | float, 2), (0.5, int | float, 0.5), ("a", Literal["a", "b"], "a"), (16, Literal["16"], "16"),
        ([1, 2], list[float], [1.0, 2.0]), ({"a": 1}, dict, {"a": 1}), (True, bool | str, True), ("x", int | str, "x"),
    ],
)  # fmt: skip
def test_values_become_what_is_meant(value: object, hint: Any, right: object) -> None:
    found = as_type(value, hint)
    assert found == right
    assert type(found) is type(right)


@pytest.mark.parametrize(
    ("value", "hint"),
    [
        (1.5, int), ("x", float), (None, float), ([1], float), ("max", Literal["mean", "sum"]), (["a"], list[int]),
        ({}, str), ("maybe", bool), ([1.0], tuple[float, float]), (1, list[int]),
    ],
)  # fmt: skip
def test_values_of_another_type_are_refused(value: object, hint: Any) -> None:
    with pytest.raises(TypeError):
        as_type(value, hint)


# --- conf/ ---


@pytest.mark.parametrize(("group", "target"), [one for one in CLASSES if not library(one[1])])
def test_every_argument_has_words_and_a_type(group: str, target: str) -> None:
    for name, argument in settable(group, class_arguments(group, target)):
        assert argument.words, f"{target}: {name} is not in the docstring's Args:"
        assert argument.hint is not Any, f"{target}: {name} has no type that a config can hold"


def test_words_to_choose_from_are_words_on_a_command_line() -> None:
    """`true`, `null` or `1` would come as something else."""
    chosen = {
        (target, name, word)
        for group, target in CLASSES
        for name, argument in settable(group, class_arguments(group, target))
        for kind in (argument.hint, *get_args(argument.hint))
        if get_origin(kind) is Literal
        for word in get_args(kind)
    }
    assert len(chosen) > 10
    assert not [one for one in chosen if isinstance(one[2], str) and yaml.safe_load(one[2]) != one[2]]


def test_comments_of_conf_are_the_words_on_libraries() -> None:
    found = class_arguments("trainer", "lightning.pytorch.Trainer")
    assert found["max_epochs"].words == "epochs at most; -1: no limit"
    assert found["min_epochs"].words.startswith("Force training for at least")


FILES = [path for group in GROUPS for path in sorted((config_folder() / group).glob("*.yaml"))]


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}={path.stem}")
def test_no_value_of_conf_differs_from_its_class_in_silence(path: Path) -> None:
    """A value of a class of ours is its default, a reference such as ${seed}, or says what the default is: a trailing
    comment `default 0.2: why not here`. Libraries' defaults may change, so that their values stand in conf/."""
    text = path.read_text(encoding="utf-8")
    content = yaml.safe_load(text) or {}
    parts = [content, *(value for value in content.values() if isinstance(value, dict))]
    for part in (one for one in parts if "_target_" in one and not library(one["_target_"])):
        known = class_arguments(path.parent.name, part["_target_"])
        for key, value in part.items():
            if key in ("_target_", "defaults") or (isinstance(value, str) and "${" in value):
                continue
            if value == {} and isinstance(known[key].hint.members[0], Class):  # on, by its own defaults
                continue
            said = f"# default {known[key].default}: " in text
            assert value == known[key].default or said, (
                f"{key}: {value} here, {known[key].default} in {part['_target_']}"
            )


def test_what_conf_does_not_say_is_filled_in() -> None:
    cfg = compose_config(Train, ["loss=surface", "data.augmentation.shift=0.5"])
    assert cfg.loss.w_drift == 0.5
    assert cfg.data.input_points == 1024
    assert (cfg.data.augmentation.shift, cfg.data.augmentation.rotation) == (0.5, True)
    assert "fast_dev_run" not in cfg.trainer  # a library's


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("loss.k=5", "loss.k", 5),
        ("+loss.k=5", "loss.k", 5),
        ("+loss.w1=2", "loss.w1", 2.0),
        ("trainer.fast_dev_run=true", "trainer.fast_dev_run", True),
        ("+trainer.fast_dev_run=2", "trainer.fast_dev_run", 2),
        ("++trainer.min_epochs=3", "trainer.min_epochs", 3),
        ("optimizer.amsgrad=true", "optimizer.amsgrad", True),
        ("+callbacks.rate={_target_: lightning.pytorch.callbacks.LearningRateMonitor}", "callbacks.rate._target_",
         "lightning.pytorch.callbacks.LearningRateMonitor"),
    ],
)  # fmt: skip
def test_any_argument_may_be_given(override: str, key: str, value: object) -> None:
    assert OmegaConf.select(compose_config(Train, [override]), key) == value


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("trainer.fast_devrun=true", "unknown key 'trainer.fast_devrun': did you mean 'trainer.fast_dev_run'?"),
        ("+trainer.fast_devrun=true", "unknown key 'trainer.fast_devrun': did you mean 'trainer.fast_dev_run'?"),
        ("trainer.fast_dev_run=maybe", "trainer.fast_dev_run=maybe: expected int or bool ("),
        ("trainer.logger=false", "trainer.logger: is a group of its own: logger=csv"),
        ("trainer.callbacks=[]", "trainer.callbacks: are a group of their own: callbacks=[default,ema]"),
        ("scheduler.T_max=3", "scheduler.T_max: is the number of steps of the training"),
        ("callbacks.checkpoints.run=x", "callbacks.checkpoints.run: is the run folder"),
        ("callbacks.early_stopping.patience=3", "key 'callbacks.early_stopping.patience' has no use"),
        ("loss.reduction=max", "loss.reduction=max: expected mean or sum ("),
        ("data.augmentation.shfit=1", "unknown key 'data.augmentation.shfit': did you mean 'data.augmentation.shift'?"),
        ("data.augmentation.shift=x", "data.augmentation.shift=x: expected float ("),
        ("loss._target_=os.system", "loss._target_=os.system: expected a class of pnu.losses"),
        ("loss._target_=pnu.losses.Missing", "loss._target_=pnu.losses.Missing: expected a class of pnu.losses"),
        ("~loss.nothing", "loss.nothing"),
    ],
)  # fmt: skip
def test_mistakes_are_named(override: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        compose_config(Train, [override])
    assert "\n" not in str(caught.value)


# --- --help ---


def test_help_says_the_words_of_the_constructors() -> None:
    text = help_text(Train, "train", compose_config(Train, ["callbacks=[default,early_stopping]"], complete=False))
    for line in (
        "loss.w3=0.05                             weight of normal: predicted against true normals (Eq. 4)",
        "data.augmentation.shift=0.1              greatest offset of input and target along each axis",
        "trainer.max_epochs=500                   epochs at most; -1: no limit",
        "callbacks.early_stopping.patience=20     validations without a better value before it stops",
        "callbacks.checkpoints.every_minutes=5    minutes between two last.ckpt; 0: count steps only",
    ):
        assert line in text
    assert "also arguments of lightning.pytorch.Trainer: fast_dev_run, min_epochs" in text
    assert "log_every_n_steps" not in text  # not for the user to choose


@pytest.mark.parametrize("verb", ["train", "prepare", "evaluate", "compare", "upsample"])
def test_help_and_mistakes_import_nothing_heavy(verb: str) -> None:
    code = f"""
        import sys
        heavy = {{"torch", "lightning", "scipy", "open3d", "matplotlib"}}
        from pnu.commands.{verb} import main
        main(["--help"])
        print(sorted({{*heavy, "hydra", "numpy", "pnu.io", "pnu.training"}} & sys.modules.keys()))
        try:
            main(["epochs=3"])
        except SystemExit:
            print(sorted(heavy & sys.modules.keys()), "hydra" in sys.modules)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-2:] == ["[]", "[] True"]
    assert "unknown key 'epochs'" in done.stderr


@pytest.mark.parametrize("name", [path.stem for path in config_folder().glob("*.yaml") if path.stem != "command"])
def test_what_help_reads_is_what_hydra_composes(name: str) -> None:
    with composer(name) as compose:
        assert written(config_folder() / f"{name}.yaml") == compose([])


def test_a_file_that_asks_for_more_is_left_to_hydra(tmp_path: Path) -> None:
    (tmp_path / "scale").mkdir()
    (tmp_path / "scale" / "small.yaml").write_text("# @package _global_\nseed: 1\n")
    (tmp_path / "a.yaml").write_text("defaults: [_self_, {scale: null}]\nseed: 0\n")
    (tmp_path / "b.yaml").write_text("defaults: [_self_, {scale: small}]\nseed: 0\n")
    assert written(tmp_path / "a.yaml") == {"seed": 0}
    assert written(tmp_path / "b.yaml") is None


def test_the_page_of_keys_has_the_words_of_the_constructors() -> None:
    page = config_folder().parent / "docs" / "config.md"
    if os.environ.get("PNU_WRITE"):
        page.write_text(reference(), encoding="utf-8")
    assert page.read_text(encoding="utf-8") == reference(), "PNU_WRITE=1 python -m pytest tests/config/test_schema.py"
