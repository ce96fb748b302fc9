"""Boards with other firmware, which only listen: that of uwb-apps, the Bitcraze sniffer, and FiRa boards."""

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Final, Generic, TypeVar

import msgspec
from msgspec import structs

from skyless.core.air.frame import MAX_FRAME_BYTES, Diagnostics, Reception, Transmission
from skyless.core.air.masterless_packets import Packet
from skyless.core.ticks import wrap
from skyless.files import Drops, LineCutter
from skyless.radio.foreign.bitcraze import BinaryCutter, packets_of_lines, recognise_binary, recognise_text
from skyless.radio.foreign.fira import DtTag
from skyless.radio.foreign.uci import AnchorFrame
from skyless.radio.interface import Gone, Late, RadioEvent, Restarted, ignore
from skyless.radio.serial.serial_port import BoardClock, SerialPort, line_advice

ASK_BINARY: Final = b"b"
"""Makes a sniffer change from text to binary; one that cannot stays with text."""

UNDECIDED_BYTES: Final = 4096
"""The format is detected again after this many bytes without a packet."""

_Event = TypeVar("_Event")


class _ListeningBoard(ABC, Generic[_Event]):
    """Common base: a serial port from which events are read."""

    firmware = ""
    """The board's firmware, for messages."""

    def __init__(self, path: str, baud: int, name: str) -> None:
        self.name = name
        self.counters: Counter[str] = Counter()
        self.lead_s = 0.0
        self._port = SerialPort(path, baud, lambda reason: self._listener(Gone(reason)))
        self._listener: Callable[[_Event | Restarted | Gone], None] = ignore
        self._silent = True
        """Whether no byte has arrived since the last event."""

    async def run(self, listener: Callable[[_Event | Restarted | Gone], None]) -> None:
        """Receive until cancelled; an unplugged board is searched for."""
        self._listener = listener
        await self._port.run(self)

    def advice(self) -> str:
        """Where to look if nothing is received: the line, or what is at its other end."""
        return line_advice(self._port.path, self._port.baud, self.firmware, silent=self._silent)

    @abstractmethod
    def _start(self, send: Callable[[bytes], None]) -> None:
        """Prepare for the stream of a newly opened port."""

    @abstractmethod
    def _events(self, data: bytes, host_s: float) -> Iterator[_Event]:
        """Events completed by this piece of the stream."""

    # What the port calls

    def on_open(self, send: Callable[[bytes], None]) -> None:
        """Begin a new stream."""
        self._start(send)
        self._silent = True
        self._port.clear_report()
        self._listener(Restarted())

    def on_data(self, data: bytes) -> None:
        """Process a piece of the stream."""
        host_s = time.monotonic()
        self._silent = False
        for event in self._events(data, host_s):
            self._listener(event)
            self._silent = True

    def on_close(self) -> None:
        """The board has gone."""


class ListenerRadio(_ListeningBoard[RadioEvent]):
    """A DWM1001 with the listener of uwb-apps: receptions as lines of JSON (``skyless.radio.interface.Radio``)."""

    firmware = "the listener of uwb-apps"

    def __init__(self, path: str, baud: int, name: str) -> None:
        super().__init__(path, baud, name)
        self._clock = BoardClock()
        self._lines = LineCutter(self.counters)
        self._is_whole = False
        """Whether the next line is complete: the first may be the end of one."""

    def now_ticks(self) -> int | None:
        """The board's counter, extrapolated from its newest stamps; None before the first."""
        return self._clock.read(time.monotonic())

    def transmit(self, transmission: Transmission) -> None:
        """Report the frame as late, as the board cannot send."""
        self._listener(Late(transmission.tx_ticks))

    def _start(self, send: Callable[[bytes], None]) -> None:  # noqa: ARG002 - it takes no commands
        self._clock.reset()
        self._lines = LineCutter(self.counters)
        self._is_whole = False

    def _events(self, data: bytes, host_s: float) -> Iterator[Reception]:
        for line in self._lines.feed(data):
            drops = self.counters if self._is_whole else Counter()
            self._is_whole = True
            reception = reception_of(line, host_s, drops)
            if reception is not None:
                self._clock.update(reception.rx_ticks, host_s)
                yield reception

    def on_close(self) -> None:
        """The board has gone."""
        self._clock.reset()


class SnifferRadio(_ListeningBoard[Packet]):
    """A Bitcraze sniffer: packets of TDoA2 and TDoA3 systems, binary or text. It receives no beacons.

    Packets carry the host's monotonic time of arrival.
    """

    firmware = "a Bitcraze sniffer"

    def __init__(self, path: str, baud: int, name: str) -> None:
        super().__init__(path, baud, name)
        self._stream = SnifferStream(self.counters)

    def _start(self, send: Callable[[bytes], None]) -> None:
        self._stream = SnifferStream(self.counters)
        send(ASK_BINARY)

    def _events(self, data: bytes, host_s: float) -> Iterator[Packet]:
        for packet in self._stream.feed(data):
            yield structs.replace(packet, host_s=host_s)


class UciRadio(_ListeningBoard[Packet]):
    """A FiRa board in a running session as a DT-tag: its DL-TDoA measurements, as packets.

    Packets carry the host's monotonic time of arrival. Nothing is sent to the board: the program that
    started the session has configured it.
    """

    firmware = "FiRa's UCI with a DL-TDoA session that goes on"

    def __init__(self, path: str, baud: int, name: str, frame: AnchorFrame) -> None:
        super().__init__(path, baud, name)
        self.frame = frame
        self._tag = DtTag(self.counters, frame)

    def _start(self, send: Callable[[bytes], None]) -> None:  # noqa: ARG002 - it is sent nothing
        self._tag = DtTag(self.counters, self.frame)

    def _events(self, data: bytes, host_s: float) -> Iterator[Packet]:
        return self._tag.feed(data, host_s)


class SnifferStream:
    """Packets of a sniffer's stream, whose format is detected, and again when it changes."""

    def __init__(self, drops: Counter[str]) -> None:
        self._drops = drops
        self._head = b""
        self._unused_bytes = 0
        """Since the last packet."""
        self._lines = LineCutter(drops)
        self._binary = BinaryCutter(drops)
        self._is_text: bool | None = None

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Packets completed by this piece."""
        if self._is_text is None:
            data = self._determine(data)
        else:
            self._unused_bytes += len(data)
        for packet in self._packets(data):
            self._unused_bytes = 0
            yield packet
        if self._unused_bytes > UNDECIDED_BYTES:
            self._is_text, self._unused_bytes = None, 0

    def _determine(self, data: bytes) -> bytes:
        """The bytes to read in the detected format, or none until it is detected."""
        self._head += data
        text, binary = recognise_text(self._head), recognise_binary(self._head)
        if text or binary:
            data, self._head = self._head, b""
            self._is_text = text and not binary
            self._lines = LineCutter(self._drops)
            self._binary = BinaryCutter(self._drops)
            return data
        if len(self._head) > 2 * UNDECIDED_BYTES:
            self._drops["bytes-of-no-record"] += 1
            self._head = self._head[-UNDECIDED_BYTES:]
        return b""

    def _packets(self, data: bytes) -> Iterator[Packet]:
        if self._is_text:
            return packets_of_lines(self._lines.feed(data), self._drops)
        return self._binary.feed(data)


# Lines of the uwb-apps listener (Mynewt): one JSON object for each frame, as it was received.
#
# Used keys: ``ts`` (RX stamp), ``rssi`` (dBm), ``d`` (the whole PSDU, hexadecimal) and ``dlen``, its length.


class _Line(msgspec.Struct):
    """Required keys of a line; others are ignored."""

    ts: int
    dlen: int
    d: str
    rssi: float | None = None


_decode: Final = msgspec.json.Decoder(_Line).decode


def reception_of(line: bytes, host_s: float, drops: Drops) -> Reception | None:
    """The reception of a line that arrived at ``host_s``; None, counted, if it is none."""
    if not line:
        return None
    try:
        found = _decode(line)
        frame = bytes.fromhex(found.d)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        drops["malformed-line"] += 1
        return None
    if len(frame) != found.dlen or not 1 <= len(frame) <= MAX_FRAME_BYTES:
        drops["wrong-length"] += 1
        return None
    if found.ts < 0:
        drops["impossible-stamp"] += 1
        return None
    return Reception(frame, wrap(found.ts), host_s, Diagnostics(rx_power_dbm=found.rssi))
