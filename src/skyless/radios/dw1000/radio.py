"""A DW1000 on SPI, or a model of one, driven by this process."""

import asyncio
import time
from collections import Counter
from typing import Final

from skyless.air.reception import Transmission
from skyless.constants import TICK_S
from skyless.firmware.dw1000 import Bus, ChipError
from skyless.radios.dw1000.chip_ports import Port
from skyless.radios.dw1000.chip_session import ChipSession
from skyless.radios.interface import AntennaDelays, Gone, Hint, Late, Listener, RadioEvent, Restarted
from skyless.ticks import difference

CARE_S: Final = 1.0
"""After so long a chip from which nothing came is asked whether it still has its settings."""


class Dw1000Radio:
    """One node's chip (``skyless.radios.interface.Radio``)."""

    def __init__(self, port: Port, name: str, delays: AntennaDelays) -> None:
        self.name = name
        self.counters: Counter[str] = Counter()
        self._port, self._delays = port, delays
        self._listener: Listener = _nobody
        self._session: ChipSession | None = None
        self._told = ""
        self._heard = False
        self._remarked: set[str] = set()
        self._trouble: Exception | None = None
        self._timer: asyncio.TimerHandle | None = None

    async def run(self, listener: Listener) -> None:
        """Receive until cancelled; a chip that does not answer is looked for."""
        self._listener = listener
        care = asyncio.ensure_future(self._care())
        try:
            await self._port.keep(self)
        finally:
            care.cancel()
            self._forget()

    def advice(self) -> str:
        """Where to look when nothing comes though the chip answers."""
        return "the DW1000 answers, but hears no frame: are anchors on the air, is its antenna free?"

    def now_ticks(self) -> int | None:
        """The chip's counter, read over the bus; None while it is not ready."""
        try:
            return None if self._session is None else self._session.read_ticks()
        except OSError:
            return None

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame; without a chip it is late."""
        session = self._session
        if session is None:
            self._listener(Late(transmission.tx_ticks))
            return
        try:
            session.transmit(transmission, time.monotonic())
            self._watch(session)
        except OSError:
            self._listener(Late(transmission.tx_ticks))

    def _watch(self, session: ChipSession) -> None:
        """Look after a frame whose end is not told."""
        overdue, now = session.overdue_ticks, session.read_ticks()
        if overdue is not None and now is not None:
            if self._timer is not None:
                self._timer.cancel()
            wait_s = max(difference(overdue, now) * TICK_S, 0.0)
            self._timer = asyncio.get_running_loop().call_later(wait_s, self._give_up, session)

    def _give_up(self, session: ChipSession) -> None:
        overdue, now = session.overdue_ticks, self.now_ticks()
        if session is self._session and overdue is not None and now is not None and difference(now, overdue) >= 0:
            try:
                session.give_up()
            except OSError as error:
                self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Have the port, which does not know it yet, look for the chip anew."""
        self._session, self._trouble = None, error

    # What the port calls

    def begin(self, bus: Bus) -> None:
        """Start the chip. Raises OSError and ChipError."""
        self._forget()
        self._trouble = None
        session = ChipSession(bus, self._delays, self._hear, self.counters)
        session.start()
        self._session, self._told = session, ""
        self._listener(Restarted())

    def wake(self) -> bool:
        """Take what it has to tell, False for nothing; start a chip again that has lost its settings.

        Raises OSError and ChipError.
        """
        trouble, self._trouble = self._trouble, None
        if trouble is not None:
            raise trouble
        session = self._session
        if session is not None and not session.serve(time.monotonic()):
            self._revive(session)
        return session is not None and not session.idle

    def remark(self, counter: str, text: str) -> None:
        """Count what is wrong with its wires, and say so once until the chip is started anew."""
        self.counters[counter] += 1
        if counter not in self._remarked:
            self._remarked.add(counter)
            self._listener(Hint(text))

    def _revive(self, session: ChipSession) -> None:
        self._lose("the DW1000 has lost its configuration; is its supply good?")
        session.start()
        self._session = session
        self._listener(Restarted())

    async def _care(self) -> None:
        """Look after a chip that says nothing: one whose supply failed may have come up again unseen."""
        while True:
            await asyncio.sleep(CARE_S)
            session, self._heard = self._session if not self._heard else None, False
            try:
                if session is not None and not session.is_alive():
                    self._revive(session)
            except (OSError, ChipError) as error:
                self._fail(error)

    def end(self, reason: str) -> None:
        """It is out of reach; each reason is told once."""
        self._forget()
        self._lose(reason)

    def _lose(self, reason: str) -> None:
        self._session = None
        if reason != self._told:
            self._told = reason
            self._listener(Gone(reason))

    def _forget(self) -> None:
        self._session = None
        if self._timer is not None:
            self._timer.cancel()

    def _hear(self, event: RadioEvent) -> None:
        self._heard = True
        self._listener(event)


def _nobody(event: RadioEvent) -> None:
    pass
