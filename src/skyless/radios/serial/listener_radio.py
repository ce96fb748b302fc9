"""A DWM1001 that runs the listener of uwb-apps: receptions as lines of JSON. It cannot transmit."""

import time
from collections import Counter
from collections.abc import Callable
from typing import Final

import msgspec

from skyless.air.codec import MAX_FRAME_BYTES
from skyless.air.reception import Diagnostics, Reception, Transmission
from skyless.radios.interface import Gone, Late, Listener, RadioEvent, Restarted
from skyless.radios.serial.board_clock import BoardClock
from skyless.radios.serial.serial_port import SerialPort, line_advice
from skyless.recordings.source import Drops, LineCutter
from skyless.ticks import wrap


class ListenerRadio:
    """One tag's ears (``skyless.radios.interface.Radio``)."""

    def __init__(self, path: str, baud: int, name: str) -> None:
        self.name = name
        self.counters: Counter[str] = Counter()
        self._port = SerialPort(path, baud, lambda reason: self._listener(Gone(reason)))
        self._listener: Listener = _nobody
        self._clock = BoardClock()
        self._lines = LineCutter(self.counters)
        self._whole = False
        self._silent = True

    async def run(self, listener: Listener) -> None:
        """Receive until cancelled; a board that is pulled out is looked for."""
        self._listener = listener
        await self._port.keep(self)

    def advice(self) -> str:
        """Where to look when nothing comes: the line, or who speaks on it."""
        return line_advice(self._port.path, self._port.baud, "the listener of uwb-apps", silent=self._silent)

    def now_ticks(self) -> int | None:
        """The board's counter, extrapolated from its newest stamps; None before the first."""
        return self._clock.read(time.monotonic())

    def transmit(self, transmission: Transmission) -> None:
        """It cannot: whatever it is, it is late."""
        self._listener(Late(transmission.tx_ticks))

    # What the port calls

    def begin(self, send: Callable[[bytes], None]) -> None:  # noqa: ARG002 - nothing is to be said
        """Listen from the next line on."""
        self._clock.forget()
        self._lines = LineCutter(self.counters)
        self._whole, self._silent = False, True
        self._port.forget_told()
        self._listener(Restarted())

    def hear(self, data: bytes) -> None:
        """Take what the board says; the first line may be the end of one."""
        host_s = time.monotonic()
        self._silent = False
        for line in self._lines.feed(data):
            drops = self.counters if self._whole else Counter()
            self._whole = True
            reception = reception_of(line, host_s, drops)
            if reception is not None:
                self._clock.hear(reception.rx_ticks, host_s)
                self._listener(reception)
                self._silent = True

    def end(self) -> None:
        """The board has gone."""
        self._clock.forget()


def _nobody(event: RadioEvent) -> None:
    pass


# Lines of the uwb-apps listener (Mynewt): one JSON object for each frame, as it was received.
#
# Used keys: ``ts`` (RX stamp), ``rssi`` (dBm), ``d`` (the whole PSDU, hexadecimal) and ``dlen``, its length.


class _Line(msgspec.Struct):
    """What a line must hold; further keys are of no interest."""

    ts: int
    dlen: int
    d: str
    rssi: float | None = None


_decode: Final = msgspec.json.Decoder(_Line).decode


def reception_of(line: bytes, host_s: float, drops: Drops) -> Reception | None:
    """Reception of a line that arrived then; None, and a count, for what is none."""
    if not line:
        return None
    try:
        told = _decode(line)
        frame = bytes.fromhex(told.d)
    except (msgspec.MsgspecError, ValueError):
        drops["malformed-line"] += 1
        return None
    if len(frame) != told.dlen or not 1 <= len(frame) <= MAX_FRAME_BYTES:
        drops["wrong-length"] += 1
        return None
    if told.ts < 0:
        drops["impossible-stamp"] += 1
        return None
    return Reception(frame, wrap(told.ts), host_s, Diagnostics(rx_power_dbm=told.rssi))
