"""How far a long computation has come."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""progress(stage, done, total): called before the first and after each step of a stage."""
Step = Callable[[int, int], None]
"""step(done, total): the same, of one stage."""


def silent(*step: object) -> None:
    """Shows nothing: a `Progress`, and a `Step`."""
