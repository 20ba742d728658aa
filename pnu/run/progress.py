"""Progress on stderr."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def steps(total: int, quiet: bool) -> Iterator[Callable[[str], None]]:
    """A bar with the time left; the function it gives is told what the next of `total` steps is."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=quiet, transient=True) as bar:
        task = bar.add_task("", total=total)
        done = iter(range(total + 1))
        yield lambda text: bar.update(task, description=text, completed=next(done, total))


@contextmanager
def busy(text: str, quiet: bool) -> Iterator[None]:
    """A sign of life with the seconds so far, on a terminal, for what tells no progress."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        bar.add_task(text, total=None)
        yield
