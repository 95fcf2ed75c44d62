"""Progress bars that say nothing at all where nobody watches."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.progress import Progress, ProgressColumn

_Item = TypeVar("_Item")


@contextmanager
def bars(
    *columns: ProgressColumn, shown: bool = True, transient: bool = False
) -> Iterator[Progress]:
    """Show progress on a terminal; elsewhere, or where it is not wanted, count in silence.

    A `rich` display that writes to a file, or in older versions is disabled, ends with an empty
    line: here none is started.
    """
    progress = Progress(*columns, transient=transient)
    if not (shown and progress.console.is_terminal):
        yield progress
        return
    with progress:
        yield progress


def watched(items: Iterable[_Item], count: int, what: str, shown: bool) -> Iterator[_Item]:
    """Yield items, `count` of them, under a bar that is gone when they are done."""
    with bars(shown=shown, transient=True) as progress:
        task = progress.add_task(what, total=count)
        for item in items:
            yield item
            progress.advance(task)
