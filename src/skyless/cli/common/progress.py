"""Progress of long work, never of short work: a bar for people, a line now and then for a pipe or a file."""

import sys
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, Final

_HIDDEN_S: Final = 1.5
_REDRAW_S: Final = 0.1
_STATUS_S: Final = 0.5
_LINE_S: Final = 5.0


@contextmanager
def progress_bar(description: str, total: float = 1.0) -> Iterator[Callable[[float], None]]:
    """A bar on standard error, which appears when the work in the block turns out to be long; in a pipe lines.

    What it gives says how much of the total is done; it is cheap enough to be called for every chunk of work.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield _lines(description, total)
        return
    from rich.console import Console
    from rich.progress import Progress

    progress = Progress(console=Console(stderr=True), transient=True)
    task = progress.add_task(description, total=total)
    next_s = time.monotonic() + _HIDDEN_S

    def reach(done: float) -> None:
        nonlocal next_s
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + _REDRAW_S
            progress.start()
            progress.update(task, completed=done)

    try:
        yield reach
    finally:
        if progress.live.is_started:
            progress.stop()


def _lines(description: str, total: float) -> Callable[[float], None]:
    """Write a line on standard error every few seconds."""
    next_s = time.monotonic() + _LINE_S

    def reach(done: float) -> None:
        nonlocal next_s
        if time.monotonic() >= next_s and done < total and sys.stderr is not None:
            next_s = time.monotonic() + _LINE_S
            print(f"{description}: {done / total:.0%}", file=sys.stderr, flush=True)

    return reach


@contextmanager
def status(description: str) -> Iterator[Callable[[str], None]]:
    """A spinner for work whose length is not known, on a terminal only. What it gives changes the description."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status(description) as shown:
        yield lambda words: shown.update(escape(words))


async def with_status(work: Coroutine[Any, Any, None], words: Callable[[], str]) -> None:
    """Do work; meanwhile a line on a terminal says ``words``, which are asked for twice a second."""
    from skyless.run.process import every, outlasting

    with status("") as show:
        await outlasting(every(_STATUS_S, lambda: show(words())), work)
