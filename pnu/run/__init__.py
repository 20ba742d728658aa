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

    main = command(upsample, Upsample)      # pnu.upsample:main, values in conf/upsample.yaml

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

from pnu.run.build import build, find_metric
from pnu.run.command import command
from pnu.run.config import compose_config
from pnu.run.folder import RunFolder, is_main_process
from pnu.run.quoting import shell_line
from pnu.run.resume import open_run
from pnu.run.schema import Group, Groups, doc
from pnu.run.table import closing, job_line, objective

__all__ = [
    "Group",
    "Groups",
    "RunFolder",
    "build",
    "closing",
    "command",
    "compose_config",
    "doc",
    "find_metric",
    "is_main_process",
    "job_line",
    "objective",
    "open_run",
    "shell_line",
]
