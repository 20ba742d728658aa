"""From a command line to a checked config: Hydra, and what it lacks.

A command is a dataclass (its keys, their types, a line on each), `conf/<command>.yaml` (their values) and a function:

    @dataclass
    class Upsample:
        '''Densify a point cloud file.'''

        input: str = doc("file to read: ply, xyz, pcd, obj, off, npy, las or laz")
        ratio: float = doc("points out for each point in")

    def upsample(cfg: Upsample) -> None:
        import torch            # heavy imports inside: `--help` and mistakes are answered before them
        ...

    main = command(upsample, Upsample)      # values in conf/upsample.yaml

    if __name__ == "__main__":
        main()

with `conf/upsample.yaml`:

    defaults: [command, _self_]

    input: ???      # ??? = must be given
    ratio: 4

The function gets the config resolved and checked against the dataclass, as a DictConfig (`cfg.ratio`). A `ValueError`
or `OSError` that it raises becomes one line on stderr and exit code 2; so does any key, value or choice that the
dataclass and conf/ do not know, also in a multirun, before the function is called. `HYDRA_FULL_ERROR=1` shows
tracebacks. A field of type `Group` is a group of conf/: its keys are the arguments of the class that `_target_` names.
"""

import functools
import os
import sys
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pnu import __version__
from pnu.commands._arguments import keyed
from pnu.config import quoting
from pnu.config.compose import (
    check_keys,
    check_single,
    checked,
    composer,
    fitted,
    in_multirun,
    one_line,
    printed,
    said,
    spell,
    variations,
)
from pnu.config.help_text import help_text, written
from pnu.config.schema import checked_config, config_folder, fields


def command(function: Callable[[Any], Any], schema: type, name: str | None = None) -> Callable[..., Any]:
    """The entry point `main(argv=None)` of a command: `function` called with the config that argv describes.

    Args:
        function: gets the checked config; its `ValueError`s and `OSError`s become one line and exit code 2.
        schema: dataclass that documents every key of `conf/<name>.yaml`; `also` of it: other names of keys; `commas`:
            keys whose values hold commas; `files`: the key of the files that stand alone, as in `pnu view a.ply b.ply`,
            or keys, one for each; input and output where a command has both.
        name: of the config file; default: the schema's name in lower case.
    """
    name = name or schema.__name__.lower()

    @functools.wraps(function)
    def task(cfg: Any) -> Any:
        from hydra.core.hydra_config import HydraConfig

        hydra = HydraConfig.get()
        try:
            if not hydra.job.chdir:  # a launcher's processes may have been started elsewhere
                os.chdir(hydra.runtime.cwd)
            cfg, left = fitted(cfg, hydra, schema, hydra.overrides.task)
            if left and not cfg.get("quiet"):
                print(said(left, hydra.runtime.choices), file=sys.stderr)
            return function(checked_config(cfg, schema))
        except Exception as error:
            expected = isinstance(error, ValueError | OSError)
            if full_errors() or not (expected or in_multirun()):
                raise
            if in_multirun():
                from pnu.training import sweeps

                raise sweeps.failed(error) from None
            stop(error)

    def main(argv: Sequence[str] | None = None) -> None:
        # Hydra reads options only before the first override: `a=1 -m b=2` is as good as `-m a=1 b=2`
        try:
            given = keyed(sys.argv[1:] if argv is None else argv, schema)
        except ValueError as error:
            stop(error)
        arguments = sorted(given, key=is_override)
        if "--version" in arguments:  # Hydra would tell its own
            print(f"pnu {__version__}")
            return
        # before torch is there: on a busy machine, threads that spin while they wait make a step take seconds
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        # NumPy's products are small and called from several threads, which would wait for each other
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        try:
            if arguments == ["--help"] and (cfg := written(config_folder() / f"{name}.yaml")) is not None:
                print(help_text(schema, quoting.program(name), checked_config(cfg, schema, complete=False)))
                return
            import hydra
            from hydra._internal.utils import get_args_parser

            parsed = get_args_parser().parse_args(arguments)
            modes = [mode for mode in ("run", "multirun", "cfg", "info", "shell_completion") if getattr(parsed, mode)]
            if len(modes) > 1:
                raise ValueError(f"--{modes[0]} and --{modes[1]}: one of them at a time")
            overrides = [o for o in parsed.overrides if not is_hydras(o)]
            goes_on = parsed.multirun and "trainer" in fields(schema)
            with composer(name, parsed.config_dir) as compose:
                if parsed.help:
                    spelled = spell(overrides, schema, compose)
                    text = help_text(schema, quoting.program(name), checked(spelled, schema, compose, complete=False))
                    print(text)
                    return
                if parsed.multirun:
                    from pnu.training import optuna_search, sweeps
                else:
                    check_single(overrides)
                if goes_on:
                    added = sweeps.sweep_arguments(overrides, name)
                    arguments += added
                    parsed.overrides += added
                    overrides += [o for o in added if not is_hydras(o)]
                respelled = dict(zip(overrides, spell(overrides, schema, compose), strict=True))
                overrides = list(respelled.values())
                arguments = [respelled.get(argument, argument) for argument in arguments]
                check_keys(next(variations(overrides)), schema, compose)  # before the config itself adds to the sweep
                swept = sweeps.parameters(overrides, compose) if parsed.multirun else []
                jobs_wanted, several = False, list(variations([*swept, *overrides]))
                for one in several:
                    check_keys(one, schema, compose)
                    if parsed.cfg:
                        continue
                    config = checked(one, schema, compose)
                    if goes_on:
                        sweeps.check_job(config)
                    if parsed.multirun and in_jobs(config, schema):
                        jobs_wanted = True
                        if len(several) > 1:
                            asked = "=".join(schema.jobs[:2])  # type: ignore[attr-defined]
                            raise ValueError(f"{asked}: makes the jobs of one run; give each key one value")
                if parsed.cfg == "job" and not parsed.multirun:
                    added = folder_arguments(compose([*overrides, *hydras_own(parsed.overrides)], True), schema)
                    overrides += [o for o in added if not is_hydras(o)]
                    print(printed(overrides, schema, compose, parsed.package, resolve=parsed.resolve), end="")
                    return
                if parsed.multirun:
                    composed = compose([*next(variations(overrides)), *hydras_own(parsed.overrides)], True)
                    hydra_config = composed.hydra
                    arguments += launcher_arguments(composed)
                if goes_on:
                    Path(hydra_config.sweep.dir).mkdir(parents=True, exist_ok=True)
                    arguments += optuna_search.search_arguments(hydra_config)
                elif not parsed.multirun and not parsed.cfg:
                    arguments += folder_arguments(compose([*overrides, *hydras_own(parsed.overrides)], True), schema)
        except (ValueError, OSError) as error:
            if full_errors():
                raise
            stop(error)
        start = hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=name)(task)
        with replaced_argv(arguments), quoting.typed(name, given):
            try:
                if jobs_wanted:
                    run_in_jobs(start, function, config, schema, arguments)
                elif not goes_on or parsed.cfg:
                    start()
                else:
                    sweeps.run(start, Path(hydra_config.sweep.dir))
            except KeyboardInterrupt:
                from pnu.training.run_folder import INTERRUPTED

                print(f"stopped; start again with: {quoting.typed_line()}", file=sys.stderr)
                sys.exit(INTERRUPTED)

    main.schema = schema  # type: ignore[attr-defined]
    main.__doc__ = schema.__doc__
    return main


def in_jobs(config: Any, schema: type) -> bool:
    """Whether a command is to be done in jobs: `jobs` of its schema names the key and value that ask for it."""
    key, value, _ = getattr(schema, "jobs", ("", None, None))
    return bool(key) and config[key] == value


def run_in_jobs(
    start: Callable[[], None], finish: Callable[[Any], Any], config: Any, schema: type, arguments: Sequence[str]
) -> None:
    """A command as multiruns, one after the other, of the overrides that `jobs` of its schema gives; then as a whole.

    A job that ends early does not end it: what it leaves is done in the end, which raises its error if there is one.
    """
    from pnu.training.run_folder import INTERRUPTED

    key, _, rounds = schema.jobs  # type: ignore[attr-defined]
    kept = [argument for argument in arguments if not argument.startswith(f"{key}=")]
    try:
        for overrides in rounds(config):
            with replaced_argv(sorted([*overrides, *kept], key=is_override)):  # options first
                try:
                    start()
                except SystemExit as ended:
                    if ended.code == INTERRUPTED:
                        raise
                    warn("a job ended early; what it has left is done here")
        finish(config)
    except (ValueError, OSError) as error:
        if full_errors():
            raise
        stop(error)


def hydras_own(overrides: Sequence[str]) -> list[str]:
    """The overrides of Hydra's own keys."""
    return [override for override in overrides if is_hydras(override)]


def is_hydras(override: str) -> bool:
    """Whether an override sets a key of Hydra's own, or adds one to it or deletes one."""
    return override.lstrip("+~").startswith("hydra.")


def launcher_arguments(config: Any) -> list[str]:
    """What a launcher needs that its plugin does not say.

    That for Ray asks for an object store of its own size, which Ray refuses where a cluster runs already.
    """
    ray = config.hydra.runtime.choices.get("hydra/launcher") == "ray"
    if ray and "object_store_memory" not in config.hydra.launcher.ray.init:
        return ["+hydra.launcher.ray.init.object_store_memory=null"]
    return []


def folder_arguments(config: Any, schema: type) -> list[str]:
    """Hydra's `hydra.run.dir` as our `run`, wherever it is set.

    Raises:
        ValueError: `run` names another folder, or the command makes none.
    """
    given, changes = config.hydra.run.dir, config.hydra.job.chdir
    if changes and given == "." and "trainer" in fields(schema):
        if config.run is None:
            raise ValueError(
                "hydra.job.chdir=true: a run folder is named when it is made; hydra.run.dir=FOLDER names it"
            )
        path = Path(config.run).absolute()
        return [quoting.override("hydra.run.dir", path), quoting.override("run", path)]
    if given == ".":
        return []
    from pnu.training.run_folder import is_main_process

    if not is_main_process():  # Lightning gives the other processes of a training one of their own
        return []
    if "trainer" not in fields(schema):
        if changes:
            return []
        raise ValueError(f"hydra.run.dir={given}: this command makes no run folder; its files are named by its keys")
    if config.run is None:
        return [quoting.override("run", Path(given).absolute() if changes else given)]
    if Path(config.run).absolute() != Path(given).absolute():
        raise ValueError(f"run={config.run} and hydra.run.dir={given}: are two folders; give one of them")
    return []


def is_override(argument: str) -> bool:
    """Whether an argument sets a key, and is no option."""
    return not argument.startswith("-") and ("=" in argument or argument.startswith("~"))


def stop(error: Exception) -> typing.NoReturn:
    """End the program: one line on stderr, exit code 2."""
    if isinstance(error, BrokenPipeError):  # the reader of the output has gone, as in `... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    print(f"error: {one_line(error)}", file=sys.stderr)
    sys.exit(2)


def warn(text: str) -> None:
    """A line on stderr."""
    print(f"warning: {text}", file=sys.stderr)


def full_errors() -> bool:
    """Whether tracebacks are wanted, HYDRA_FULL_ERROR=1."""
    return os.environ.get("HYDRA_FULL_ERROR") == "1"


@contextmanager
def replaced_argv(arguments: list[str]) -> Iterator[None]:
    """`sys.argv` with other arguments, for a while: Hydra reads them there."""
    before, sys.argv = sys.argv, [sys.argv[0], *arguments]
    try:
        yield
    finally:
        sys.argv = before
