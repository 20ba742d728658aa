"""Which trials of a search are hopeless: the median stopping rule.

Each run of a sweep keeps its validation's values in its own folder, so that any number of processes may work on the
sweep; a run reads the others' files and writes its own, which appears whole.
"""

from collections.abc import Mapping, Sequence
from statistics import median_high
from typing import Any

from pnu.io import read_json, write_json
from pnu.training.run_folder import RunFolder
from pnu.training.sweeps import runs

Values = Mapping[str, float]


def objective_values(names: Sequence[str], found: Values) -> dict[str, float]:
    """Those of a validation's values that an objective names.

    Raises:
        ValueError: there is no such metric.
    """
    if missing := set(names) - set(found):
        known = ", ".join(sorted(set(found) - {"step"}))
        raise ValueError(f"objective={sorted(missing)}: expected some of {known}")
    return {name: found[name] for name in names}


def keep_values(run: RunFolder, step: int, values: Values) -> None:
    """Put a validation's values into the run's validations.json."""
    write_json(run.validations, {**read_values(run), str(step): dict(values)})


def read_values(run: RunFolder) -> dict[str, dict[str, Any]]:
    """Step -> what the run's validation found; null, which is None, for NaN. Nothing before the first validation."""
    return read_json(run.validations) if run.validations.exists() else {}


def behind(best: Values, others: Sequence[Values]) -> dict[str, float]:
    """The medians that a run has not reached, by objective; nothing where it reaches any.

    Of an even number the greater middle one, and the run must be worse: so among two objectives there is always
    another run that is better in both.

    Args:
        best: the run's smallest value of each objective so far.
        others: values of other runs at the same step, at least one.
    """
    medians = {name: median_high(other[name] for other in others) for name in best}
    return medians if all(best[name] > median for name, median in medians.items()) else {}


def why_hopeless(run: RunFolder, step: int, names: Sequence[str], startup: int) -> str:
    """Why a run of a sweep is not worth going on with after its validation at a step; nothing where it may be.

    Args:
        names: metrics of the objective.
        startup: runs that must have values at that step before any other is judged.
    """
    others = []
    for other in runs(run.path.parent):
        values = {} if other.path.name == run.path.name else read_values(other).get(str(step), {})
        if all(values.get(name) is not None for name in names):
            others.append(values)
    if len(others) < startup:
        return ""
    own = [values for at, values in read_values(run).items() if int(at) <= step]
    best = {name: min((v[name] for v in own if v[name] is not None), default=float("inf")) for name in names}
    medians = behind(best, others)
    if not medians:
        return ""
    told = " and ".join(f"{name} {best[name]:.4g}" for name in names)
    beside = " and ".join(f"{value:.4g}" for value in medians.values())
    word = "medians" if len(names) > 1 else "median"
    return f"step {step}: {told}, worse than the {word} {beside} of {len(others)} other runs there"
