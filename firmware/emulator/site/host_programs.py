"""Programs of hosts in the simulated world, and the time that they take."""

import random
import threading
from collections.abc import Callable
from typing import Any

from msgspec import Struct

from skyless.core.ticks import from_seconds
from skyless.sim.medium import Timeline


class HostLatency(Struct, frozen=True):
    """What a transfer costs a host, in s, besides its bits: evenly between two values, and now and then a long pause.

    The defaults are those of CPython on a Raspberry Pi over spidev.
    """

    least_s: float = 20e-6
    most_s: float = 100e-6
    spike_probability: float = 2e-4
    """Chance that a transfer takes up to ``spike_s``: another process, a page fault."""
    spike_s: float = 5e-3
    work_s: float = 0.2e-3
    """What Python takes to decode a frame, or to make one (assumed)."""

    def draw(self, generator: random.Random) -> float:
        """One transfer's time."""
        if generator.random() < self.spike_probability:
            return generator.uniform(self.most_s, self.spike_s)
        return generator.uniform(self.least_s, self.most_s)


class _EndedError(BaseException):
    """Unwinds a program whose world is closed."""


class Process:
    """A program that takes time in the simulated world, in the order of true time.

    It is a thread, so that a driver can be what it is on a computer: plain calls that return later. Only one thread
    runs at any moment, and which one is decided by the timeline alone, so that runs repeat themselves.
    """

    def __init__(self, timeline: Timeline[Any], program: Callable[[], None]) -> None:
        self._timeline = timeline
        self._go, self._back = threading.Lock(), threading.Lock()
        self._go.acquire()
        self._back.acquire()
        self._serial = 0
        self._waits = self._notified = self._ended = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._main, args=(program,), daemon=True)
        self._thread.start()
        timeline.at(timeline.now_ticks, self._resume)

    def _main(self, program: Callable[[], None]) -> None:
        self._go.acquire()
        try:
            if not self._ended:
                program()
        except _EndedError:
            pass
        except BaseException as error:  # noqa: BLE001 - raised to the caller of the timeline
            self._error = error
        self._ended = True
        self._back.release()

    def _resume(self) -> None:
        """Let the program go on until it lets time pass again."""
        if self._ended:
            return
        self._go.release()
        self._back.acquire()
        if self._error is not None:
            raise self._error

    def _pause(self) -> None:
        self._back.release()
        self._go.acquire()
        if self._ended:
            raise _EndedError

    def sleep(self, seconds: float) -> None:
        """Let true time pass; to be called by the program."""
        until = self._timeline.now_ticks + from_seconds(seconds)
        if not self._timeline.pass_to(until):
            self._timeline.at(until, self._resume)
            self._pause()

    def wait(self, seconds: float) -> None:
        """Let true time pass until the program is notified, at most ``seconds``; to be called by the program."""
        if self._notified:
            self._notified = False
            return
        self._waits = True
        self._serial += 1
        serial = self._serial
        self._timeline.at(self._timeline.now_ticks + from_seconds(seconds), lambda: self._wake(serial))
        self._pause()

    def notify(self) -> None:
        """Something has happened; a program that does not wait is woken at once when it waits next."""
        if self._waits:
            serial = self._serial
            self._timeline.at(self._timeline.now_ticks, lambda: self._wake(serial))
        else:
            self._notified = True

    def _wake(self, serial: int) -> None:
        if self._waits and serial == self._serial:
            self._waits = False
            self._resume()

    def close(self) -> None:
        """End the program where it stands."""
        if not self._ended:
            self._ended = True
            self._go.release()
            self._thread.join()
