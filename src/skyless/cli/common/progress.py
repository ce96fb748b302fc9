"""Progress of long work: a bar for people only, never in a pipe, never on short work; counts of compilation for all."""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from skyless.core.kernels.processes import Part, Preparation

_HIDDEN_S: Final = 1.5
_REDRAW_S: Final = 0.1
_COUNT_S: Final = 0.25
_LINE_S: Final = 4.0
"""Between two lines where there is no terminal."""


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


@contextmanager
def loading_kernels(*parts: "Part") -> Iterator[None]:
    """Compile what is missing of the parts, on all cores and with counts; then a spinner while the block loads them."""
    from skyless.core.kernels.processes import missing

    if missing(parts):
        for failure in compile_with_counts(parts):
            _print_line(f"{failure}; they are compiled where they are needed")
    with status("loading the kernels"):
        yield


def compile_with_counts(parts: "Iterable[Part]") -> tuple[str, ...]:
    """Compile what is missing of the parts, saying how far it is; a sentence for each part that cannot be compiled."""
    import asyncio

    from skyless.core.kernels.processes import compile_parts

    report_kernel_folder()
    with CountLine() as line:
        return asyncio.run(compile_parts(parts, line.show))


def report_kernel_folder() -> None:
    """One line where the kernels that have to be compiled now cannot be kept for good."""
    from skyless.core.kernels.cache import kernel_folder

    folder = kernel_folder()
    if not folder.writable:
        where = f"every program compiles them at every start, for a minute or so, as {folder.path} cannot be written"
    elif folder.temporary:
        where = f"they are in {folder.path.parent}, which the system may clear"
    else:
        return
    _print_line(f"no folder keeps compiled kernels: {where}. Let NUMBA_CACHE_DIR name a folder that can be written")


class CountLine:
    """``compiling 37 of 120`` on standard error: one line that changes on a terminal, else a line every few seconds."""

    def __init__(self) -> None:
        self._on_terminal = sys.stderr is not None and sys.stderr.isatty()
        self._next_s = 0.0
        self._width = 0
        self._lines = 0
        self._begun = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.clear()

    def show(self, now: "Preparation") -> None:
        """Show a count, if the last one has been there for long enough."""
        if sys.stderr is None or time.monotonic() < self._next_s:
            return
        if not self._begun:
            _print_line(
                "compiling what this command needs and was not compiled before; skyless warm compiles everything"
            )
            self._begun = True
        self._next_s = time.monotonic() + (_COUNT_S if self._on_terminal else _LINE_S)
        text = f"skyless: {count_text(now)}"
        if not self._on_terminal:
            print(text, file=sys.stderr, flush=True)
            self._lines += 1
            return
        print(f"\r{text:<{self._width}}", end="", file=sys.stderr, flush=True)
        self._width = len(text)

    def clear(self) -> None:
        """Remove the line from the terminal; after lines, a last one says that it is over."""
        if self._lines:
            _print_line("compiling has ended")
            self._lines = 0
        if self._width:
            print(f"\r{'':<{self._width}}\r", end="", file=sys.stderr, flush=True)
            self._width = 0


def count_text(now: "Preparation") -> str:
    """What a person reads while kernels are compiled."""
    counted = f": {now.done} of {now.total}" if now.total else ""
    left = "" if now.left_s is None else f", about {max(1, round(now.left_s))} s left"
    return f"compiling kernels{counted}{left}"


def _print_line(text: str) -> None:
    if sys.stderr is not None:
        print(f"skyless: {text}", file=sys.stderr, flush=True)
