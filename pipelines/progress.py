"""Progress of long work: bars on stderr, if that is a terminal and a command has asked for them.

with progress.shown(quiet):                       # the command
    ...
    for image in progress.track(images, "pictures", total):      # whoever works long
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress

Item = TypeVar("Item")

# The bars on the screen, None while there are none to show: then nothing here costs anything.
_bars: Progress | None = None


@contextmanager
def shown(quiet: bool = False) -> Iterator[None]:
    """Context manager that shows the progress of work, unless `quiet` or stderr is no terminal."""
    global _bars
    from rich import progress as rich
    from rich.console import Console

    console = Console(stderr=True)
    if quiet or not console.is_terminal or _bars is not None:
        yield
        return
    columns = (
        rich.SpinnerColumn(),
        rich.TextColumn("{task.description}"),
        rich.BarColumn(),
        rich.TaskProgressColumn(),
        rich.TimeElapsedColumn(),
        rich.TextColumn("left"),
        rich.TimeRemainingColumn(),
    )
    with rich.Progress(*columns, console=console, transient=True) as _bars:
        try:
            yield
        finally:
            _bars = None


def hide() -> None:
    """Show no progress from now on, as in a process whose terminal belongs to another one."""
    global _bars
    _bars = None


@contextmanager
def doing(what: str, total: float | None = None) -> Iterator[Callable[[float], None]]:
    """Context manager that shows work; yields a function that takes how much of the total is done."""
    bars = _bars
    if bars is None:
        yield lambda _: None
        return
    task = bars.add_task(what, total=total)
    try:
        yield lambda done: bars.update(task, completed=done)
    finally:
        bars.remove_task(task)


def track(
    items: Iterable[Item], what: str, total: float | None = None, done: Callable[[Item], float] | None = None
) -> Iterator[Item]:
    """Yield the items and show progress; `done` maps an item to the finished part of the total, else items count."""
    with doing(what, total) as update:
        for i, item in enumerate(items):
            yield item
            update(i + 1 if done is None else done(item))
