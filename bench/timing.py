"""Ratios of run times: contestants run in turn, A B A B, so that a drift of the machine's speed hits all alike."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

LIMIT = 1.1  # times as long beside an alternative as committed, and ours counts as slower


@dataclass(frozen=True)
class Row:
    """One measured operation: median seconds of each contestant, ours first."""

    name: str
    seconds: Mapping[str, float]

    @property
    def ratios(self) -> dict[str, float]:
        """How many times longer each alternative takes than ours."""
        ours, *others = self.seconds
        return {other: self.seconds[other] / self.seconds[ours] for other in others}

    def __str__(self) -> str:
        ours, *others = self.seconds
        parts = [f"{other} {self.seconds[other]:.4g} s ({self.ratios[other]:.1f} x)" for other in others]
        return f"{self.name}: {ours} {self.seconds[ours]:.4g} s; " + ", ".join(parts)


def compare(name: str, contestants: Mapping[str, Callable[[], object]], *, rounds: int = 5) -> Row:
    """Median seconds over `rounds` runs of each contestant, taken in turn after one uncounted run. Ours comes first."""
    taken: dict[str, list[float]] = {contestant: [] for contestant in contestants}
    for run in contestants.values():
        run()
    for _ in range(rounds):
        for contestant, run in contestants.items():
            started = time.perf_counter()
            run()
            taken[contestant].append(time.perf_counter() - started)
    return Row(name, {contestant: median(values) for contestant, values in taken.items()})


def entries(rows: Iterable[Row], made: str) -> dict[str, Any]:
    """The ratios of rows as they are committed, of several the lowest, each with what it was made with."""
    lowest: dict[str, float] = {}
    for name, ratio in _ratios(rows):
        lowest[name] = min(ratio, lowest.get(name, ratio))
    return {name: {"ratio": round(ratio, 3), "made": made} for name, ratio in lowest.items()}


def slower(rows: Iterable[Row], committed: Mapping[str, Any]) -> dict[str, float]:
    """By the names of `entries`: how many times as long ours takes beside an alternative, where more than LIMIT.

    A ratio that is not committed is not judged.
    """
    factors = {name: committed[name]["ratio"] / ratio for name, ratio in _ratios(rows) if name in committed}
    return {name: factor for name, factor in factors.items() if factor > LIMIT}


def _ratios(rows: Iterable[Row]) -> Iterator[tuple[str, float]]:
    return ((f"{row.name}, beside {other}", ratio) for row in rows for other, ratio in row.ratios.items())
