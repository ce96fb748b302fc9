"""Progress of long work: a bar for people only, never in a pipe, never on short work."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_HIDDEN_S: Final = 1.5
_REDRAW_S: Final = 0.1


class Bar:
    """A bar that appears on standard error when the work turns out to be long."""

    def __init__(self, description: str, total: float | None) -> None:
        self._description = description
        self._total = total
        self._wanted = sys.stderr is not None and sys.stderr.isatty()
        self._next_s = time.monotonic() + _HIDDEN_S
        self._shown: tuple[Progress, TaskID] | None = None

    def reach(self, done: float) -> None:
        """Show how much of the total is done; cheap enough to be called for every chunk of work."""
        if not self._wanted or time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + _REDRAW_S
        if self._shown is None:
            self._shown = self._show()
        progress, task = self._shown
        progress.update(task, completed=done)

    def close(self) -> None:
        """Remove the bar."""
        if self._shown is not None:
            self._shown[0].stop()

    def _show(self) -> "tuple[Progress, TaskID]":
        from rich.console import Console
        from rich.progress import Progress

        progress = Progress(console=Console(stderr=True), transient=True)
        task = progress.add_task(self._description, total=self._total)
        progress.start()
        return progress, task


@contextmanager
def progress_bar(description: str, total: float | None) -> Iterator[Bar]:
    """A bar for the work in the block; ``total`` is None where it is not known."""
    bar = Bar(description, total)
    try:
        yield bar
    finally:
        bar.close()


@contextmanager
def status(description: str) -> Iterator[None]:
    """A spinner for work whose length is not known, on a terminal only."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(description):
        yield
