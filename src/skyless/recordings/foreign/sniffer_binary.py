"""Binary stream of Bitcraze's sniffer (after it was sent ``b``), found again after garbage.

A record is ``BC | RX stamp 5 bytes | from u8 | to u8 | length u16 | payload | length u16``, little-endian. There is no
checksum: the length that is told twice is all that marks a record.
"""

from collections.abc import Iterator
from io import BufferedIOBase
from typing import Final

from skyless.air.masterless_packets import Packet
from skyless.recordings.foreign.bitcraze_payload import TDOA2, TDOA3, decode
from skyless.recordings.source import Drops, chunks

MAX_PAYLOAD_BYTES: Final = 1014
"""Of a long DW1000 frame, less the MAC header of at least 7 bytes and the check sequence."""

_MARK: Final = 0xBC
_HEADER_BYTES: Final = 10
_TRAILER_BYTES: Final = 2


def recognise(head: bytes, name: str) -> bool:
    """Tell whether a whole record of a known payload stands near the beginning."""
    del name
    at = head.find(_MARK)
    while at >= 0:
        if _size(head, at) and head[at + _HEADER_BYTES] in (TDOA2, TDOA3):
            return True
        at = head.find(_MARK, at + 1)
    return False


def read(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a stream; each stretch of bytes that belongs to no record is counted once."""
    cutter = BinaryCutter(drops)
    for chunk in chunks(stream, drops):
        yield from cutter.feed(chunk)
    yield from cutter.finish()


class BinaryCutter:
    """Cuts a stream that comes in pieces into packets, each as soon as it is whole."""

    def __init__(self, drops: Drops) -> None:
        self._drops = drops
        self._buffer = b""
        self._lost = False

    def feed(self, chunk: bytes) -> Iterator[Packet]:
        """Packets that are whole with this piece."""
        return self._packets(chunk, ended=False)

    def finish(self) -> Iterator[Packet]:
        """Packets behind a false start that promised more than came."""
        return self._packets(b"", ended=True)

    def _packets(self, chunk: bytes, *, ended: bool) -> Iterator[Packet]:
        for record in self._records(chunk, ended=ended):
            rx_ticks = int.from_bytes(record[1:6], "little")
            packet = decode(record[_HEADER_BYTES:-_TRAILER_BYTES], None, record[6], rx_ticks)
            if isinstance(packet, Packet):
                yield packet
            else:
                self._drops[packet] += 1

    def _records(self, chunk: bytes, *, ended: bool) -> list[bytes]:
        buffer, at, records = self._buffer + chunk, 0, []
        while at < len(buffer) and (ended or not _may_grow(buffer, at)):
            size = _size(buffer, at)
            if size:
                records.append(buffer[at : at + size])
                at += size
                self._lost = False
                continue
            if not self._lost:
                self._drops["bytes-of-no-record"] += 1
                self._lost = True
            following = buffer.find(_MARK, at + 1)
            at = following if following >= 0 else len(buffer)
        self._buffer = buffer[at:]
        return records


def _may_grow(buffer: bytes, at: int) -> bool:
    """Whether what stands there may be a record of which more is to come."""
    if buffer[at] != _MARK:
        return False
    left = len(buffer) - at
    if left < _HEADER_BYTES:
        return True
    length = buffer[at + 8] | buffer[at + 9] << 8
    return 1 <= length <= MAX_PAYLOAD_BYTES and left < _HEADER_BYTES + length + _TRAILER_BYTES


def _size(buffer: bytes, at: int) -> int:
    """Size of the whole record at that place, 0 where none stands."""
    left = len(buffer) - at
    if left <= _HEADER_BYTES + _TRAILER_BYTES or buffer[at] != _MARK:
        return 0
    length = buffer[at + 8] | buffer[at + 9] << 8
    size = _HEADER_BYTES + length + _TRAILER_BYTES
    if not 1 <= length <= MAX_PAYLOAD_BYTES or left < size:
        return 0
    return size if buffer[at + size - 2 : at + size] == buffer[at + 8 : at + 10] else 0
