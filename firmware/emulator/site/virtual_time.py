"""An asyncio loop whose time is a simulated medium's: programs run unchanged, and every run of a seed is the same.

While files are ready or callbacks wait no time passes; else the timeline runs on to the next timer, or to an event
that has something for the programs (``wake``). What is done in threads elsewhere (``run_in_executor``) is done at once.
Pseudo-terminals are asked with poll(), which first delivers what was written at their other ends (Linux; epoll() waits
for a kernel thread).
"""

import asyncio
import selectors
import time
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager
from typing import Any, Final, TypeVar
from unittest import mock

from skyless.core.ticks import TICK_S, from_seconds
from skyless.sim.medium import Timeline

UNIX_S: Final = 1_800_000_000.0
"""``time.time()`` at the timeline's beginning."""

Value = TypeVar("Value")


def wake(timeline: Timeline[Any]) -> None:
    """Let the programs run at the present instant: something has come for them."""
    timeline.at(timeline.now_ticks, lambda: True)


class TimelineSelector(selectors.PollSelector):
    """Files are asked and never waited for: instead of waiting the timeline runs on."""

    def __init__(self, timeline: Timeline[Any]) -> None:
        super().__init__()
        self._timeline = timeline

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Files that are ready, after at most ``timeout`` s of the timeline.

        Raises:
            RuntimeError: nothing will ever happen.
        """
        ready = super().select(0)
        timeline = self._timeline
        if ready or (timeout is not None and timeout <= 0.0):
            return ready
        if timeout is not None:
            until = timeline.now_ticks + from_seconds(timeout)
        elif timeline.next_ticks is not None:
            until = timeline.next_ticks
        else:
            raise RuntimeError("all programs wait for something that will never happen")
        next(timeline.run(until), None)  # up to the first event that has something for the programs
        return super().select(0)


class TimelineLoop(asyncio.SelectorEventLoop):
    """The loop on a timeline."""

    def __init__(self, timeline: Timeline[Any]) -> None:
        self._timeline = timeline
        super().__init__(TimelineSelector(timeline))

    def time(self) -> float:
        """The timeline's present in s."""
        return self._timeline.now_ticks * TICK_S

    def run_in_executor(  # type: ignore[override]
        self, _executor: object, func: Callable[..., Value], *args: object
    ) -> asyncio.Future[Value]:
        """Do it here and at once, because a thread would take another time in each run."""
        done: asyncio.Future[Value] = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 - for whoever awaits it
            done.set_exception(error)
        return done


def timeline_clocks(timeline: Timeline[Any]) -> AbstractContextManager[object]:
    """Let the clocks of the module ``time`` show the timeline's time."""

    def now_s() -> float:
        return timeline.now_ticks * TICK_S

    return mock.patch.multiple(
        time,
        monotonic=now_s,
        monotonic_ns=lambda: round(now_s() * 1e9),
        time=lambda: UNIX_S + now_s(),
        time_ns=lambda: round((UNIX_S + now_s()) * 1e9),
    )


def run_on(timeline: Timeline[Any], main: Coroutine[Any, Any, Value]) -> Value:
    """Run a program, and all that it starts, on the timeline until it ends."""
    with timeline_clocks(timeline), asyncio.Runner(loop_factory=lambda: TimelineLoop(timeline)) as runner:
        return runner.run(main)
