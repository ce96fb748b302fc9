"""A Bitcraze sniffer: packets of TDoA2 and TDoA3 systems, binary or text. It hears no beacons and cannot transmit."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Final

from msgspec import structs

from skyless.air.masterless_packets import Packet
from skyless.radios.interface import Gone, Restarted
from skyless.radios.serial.serial_port import SerialPort, line_advice
from skyless.recordings.foreign.bitcraze import BinaryCutter, packet_of_line, recognise_binary, recognise_text
from skyless.recordings.source import LineCutter

PacketListener = Callable[[Packet | Restarted | Gone], None]

ASK_BINARY: Final = b"b"
"""What makes a sniffer change from text to binary; one that cannot stays with text."""

UNDECIDED_BYTES: Final = 4096
"""After so many bytes without a packet either form is looked for again."""


class SnifferStream:
    """Packets of a stream whose form is found out, and again when it changes."""

    def __init__(self, drops: Counter[str]) -> None:
        self._drops = drops
        self._head = b""
        self._in_vain = 0
        self._lines = LineCutter(drops)
        self._binary = BinaryCutter(drops)
        self._is_text: bool | None = None

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Packets that are whole with this piece."""
        if self._is_text is None:
            data = self._decide(data)
        else:
            self._in_vain += len(data)
        for packet in self._packets(data):
            self._in_vain = 0
            yield packet
        if self._in_vain > UNDECIDED_BYTES:
            self._is_text, self._in_vain = None, 0

    def _decide(self, data: bytes) -> bytes:
        """All bytes that are to be read in the form found, or none as long as none is found."""
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
        if not self._is_text:
            yield from self._binary.feed(data)
            return
        for line in self._lines.feed(data):
            packet = packet_of_line(line, self._drops)
            if packet is not None:
                yield packet


class SnifferRadio:
    """One tag's ears for packets."""

    def __init__(self, path: str, baud: int, name: str) -> None:
        self.name = name
        self.counters: Counter[str] = Counter()
        self._port = SerialPort(path, baud, lambda reason: self._listener(Gone(reason)))
        self._listener: PacketListener = _nobody
        self._stream = SnifferStream(self.counters)
        self._silent = True

    async def run(self, listener: PacketListener) -> None:
        """Receive until cancelled; packets carry the host's monotonic time of their arrival."""
        self._listener = listener
        await self._port.keep(self)

    def advice(self) -> str:
        """Where to look when nothing comes: the line, or who speaks on it."""
        return line_advice(self._port.path, self._port.baud, "a Bitcraze sniffer", silent=self._silent)

    # What the port calls

    def begin(self, send: Callable[[bytes], None]) -> None:
        """Ask for the binary form."""
        self._stream = SnifferStream(self.counters)
        self._silent = True
        self._port.forget_told()
        send(ASK_BINARY)
        self._listener(Restarted())

    def hear(self, data: bytes) -> None:
        """Take what the sniffer says."""
        host_s = time.monotonic()
        self._silent = False
        for packet in self._stream.feed(data):
            self._listener(structs.replace(packet, host_s=host_s))
            self._silent = True

    def end(self) -> None:
        """The sniffer has gone."""


def _nobody(event: Packet | Restarted | Gone) -> None:
    pass
