"""The process that compiles one part: ``python -m skyless.preparation.worker module:function argument ...``.

It writes a line of JSON to standard output for every kernel that has been compiled, and ends when its standard input
does, so that it outlives nobody who waits for it.
"""

import os
import sys
from importlib import import_module
from threading import Thread
from typing import Final

import msgspec
from msgspec import Struct
from numba.core import event

from skyless.kernels.compiled import declared_kernels

_COMMON_S: Final = 0.15
_LONG_S: Final = {
    "estimator._process_frame": 4.3,
    "estimator._process": 4.1,
    "estimator._process_difference": 4.0,
    "estimator._track": 4.0,
    "measurements.own_reception": 2.1,
    "estimator._check_motion_and_faults": 1.5,
    "listening.receive_frame": 1.3,
    "faults.open_faults": 1.1,
    "faults._open_fault": 0.9,
    "levels.protect": 0.9,
    "locate.descend": 0.9,
}
"""Kernels that take long to compile, apart from the functions in them, on a core of 2024: only for the time left."""


class Count(Struct, frozen=True, array_like=True):
    """How far a part is."""

    done: int
    total: int
    """Kernels declared by the modules that have been imported so far."""
    share: float
    """Of the time that all of it takes."""


def _cost_s(kernel: str) -> float:
    return _LONG_S.get(".".join(kernel.rsplit(".", 2)[1:]), _COMMON_S)


class _Counting(event.Listener):
    """Writes a count whenever a kernel has been compiled; kernels that are loaded are not."""

    def __init__(self) -> None:
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
            spent_s, all_s = (sum(map(_cost_s, names)) for names in (self._done, declared))
            _write(Count(len(self._done), len(declared), spent_s / all_s))


def _write(count: Count) -> None:
    sys.stdout.write(msgspec.json.encode(count).decode() + "\n")
    sys.stdout.flush()


def _end_with_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


def main(run: str, *arguments: str) -> None:
    """Compile a part; each argument is a call of its own."""
    Thread(target=_end_with_input, daemon=True).start()
    event.register("numba:compile", _Counting())  # type: ignore[no-untyped-call]
    module, _, function = run.partition(":")
    compile_part = getattr(import_module(module), function)
    if not arguments:
        compile_part()
    for argument in arguments:
        compile_part(argument)


if __name__ == "__main__":
    main(*sys.argv[1:])
