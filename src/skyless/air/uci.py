"""UCI, the command interface of FiRa radios: packets of a byte stream.

A control packet is ``type 3 bits, boundary 1, group 4 | 2 reserved, opcode 6 | reserved u8 | length u8 | payload``, a
data packet ``type, boundary, format | reserved u8 | length u16 | payload``. A set boundary bit means that the payload
goes on in the next packet of the same kind. There is no checksum: only what the header reserves shows that bytes are
none.

Read off, as facts: AOSP ``external/uwb`` (uci_packets.pdl and the parsers next to it, whose tests' bytes serve our
tests) and Qorvo's client for QM35. The specification itself is for members of FiRa only.
"""

from collections import Counter
from enum import IntEnum
from typing import Final

from msgspec import Struct

MAX_SEGMENT_BYTES: Final = 255
"""Of the payload of a control packet."""

MAX_UCI_PAYLOAD_BYTES: Final = 1 << 16
"""Of a payload in segments, beyond which it is dropped, ..."""

MAX_DATA_BYTES: Final = 4096
"""... and of a data packet, beyond which the header is taken to be none."""

CONTROL_HEADER_BYTES: Final = 4

_GROUPS: Final = frozenset((0, 1, 2, 3, 9, 10, 11, 12, 13, 14, 15))


class UciType(IntEnum):
    """What a packet is."""

    DATA = 0
    COMMAND = 1
    RESPONSE = 2
    NOTIFICATION = 3


class UciPacket(Struct, frozen=True, gc=False):
    """One packet, its segments put together."""

    kind: UciType
    group: int
    """Group of a control packet, format of a data packet; 4 bits."""
    opcode: int
    """6 bits; 0 for a data packet."""
    payload: bytes


def encode_packet(packet: UciPacket) -> bytes:
    """A control packet's bytes, in segments where it is long."""
    payload = packet.payload
    parts = [payload[at : at + MAX_SEGMENT_BYTES] for at in range(0, len(payload), MAX_SEGMENT_BYTES)] or [b""]
    out = bytearray()
    for number, part in enumerate(parts, start=1):
        goes_on = number < len(parts)
        out += bytes((packet.kind << 5 | goes_on << 4 | packet.group, packet.opcode, 0, len(part))) + part
    return bytes(out)


class UciReader:
    """Cuts a stream that comes in pieces into packets; a stretch of bytes that belongs to none is counted once."""

    def __init__(self, drops: Counter[str]) -> None:
        self._drops = drops
        self._buffer = b""
        self._lost = False
        self._begun: tuple[int, int, int] | None = None
        self._segments = bytearray()

    def feed(self, data: bytes) -> list[UciPacket]:
        """Packets that are whole with this piece."""
        buffer, at, packets = self._buffer + data, 0, []
        while len(buffer) - at >= CONTROL_HEADER_BYTES:
            size = _packet_size(buffer, at)
            if size == 0:
                if not self._lost:
                    self._drops["bytes-of-no-packet"] += 1
                    self._lost = True
                at += 1
                continue
            if at + size > len(buffer):
                break
            self._lost = False
            packet = self._join(buffer[at : at + size])
            if packet is not None:
                packets.append(packet)
            at += size
        self._buffer = buffer[at:]
        return packets

    def _join(self, segment: bytes) -> UciPacket | None:
        """The packet that this segment completes."""
        kind, opcode = segment[0] >> 5, 0 if segment[0] >> 5 == UciType.DATA else segment[1]
        key = (kind, segment[0] & 0xF, opcode)
        if self._begun is not None and self._begun != key:
            self._drops["unfinished-packet"] += 1
            self._segments.clear()
        self._begun = key
        self._segments += segment[CONTROL_HEADER_BYTES:]
        if len(self._segments) > MAX_UCI_PAYLOAD_BYTES:
            self._drops["overlong-packet"] += 1
            self._begun = None
            self._segments.clear()
            return None
        if segment[0] & 0x10:
            return None
        payload = bytes(self._segments)
        self._begun = None
        self._segments.clear()
        return UciPacket(UciType(kind), key[1], opcode, payload)


def _packet_size(buffer: bytes, at: int) -> int:
    """Size of the segment whose header is at that offset; 0 where no header can be."""
    first, second, third, fourth = buffer[at : at + CONTROL_HEADER_BYTES]
    kind = first >> 5
    if kind == UciType.DATA:
        length = third | fourth << 8
        return CONTROL_HEADER_BYTES + length if first & 0xF and second == 0 and 0 < length <= MAX_DATA_BYTES else 0
    if kind > UciType.NOTIFICATION or first & 0xF not in _GROUPS or second > 0x3F or third != 0:
        return 0
    return CONTROL_HEADER_BYTES + fourth
