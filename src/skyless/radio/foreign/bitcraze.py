"""Bitcraze's loco positioning system: payloads of its anchors, and streams of its sniffers."""

import re
from collections.abc import Iterable, Iterator
from io import BufferedIOBase
from math import isfinite
from struct import Struct as Layout
from typing import Final

from skyless.core.air.masterless_packets import Packet, Point, Relay
from skyless.core.ticks import TICK_M
from skyless.files import Drops, chunks, lines

# Payloads of Bitcraze's loco positioning anchors, TDoA2 and TDoA3, to packets.
#
# Both are little-endian and hold the low 32 bits of all stamps. Distances are times of flight in ticks that include
# the antenna delays. Either may be followed by a short LPP packet with the anchor's position.
#
# TDoA2, type 0x22: sequence u8 × 8 | stamp u32 × 8 | distance u16 × 8, indexed by anchor. The sender's own stamp is the
# TX time; the others are when it last heard that anchor, 0 for never.
#
# TDoA3, type 0x30: sequence (7 bits) | TX time u32 | count, then count times: anchor | sequence (7 bits) with the high
# bit set if a distance follows | RX time u32 | distance u16, if any.

TDOA2: Final = 0x22
TDOA3: Final = 0x30
STAMP_BITS: Final = 32

ANTENNA_DELAYS_TICKS: Final = round(154.6 / TICK_M)
"""Sum of a sender's and a receiver's antenna delays, which stamps include: 154.6 m in the Crazyflies' firmware."""

_TDOA2: Final = Layout("<B8B8I8H")
_TDOA3_HEAD: Final = Layout("<BBIB")
_TDOA3_RELAY: Final = Layout("<BBI")
_TDOA3_RANGED: Final = Layout("<BBIH")
_POSITION: Final = Layout("<BBfff")
_LPP_SHORT: Final = 0xF0
_LPP_POSITION: Final = 0x01
_HAS_DISTANCE: Final = 0x80
_FARTHEST_M: Final = 1e5


def decode_payload(payload: bytes, host_s: float | None, sender: int, rx_ticks: int) -> Packet | str:
    """Decode a payload to a packet, or return the reason why it is none."""
    if not payload:
        return "empty-payload"
    if payload[0] == TDOA3:
        return _tdoa3(payload, host_s, sender, rx_ticks)
    if payload[0] == TDOA2:
        return _tdoa2(payload, host_s, sender, rx_ticks)
    return "foreign-payload"


def _tdoa3(payload: bytes, host_s: float | None, sender: int, rx_ticks: int) -> Packet | str:
    size = len(payload)
    if size < _TDOA3_HEAD.size:
        return "short-payload"
    _, sequence, tx_ticks, count = _TDOA3_HEAD.unpack_from(payload)
    at = _TDOA3_HEAD.size
    relays = []
    for _ in range(count):
        has_distance = at + 1 < size and payload[at + 1] & _HAS_DISTANCE
        layout = _TDOA3_RANGED if has_distance else _TDOA3_RELAY
        if at + layout.size > size:
            return "short-payload"
        anchor, flags, stamp, *distance = layout.unpack_from(payload, at)
        relays.append(Relay(anchor, flags & 0x7F, stamp, distance[0] if any(distance) else None))
        at += layout.size
    position_m = _position(payload, at) if at < size else None
    return Packet(host_s, sender, sequence & 0x7F, tx_ticks, rx_ticks, tuple(relays), position_m)


def _tdoa2(payload: bytes, host_s: float | None, sender: int, rx_ticks: int) -> Packet | str:
    if len(payload) < _TDOA2.size:
        return "short-payload"
    if sender > 7:
        return "sender-unknown"
    values = _TDOA2.unpack_from(payload)
    sequences, stamps, distances = values[1:9], values[9:17], values[17:25]
    relays = tuple(
        Relay(anchor, sequences[anchor], stamp, distances[anchor] or None)
        for anchor, stamp in enumerate(stamps)
        if stamp and anchor != sender
    )
    position_m = _position(payload, _TDOA2.size)
    return Packet(host_s, sender, sequences[sender], stamps[sender], rx_ticks, relays, position_m)


def _position(payload: bytes, at: int) -> Point | None:
    """Position of the LPP packet at an offset; None if there is none, or if it is implausible."""
    if at + _POSITION.size > len(payload):
        return None
    short, kind, x_m, y_m, z_m = _POSITION.unpack_from(payload, at)
    if short != _LPP_SHORT or kind != _LPP_POSITION:
        return None
    sensible = all(isfinite(value) and abs(value) < _FARTHEST_M for value in (x_m, y_m, z_m))
    return (x_m, y_m, z_m) if sensible else None


# Text stream of Bitcraze's sniffer: ``From 02 to ff @487696ad28: 300c00…``, one packet a line, all hexadecimal.

_LINE: Final = re.compile(rb"From ([0-9a-f]{2}) to [0-9a-f]{2} @([0-9a-f]{10}): *((?:[0-9a-f]{2} ?)+) *")


def recognise_text(head: bytes) -> bool:
    """Whether there is a line of the sniffer's text near the beginning."""
    return _LINE.search(head) is not None


def read_text(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a text stream."""
    return packets_of_lines(lines(stream, drops), drops)


def packets_of_lines(text: Iterable[bytes], drops: Drops) -> Iterator[Packet]:
    """Yield the packets of lines; those that are none are counted in ``drops``."""
    for line in filter(None, text):
        match = _LINE.fullmatch(line)
        packet: Packet | str = "malformed-line"
        if match is not None:
            sender, stamp, payload = match.groups()
            packet = decode_payload(bytes.fromhex(payload.decode()), None, int(sender, 16), int(stamp, 16))
        if isinstance(packet, Packet):
            yield packet
        else:
            drops[packet] += 1


# Binary stream of Bitcraze's sniffer (after ``b`` was sent to it); reading resumes after garbage.
#
# A record is ``BC | RX stamp 5 bytes | from u8 | to u8 | length u16 | payload | length u16``, little-endian. There is
# no checksum: only the length, which is there twice, marks a record.

MAX_PAYLOAD_BYTES: Final = 1014
"""Payload of a long DW1000 frame, minus the MAC header of at least 7 bytes and the check sequence."""

_MARK: Final = 0xBC
_HEADER_BYTES: Final = 10
_TRAILER_BYTES: Final = 2


def recognise_binary(head: bytes) -> bool:
    """Whether there is a whole record with a known payload near the beginning."""
    at = head.find(_MARK)
    while at >= 0:
        if _record_size(head, at) and head[at + _HEADER_BYTES] in (TDOA2, TDOA3):
            return True
        at = head.find(_MARK, at + 1)
    return False


def read_binary(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a stream; each stretch of bytes that belongs to no record is counted once."""
    cutter = BinaryCutter(drops)
    for chunk in chunks(stream, drops):
        yield from cutter.feed(chunk)
    yield from cutter.feed(b"", ended=True)


class BinaryCutter:
    """Cuts a stream that arrives in pieces into packets, each as soon as it is complete."""

    def __init__(self, drops: Drops) -> None:
        self._drops = drops
        self._buffer = b""
        self._lost = False

    def feed(self, chunk: bytes, *, ended: bool = False) -> Iterator[Packet]:
        """Yield the packets that this piece completes, at the end also those after a false start too long for it."""
        for record in self._records(chunk, ended=ended):
            rx_ticks = int.from_bytes(record[1:6], "little")
            packet = decode_payload(record[_HEADER_BYTES:-_TRAILER_BYTES], None, record[6], rx_ticks)
            if isinstance(packet, Packet):
                yield packet
            else:
                self._drops[packet] += 1

    def _records(self, chunk: bytes, *, ended: bool) -> list[bytes]:
        buffer, at, records = self._buffer + chunk, 0, []
        while at < len(buffer) and (ended or not _may_grow(buffer, at)):
            size = _record_size(buffer, at)
            if size:
                records.append(buffer[at : at + size])
                at += size
                self._lost = False
                continue
            if not self._lost:
                self._drops["bytes-of-no-record"] += 1
                self._lost = True
            next_mark = buffer.find(_MARK, at + 1)
            at = next_mark if next_mark >= 0 else len(buffer)
        self._buffer = buffer[at:]
        return records


def _may_grow(buffer: bytes, at: int) -> bool:
    """Whether the bytes at an offset may be the beginning of an incomplete record."""
    if buffer[at] != _MARK:
        return False
    left = len(buffer) - at
    if left < _HEADER_BYTES:
        return True
    length = buffer[at + 8] | buffer[at + 9] << 8
    return 1 <= length <= MAX_PAYLOAD_BYTES and left < _HEADER_BYTES + length + _TRAILER_BYTES


def _record_size(buffer: bytes, at: int) -> int:
    """Size of the whole record at an offset; 0 if there is none."""
    left = len(buffer) - at
    if left <= _HEADER_BYTES + _TRAILER_BYTES or buffer[at] != _MARK:
        return 0
    length = buffer[at + 8] | buffer[at + 9] << 8
    size = _HEADER_BYTES + length + _TRAILER_BYTES
    if not 1 <= length <= MAX_PAYLOAD_BYTES or left < size:
        return 0
    return size if buffer[at + size - 2 : at + size] == buffer[at + 8 : at + 10] else 0
