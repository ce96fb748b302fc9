"""The tiers of tests, which a file has, and what a unit test may not do."""

import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

TIERS = {
    "unit": "no process, no socket, no compiler, and a second of the processor at most; tests without a marker",
    "site": "simulates a site, runs a command, or starts a program",
    "live": "a whole site of processes in real time, one test after the other",
    "statistical": "Monte Carlo, long fuzzing, heavy clients such as browsers: what takes more than some two seconds",
}
_TIER = f"({'|'.join(TIERS)})"
_TIER_OF_FILE = re.compile(rf"^pytestmark = (?:\[[^\]]*)?\bpytest\.mark\.{_TIER}\b", re.MULTILINE)
"""A file's marker, alone or in a list of several."""
_MARKED = re.compile(rf"\bpytest\.mark\.{_TIER}\b")


def file_tiers(text: str) -> set[str]:
    """Tiers of the tests in a file, by its text: some more than there are, and none less."""
    return set(_MARKED.findall(text)) | (set() if _TIER_OF_FILE.search(text) else {"unit"})


_OUTSIDE = {"subprocess.Popen", "os.posix_spawn", "os.fork", "os.exec", "os.system", "socket.bind", "socket.connect"}
"""Python's audit events of starting a process (a compiler, too) and of using a socket."""
LONG = "seconds of the processor"
_LIMIT_S = 1.0
_CERTAINLY = 10.0
"""Tests above the limit are listed; those that take this many times the limit are refused. Between the two a test may
be the first that needs what is made once, such as Matplotlib or Hypothesis's strategies: up to 3 s."""
_LOOP_S = 0.04
"""What ``_loop`` takes on the machine on which the limit is meant: a core of a usual cloud server."""


def _loop() -> float:
    began_s = time.process_time()
    sum(number * number % 7 for number in range(400_000))
    return time.process_time() - began_s


class UnitTests:
    """Refuses what unit tests may not do."""

    def __init__(self) -> None:
        self._running: str | None = None
        self._slowness = min(_loop() for _ in range(3)) / _LOOP_S
        sys.addaudithook(self._refuse)

    def _refuse(self, event: str, _: object) -> None:
        if self._running is not None and event in _OUTSIDE:
            pytest.fail(f"{event} in a unit test: it needs the mark pytest.mark.site (tests/support/tiers.py)")

    @contextmanager
    def running(self, name: str) -> Iterator[None]:
        """While a unit test and its fixtures run."""
        self._running = name
        try:
            yield
        finally:
            self._running = None

    @contextmanager
    def called(self, properties: list[tuple[str, object]]) -> Iterator[None]:
        """While a unit test itself runs; one above the limit gets ``LONG`` as a property of its report.

        What is traced, or runs as Python instead of C, is not judged.
        """
        began_s = time.process_time()
        yield
        took_s = (time.process_time() - began_s) / self._slowness
        if sys.gettrace() is not None or os.environ.get("SKYLESS_UNCOMPILED") == "1":
            return
        if took_s > _LIMIT_S:
            properties.append((LONG, took_s))
        if took_s > _LIMIT_S * _CERTAINLY:
            pytest.fail(f"{took_s:.1f} s of the processor for a unit test: it needs the mark pytest.mark.site")
