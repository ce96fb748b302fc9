"""The process that compiles one part: ``python -m skyless.core.kernels.worker module:function argument ...``.

For every kernel that has been compiled it writes to standard output how many are, of how many that the modules imported
so far declare. It ends when its standard input does, so that it outlives nobody who waits for it.
"""

import os
import sys
from collections.abc import Callable
from importlib import import_module
from threading import Thread

from numba.core import event

from skyless.core.kernels.compiled import declared_kernels


class _Counting(event.Listener):
    """Counts the kernels that are compiled; those that are loaded are none."""

    def __init__(self, write: Callable[[int, int], None]) -> None:
        self._write = write
        self._done: set[str] = set()

    def on_start(self, event: event.Event) -> None:
        """See numba."""

    def on_end(self, event: event.Event) -> None:
        """See numba."""
        function = event.data["dispatcher"].py_func
        name = f"{function.__module__}.{function.__qualname__}"
        declared = declared_kernels()
        if name in declared and name not in self._done:
            self._done.add(name)
            self._write(len(self._done), len(declared))


def _end_with_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


def main(run: str, *arguments: str) -> None:
    """Compile a part; each argument is a call of its own."""
    Thread(target=_end_with_input, daemon=True).start()
    counts = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the run itself prints

    def write(done: int, total: int) -> None:
        print(f"[{done},{total}]", file=counts, flush=True)

    event.register("numba:compile", _Counting(write))  # type: ignore[no-untyped-call]
    module, _, function = run.partition(":")
    compile_part = getattr(import_module(module), function)
    if not arguments:
        compile_part()
    for argument in arguments:
        compile_part(argument)


if __name__ == "__main__":
    main(*sys.argv[1:])
