"""A radio on a board that speaks the serial link (``docs/serial.md``)."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable

from skyless.air.reception import Transmission
from skyless.radios.interface import AntennaDelays, Gone, Late, Listener, RadioEvent, Restarted
from skyless.radios.serial.link_session import POLL_S, LinkSession
from skyless.radios.serial.serial_port import SerialPort


class SerialRadio:
    """One node's board (``skyless.radios.interface.Radio``)."""

    def __init__(
        self, path: str, baud: int, name: str, delays: AntennaDelays | None = None, *, transmits: bool = False
    ) -> None:
        """``transmits``: only a board that can do so will do."""
        self.name = name
        self.counters: Counter[str] = Counter()
        self._delays = AntennaDelays() if delays is None else delays
        self._transmits = transmits
        self._port = SerialPort(path, baud, lambda reason: self._listener(Gone(reason)))
        self._listener: Listener = _nobody
        self._session: LinkSession | None = None

    async def run(self, listener: Listener) -> None:
        """Receive until cancelled; a board that is pulled out is looked for."""
        self._listener = listener
        poll = asyncio.ensure_future(self._poll())
        try:
            await self._port.keep(self)
        finally:
            poll.cancel()
            await asyncio.gather(poll, return_exceptions=True)

    def advice(self) -> str:
        """Where to look when nothing comes though the board answers."""
        return (
            f"the board at {self._port.path} answers, but hears no frame: are anchors on the air, is its antenna free?"
        )

    def now_ticks(self) -> int | None:
        """The board's counter, extrapolated from its newest stamps; None while it is not ready."""
        session = self._session
        return session.clock.read(time.monotonic()) if session is not None and session.ready else None

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame; without a board it is late."""
        if self._session is None:
            self._listener(Late(transmission.tx_ticks))
        else:
            self._session.transmit(transmission)

    # What the port calls

    def begin(self, send: Callable[[bytes], None]) -> None:
        """Greet the board."""
        place, told = self._port.path, self._tell
        self._session = LinkSession(place, self._delays, send, told, self.counters, transmits=self._transmits)
        self._session.begin(time.monotonic())

    def hear(self, data: bytes) -> None:
        """Take what the board says."""
        if self._session is not None:
            self._session.hear(data, time.monotonic())

    def end(self) -> None:
        """The board has gone."""
        self._session = None

    def _tell(self, event: RadioEvent) -> None:
        if isinstance(event, Restarted):
            self._port.forget_told()
        self._listener(event)

    async def _poll(self) -> None:
        while True:
            await asyncio.sleep(POLL_S)
            if self._session is not None:
                reason = self._session.poll(time.monotonic())
                if reason is not None:
                    self._port.give_up(reason)


def _nobody(event: RadioEvent) -> None:
    pass
