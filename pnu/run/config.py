"""Compose a command's config with Hydra; its long errors become one-line `ValueError`s."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

from pnu.run.quoting import quoted
from pnu.run.schema import check, known_keys, nearest_key

PACKAGE = Path(__file__).resolve().parents[1]
EXTRAS = dict.fromkeys(("joblib", "submitit_local", "submitit_slurm", "optuna"), "sweeps") | {"ray": "ray"}


def config_folder() -> Path:
    """conf/ beside the package in a checkout, inside it in an installed wheel."""
    for folder in (PACKAGE / "conf", PACKAGE.parent / "conf"):
        if (folder / "command.yaml").is_file():
            return folder
    raise FileNotFoundError(f"no conf/ folder in or beside {PACKAGE}: the installation is not complete")


@contextmanager
def composer(name: str, extra_folder: str | None = None) -> Iterator[Callable[..., Any]]:
    """Gives compose(overrides) -> DictConfig for conf/<name>.yaml; Hydra's long errors become one-line ValueErrors."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException, MissingConfigException
    from omegaconf.errors import OmegaConfBaseException

    search_path = [f"hydra.searchpath=[file://{Path(extra_folder).absolute()}]"] if extra_folder else []

    def compose(overrides: list[str], return_hydra_config: bool = False) -> Any:
        try:
            return hydra.compose(name, [*overrides, *search_path], return_hydra_config)
        except MissingConfigException as error:
            group, _, choice = (error.missing_cfg_file or "?").rpartition("/")
            if group in ("hydra/launcher", "hydra/sweeper") and choice in EXTRAS:
                raise ValueError(f"{group}={choice}: is not here; pip install 'pnu[{EXTRAS[choice]}]'") from None
            known = ", ".join(sorted(error.options or []))
            raise ValueError(f"{group}={choice}: expected one of {known}" if known else one_line(error)) from None
        except (HydraException, OmegaConfBaseException) as error:
            cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
            raise ValueError(str(cause).strip().splitlines()[0]) from None

    before = GlobalHydra.instance().hydra
    try:
        GlobalHydra.instance().clear()
        with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
            yield compose
    finally:
        GlobalHydra.instance().hydra = before


def compose_config(
    schema: type, overrides: Sequence[str] = (), name: str | None = None, *, complete: bool = True
) -> Any:
    """The checked config of a command, as its function gets it. For use from Python and in tests."""
    with composer(name or schema.__name__.lower()) as compose:
        check_keys(list(overrides), schema, compose)
        return check(compose(list(overrides)), schema, complete=complete)


def parse(overrides: list[str]) -> list[Any]:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    parsed = []
    for override in overrides:
        try:
            parsed += parser.parse_overrides([override])
        except HydraException:
            key, equals, value = override.partition("=")
            hint = f"special characters want quotes, {quoted(key, value)}" if equals else "expected key=value"
            raise ValueError(f"cannot read {override!r}: {hint}") from None
    return parsed


def variations(overrides: list[str]) -> Iterator[list[str]]:
    """Override lists in which each value of each sweep (`a=1,2 b=x,y`) appears once: the sum, not the product."""
    parsed = parse(overrides)
    values = []
    for raw, override in zip(overrides, parsed, strict=True):
        if (
            override.is_sweep_override()
            and override.is_discrete_sweep()
            and override.value_type.name != "GLOB_CHOICE_SWEEP"
        ):
            key = override.get_key_element()
            values.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        elif override.is_sweep_override():  # an interval or a pattern: the sweeper knows its values
            values.append([])
        else:
            values.append([raw])
    first = [options[:1] for options in values]
    yield list(chain(*first))
    for i, options in enumerate(values):
        for option in options[1:]:
            yield list(chain(*first[:i], [option], *first[i + 1 :]))


def check_single(overrides: list[str]) -> None:
    """Refuse several values of a key where one run is wanted."""
    for raw, override in zip(overrides, parse(overrides), strict=True):
        if override.is_sweep_override():
            key, _, value = raw.partition("=")
            raise ValueError(
                f"{raw}: for one run with each value, add -m; a comma in a value wants quotes, {quoted(key, value)}"
            )


def check_keys(overrides: list[str], schema: type, compose: Callable[..., Any]) -> None:
    """Refuse overrides of keys that do not exist, naming the nearest one that does."""
    from omegaconf import OmegaConf

    known = known_keys(schema)
    choices = list(compose([], return_hydra_config=True).hydra.runtime.choices)
    parsed = parse(overrides)
    for override in parsed:
        key = override.key_or_group
        if key not in known and key not in choices:
            nearest = nearest_key(key, [*known, *(choice for choice in choices if not choice.startswith("hydra/"))])
            raise ValueError(f"unknown key '{key}': did you mean '{nearest}'?")
        if key in choices and not isinstance(override.value(), str | list | None):
            raise ValueError(f"{key}={override.value()}: expected one of {', '.join(group_choices(key))}")
    chosen = [raw for raw, override in zip(overrides, parsed, strict=True) if override.key_or_group in choices]
    used = flatten(OmegaConf.to_container(compose(chosen)))
    for override in parsed:
        key = override.key_or_group
        if key not in choices and key not in used:
            raise ValueError(f"key '{key}' has no use with this {key.partition('.')[0]}: --help shows the keys that do")


def group_choices(group: str) -> list[str]:
    """What `group=...` may be."""
    return sorted(path.stem for path in (config_folder() / group).glob("*.yaml"))


def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Every node of nested dicts under its dotted key."""
    nodes = {}
    for name, value in tree.items():
        nodes[f"{prefix}{name}"] = value
        if isinstance(value, dict):
            nodes |= flatten(value, f"{prefix}{name}.")
    return nodes


def in_multirun() -> bool:
    """Whether the code runs as one job of several that a sweeper started."""
    from hydra.core.hydra_config import HydraConfig

    return HydraConfig.initialized() and str(HydraConfig.get().mode) == "RunMode.MULTIRUN"


def one_line(error: BaseException) -> str:
    """An exception's message on one line."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__
