"""Ratios of run times: contestants run in turn, A B A B, so that a drift of the machine's speed hits all alike."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median


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
