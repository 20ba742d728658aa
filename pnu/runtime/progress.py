"""How far a long computation has come, and the bars that show it."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

T = TypeVar("T")
Progress = Callable[[str, int, int], None]
"""progress(stage, done, total): called before the first and after each step of a stage."""
Step = Callable[[int, int], None]
"""step(done, total): the same, of one stage."""


listeners: list[Progress] = []
"""Told of the stages too, see `heard`."""


@contextmanager
def heard(by: Progress) -> Iterator[None]:
    """`by` is told of all stages meanwhile; of what tells no progress, as of a single step."""
    listeners.append(by)
    try:
        yield
    finally:
        listeners.remove(by)


def silent(*step: object) -> None:
    """Shows nothing: a `Progress`, and a `Step`."""


def bar(*columns: Any, quiet: bool = False, transient: bool = False, unseen: bool = True) -> "Bar":
    """rich's bar on stderr, not started yet: the only place that makes one.

    Args:
        columns: of the bar; default: rich's, with the time left.
        quiet: draw nothing.
        transient: leave no line behind.
        unseen: draw also where stderr is no terminal, a line at the end.
    """
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    off = quiet or not (unseen or console.is_terminal)
    return Bar(*columns, console=console, transient=transient, disable=off)


@contextmanager
def steps(total: int, quiet: bool) -> Iterator[Callable[[str], None]]:
    """A bar with the time left; the function it gives is told what the next of `total` steps is."""
    with bar(quiet=quiet, transient=True) as shown:
        task = shown.add_task("", total=total)
        done = iter(range(total + 1))
        yield lambda text: shown.update(task, description=text, completed=next(done, total))


@contextmanager
def stages(quiet: bool) -> Iterator[Progress]:
    """A bar for each stage, with the time left, from its first step on: an error that comes first stands alone."""
    tasks: dict[str, Any] = {}
    shown = None if quiet else bar()

    def progress(stage: str, done: int, total: int) -> None:
        for listener in listeners:
            listener(stage, done, total)
        if shown is None:
            return
        known = total if total > 1 or done else None  # a single step has no middle to show
        if stage not in tasks:
            shown.start()
            tasks[stage] = shown.add_task(stage, total=known)
        shown.update(tasks[stage], completed=done, total=known)

    try:
        yield progress
    finally:
        if shown is not None and tasks:
            shown.stop()


@contextmanager
def busy(text: str, quiet: bool) -> Iterator[None]:
    """A sign of life with the seconds so far, on a terminal, for what tells no progress."""
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    for listener in listeners:
        listener(text, 0, 1)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with bar(*columns, quiet=quiet, transient=True, unseen=False) as shown:
        shown.add_task(text, total=None)
        yield


def counted(items: Iterable[T], total: int, description: str) -> Iterator[T]:
    """The items, and a bar that counts them."""
    with bar() as shown:
        yield from shown.track(items, total=total, description=description)
