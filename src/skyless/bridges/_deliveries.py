"""Delivery of alarm messages to one receiver: each is retried until it is accepted, refused or too old.

Attempts block and run in a thread of their own, one at a time. A receiver that hangs, refuses or is slow delays only
its own messages.
"""

import asyncio
import contextlib
import os
import random
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Final, Literal

from msgspec import Struct

from skyless.bridges.target import BridgedSite, Target
from skyless.core.errors import SkylessError
from skyless.run.mqtt.messages import AlarmMessage
from skyless.run.web import BRIDGES as LIMITS

TIMEOUT_S: Final = 10.0
"""For one whole attempt."""

FIRST_PAUSE_S: Final = 1.0
LONGEST_PAUSE_S: Final = 300.0
KEPT_S: Final = 86_400.0
"""An undelivered message is dropped after this time."""

LAST_S: Final = 3.0
"""For everything that waits when the bridge stops."""

_MAX_KNOWN: Final = 10_000
_OTHERS: Final = 0o077

What = Literal["raised", "ended", "acknowledged"]


class RefusedError(Exception):
    """The receiver will never accept this message."""


class Delivery(Struct, eq=False):
    """A message about an alarm, until it is delivered."""

    what: What
    alarm: AlarmMessage
    since_s: float
    due_s: float
    pause_s: float
    reached: set[str] = set()
    """Recipients who have accepted a mail to several people, and do not get it again."""

    @property
    def key(self) -> str:
        """The same for each attempt, also in another run of the bridge."""
        return f"{self.alarm.id}/{self.what}"


Open = Callable[[socket.socket | None], None]
"""Called with the socket of an attempt, which is closed when its time is over."""


class AlarmTarget(Target):
    """Base of targets that get changes of alarms. ``attempt`` is called in a thread."""

    def __init__(self, text: str, log: Callable[[str], None], kinds: frozenset[What]) -> None:
        """``kinds``: the changes to deliver."""
        super().__init__(text)
        self.site: BridgedSite | None = None
        self.delivered = 0
        self._log, self._kinds = log, kinds
        self._waiting: list[Delivery] = []
        self._known: dict[str, list[What]] = {}
        self._started_unix_s = time.time()
        self._trouble = ""
        self._wake = asyncio.Event()

    def attempt(self, delivery: Delivery, on_open: Open) -> None:
        """Deliver once. Raises RefusedError if retrying is pointless, OSError if it is not."""
        raise NotImplementedError

    def on_site(self, site: BridgedSite) -> None:
        self.site = site

    def on_alarm(self, alarm: AlarmMessage) -> None:
        """Process an alarm's state. Of those from before the start, only active unacknowledged ones are new."""
        states = _states(alarm)
        known = self._known.pop(alarm.id, None)
        self._known[alarm.id] = states
        if len(self._known) > _MAX_KNOWN:
            del self._known[next(iter(self._known))]
        if known is None and len(states) > 1 and alarm.unix_s < self._started_unix_s:
            return
        now_s = time.monotonic()
        for what in states:
            if what in self._kinds and what not in (known or ()):
                self._waiting.append(Delivery(what, alarm, now_s, now_s, FIRST_PAUSE_S))
        while len(self._waiting) > LIMITS.deliveries:
            del self._waiting[0]
            self.dropped["too-many"] += 1
        self._wake.set()

    async def run(self) -> None:
        """Deliver until cancelled, then try everything that waits once more."""
        try:
            await self._deliver()
        except asyncio.CancelledError:
            await self._try_all()
            raise

    async def _deliver(self) -> None:
        while True:
            self._wake.clear()
            now_s = time.monotonic()
            while self._waiting and now_s - self._waiting[0].since_s > KEPT_S:
                del self._waiting[0]
                self.dropped["too-old"] += 1
            first = self._next()
            if first is not None and first.due_s <= now_s:
                await self._try(first)
                continue
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), None if first is None else first.due_s - now_s)

    async def _try_all(self) -> None:
        failed = set()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_S):
                for one in tuple(self._waiting):
                    if one.alarm.id not in failed:
                        await self._try(one)
                    if one in self._waiting:
                        failed.add(one.alarm.id)
        if self._waiting:
            self.dropped["stopped"] += len(self._waiting)
            self._log(f"{self.text}: stopped; messages that were not delivered: {len(self._waiting)}")

    def _next(self) -> Delivery | None:
        """The message to send next. Those about the same alarm keep their order."""
        firsts: dict[str, Delivery] = {}
        for one in self._waiting:
            firsts.setdefault(one.alarm.id, one)
        return min(firsts.values(), key=lambda one: one.due_s, default=None)

    async def _try(self, one: Delivery) -> None:
        try:
            await _in_thread(lambda on_open: self.attempt(one, on_open))
        except RefusedError as error:
            self.dropped["refused"] += 1
            self._report(f"refused: {error}")
        except Exception as error:  # noqa: BLE001 - whatever it is, it is tried again
            self._report(f"cannot be reached: {error or type(error).__name__}")
            one.due_s = time.monotonic() + one.pause_s * random.uniform(0.5, 1.0)
            one.pause_s = min(2.0 * one.pause_s, LONGEST_PAUSE_S)
            return
        else:
            self.delivered += 1
            self._report("")
        if one in self._waiting:  # it may have been dropped meanwhile
            self._waiting.remove(one)

    def _report(self, trouble: str) -> None:
        """Log a fault when it begins and when it is over."""
        if trouble != self._trouble:
            self._trouble = trouble
            self._log(f"{self.text}: {trouble[:240] or 'delivered again'}")


def _states(alarm: AlarmMessage) -> list[What]:
    times: dict[What, float | None] = {"raised": alarm.unix_s}
    times |= {"acknowledged": alarm.acknowledged_unix_s, "ended": alarm.ended_unix_s}
    return [what for what, at in times.items() if at is not None]


async def _in_thread(work: Callable[[Open], None]) -> None:
    """Run blocking work in a daemon thread, for at most ``TIMEOUT_S``."""
    done: Future[None] = Future()
    done.set_running_or_notify_cancel()
    sockets: list[socket.socket | None] = []

    def run() -> None:
        try:
            work(sockets.append)
        except Exception as error:  # noqa: BLE001 - the caller decides
            done.set_exception(error)
        else:
            done.set_result(None)

    threading.Thread(target=run, daemon=True, name="skyless-delivery").start()
    try:
        async with asyncio.timeout(TIMEOUT_S):
            await asyncio.wrap_future(done)
    except TimeoutError:
        raise TimeoutError(f"no answer within {TIMEOUT_S:g} s") from None
    finally:
        for one in filter(None, sockets):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)  # which ends the thread


def read_secret(text: str, key: str, name: str) -> str:
    """The first line of a file readable only by its owner. Raises SkylessError."""
    path = Path(name)
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode & 0o777
            secret = file.read(4096).decode(errors="replace").partition("\n")[0].strip()
    except OSError as error:
        raise SkylessError(f"the target {text!r} has {key}={name}, which cannot be read: {error.strerror}") from None
    if mode & _OTHERS or not secret:
        right = "a line of text" if not secret else f"readable by its owner only: chmod 600 {path}"
        raise SkylessError(f"the target {text!r} has {key}={name}, which has mode {mode:03o}; it should be {right}")
    return secret
