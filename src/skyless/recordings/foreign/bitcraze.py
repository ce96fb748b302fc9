"""Bitcraze's loco positioning system: what its anchors send, and how sniffers and captures hold it."""

import re
from binascii import Error as Base64Error
from binascii import a2b_base64
from collections.abc import Iterator
from io import BufferedIOBase
from math import isfinite
from struct import Struct as Layout
from typing import Final

import yaml

from skyless.air.masterless_packets import Packet, Point, Relay
from skyless.constants import TICK_BITS, TICK_M
from skyless.recordings.source import Drops, chunks, lines

# Payloads of Bitcraze's loco positioning anchors, TDoA2 and TDoA3, to packets.
#
# Both are little-endian and hold the low 32 bits of all stamps. Distances are times of flight in ticks that include
# the antenna delays. A short LPP packet with the anchor's position may come after either.
#
# TDoA2, type 0x22: sequence u8 × 8 | stamp u32 × 8 | distance u16 × 8, indexed by anchor. The sender's own stamp is the
# TX time, the others are when it last heard that anchor, 0 for never.
#
# TDoA3, type 0x30: sequence (7 bits) | TX time u32 | count, then count times: anchor | sequence (7 bits) with the high
# bit set if a distance comes after it | RX time u32 | distance u16, if any.

TDOA2: Final = 0x22
TDOA3: Final = 0x30
STAMP_BITS: Final = 32

ANTENNA_DELAYS_TICKS: Final = round(154.6 / TICK_M)
"""Of a sender and a receiver together, which the stamps include: 154.6 m by the firmware of Crazyflies."""

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
    """Packet of a payload, or the reason why it is none."""
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
        if at + 6 > size:
            return "short-payload"
        if payload[at + 1] & _HAS_DISTANCE:
            if at + 8 > size:
                return "short-payload"
            anchor, flags, stamp, distance = _TDOA3_RANGED.unpack_from(payload, at)
            relays.append(Relay(anchor, flags & 0x7F, stamp, distance or None))
            at += 8
        else:
            anchor, flags, stamp = _TDOA3_RELAY.unpack_from(payload, at)
            relays.append(Relay(anchor, flags, stamp, None))
            at += 6
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
    """Position of the LPP packet at that offset, None where there is none or where it makes no sense."""
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
    """Whether a line of the sniffer's text stands near the beginning."""
    return _LINE.search(head) is not None


def read_text(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a text stream."""
    for line in lines(stream, drops):
        packet = packet_of_line(line, drops)
        if packet is not None:
            yield packet


def packet_of_line(line: bytes, drops: Drops) -> Packet | None:
    """Packet of a line; None, and a count, for what is none."""
    if not line:
        return None
    match = _LINE.fullmatch(line)
    if match is None:
        drops["malformed-line"] += 1
        return None
    sender, stamp, payload = match.groups()
    packet = decode_payload(bytes.fromhex(payload.decode()), None, int(sender, 16), int(stamp, 16))
    if isinstance(packet, Packet):
        return packet
    drops[packet] += 1
    return None


# Binary stream of Bitcraze's sniffer (after it was sent ``b``), found again after garbage.
#
# A record is ``BC | RX stamp 5 bytes | from u8 | to u8 | length u16 | payload | length u16``, little-endian. There is
# no checksum: the length, which stands there twice, is all that marks a record.

MAX_PAYLOAD_BYTES: Final = 1014
"""Of a long DW1000 frame, less the MAC header of at least 7 bytes and the check sequence."""

_MARK: Final = 0xBC
_HEADER_BYTES: Final = 10
_TRAILER_BYTES: Final = 2


def recognise_binary(head: bytes) -> bool:
    """Whether a whole record of a known payload stands near the beginning."""
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
    """Whether the bytes there may be a record of which more is to come."""
    if buffer[at] != _MARK:
        return False
    left = len(buffer) - at
    if left < _HEADER_BYTES:
        return True
    length = buffer[at + 8] | buffer[at + 9] << 8
    return 1 <= length <= MAX_PAYLOAD_BYTES and left < _HEADER_BYTES + length + _TRAILER_BYTES


def _record_size(buffer: bytes, at: int) -> int:
    """Size of the whole record at that offset, 0 where there is none."""
    left = len(buffer) - at
    if left <= _HEADER_BYTES + _TRAILER_BYTES or buffer[at] != _MARK:
        return 0
    length = buffer[at + 8] | buffer[at + 9] << 8
    size = _HEADER_BYTES + length + _TRAILER_BYTES
    if not 1 <= length <= MAX_PAYLOAD_BYTES or left < size:
        return 0
    return size if buffer[at + size - 2 : at + size] == buffer[at + 8 : at + 10] else 0


# YAML captures of Bitcraze anchors, one document a packet, as the ``uwb_tdoa`` capture tool writes them.
#
# Used keys: ``data`` (payload, base64), ``from`` (anchor), ``ts`` (RX stamp of the tag, 40 bits), ``rxSys`` (host's
# Unix time). The rest repeats the payload. Documents of exactly the tool's shape are cut out by searching;
# any other goes through libyaml's events. (Its loader takes 110 µs a document and crashes on deep nesting.)

MAX_DOCUMENT_BYTES: Final = 1 << 13
_SEPARATOR: Final = b"\n---"
_START: Final = b"\ndata: !!binary |\n  "
_LAST_STAMP: Final = (1 << TICK_BITS) - 1
_LAST_HOST_S: Final = 1e11
_DEEPEST: Final = 8
_KEYS: Final = tuple(re.compile(rb"(?m)^[{ ]*[\"']?" + key + rb"[\"']? *:") for key in (b"data", b"from", b"ts"))
_Loader: Final = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


def recognise_yaml(head: bytes) -> bool:
    """Whether a recording begins like a YAML capture."""
    return all(key.search(head) for key in _KEYS)


def read_yaml(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a capture."""
    for document in _documents(stream, drops):
        packet = _scan_document(document)
        if packet is None:
            packet = _parse_document(document)
        if isinstance(packet, Packet):
            yield packet
        elif packet:
            drops[packet] += 1


def _documents(stream: BufferedIOBase, drops: Drops) -> Iterator[bytes]:
    """Yield the documents, each beginning with the end of its separator's line."""
    rest = b"\n"
    skipping = False
    for chunk in chunks(stream, drops):
        parts = (rest + chunk).split(_SEPARATOR)
        rest = parts.pop()
        if skipping and parts:
            del parts[0]
            skipping = False
        yield from parts
        if len(rest) > MAX_DOCUMENT_BYTES:
            if not skipping:
                drops["overlong-document"] += 1
            skipping = True
            rest = rest[1 - len(_SEPARATOR) :]
    if not skipping:
        yield rest[: rest.rfind(b"\n") + 1]  # a number in an unfinished line may be cut off


def _scan_document(document: bytes) -> Packet | str | None:
    """Packet of a document of the tool's own shape; None for any other shape."""
    if not document.startswith(_START):
        return None
    end = document.find(b"\nfrom: ", 20)
    host = document.find(b"\nrxSys: ", end)
    stamp = document.find(b"\nts: ", host)
    stop = document.find(b"\n", stamp + 5)
    if end < 0 or host < 0 or stamp < 0 or stop < 0:
        return None
    try:
        return _packet_of_document(
            document[20:end],
            int(document[end + 7 : document.find(b"\n", end + 7)]),
            int(document[stamp + 5 : stop]),
            float(document[host + 8 : document.find(b"\n", host + 8)]),
        )
    except ValueError:
        return None


def _parse_document(document: bytes) -> Packet | str | None:
    """Packet of a document of any shape, or the reason why it has none; None for an empty one."""
    text = document.partition(b"\n")[2]
    if not text.strip():
        return None
    if len(text) > MAX_DOCUMENT_BYTES:
        return "overlong-document"
    try:
        values = _top_level(text)
    except (yaml.YAMLError, ValueError):
        return "malformed-document"
    if not {"data", "from", "ts"} <= values.keys():
        return "incomplete-document"
    try:
        host_s = float(values["rxSys"]) if "rxSys" in values else None
        return _packet_of_document(values["data"].encode(), int(values["from"]), int(values["ts"]), host_s)
    except ValueError:
        return "malformed-document"


def _top_level(text: bytes) -> dict[str, str]:
    """Scalars of the outermost mapping, by key; walked over as events, so that nesting costs no stack."""
    values: dict[str, str] = {}
    depth = 0
    key: str | None = None
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEEPEST:
                raise ValueError("too deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
            key = None if depth == 1 else key
        elif depth == 1 and isinstance(event, yaml.ScalarEvent):
            if key is None:
                key = event.value
            else:
                values[key] = event.value
                key = None
    return values


def _packet_of_document(base64: bytes, sender: int, rx_ticks: int, host_s: float | None) -> Packet | str:
    """Raises ValueError for what is not base64."""
    if not 0 <= rx_ticks <= _LAST_STAMP:
        return "impossible-stamp"
    if host_s is not None and not 0.0 <= host_s < _LAST_HOST_S:
        return "impossible-host-time"
    try:
        payload = a2b_base64(base64)
    except Base64Error as error:
        raise ValueError("not base64") from error
    return decode_payload(payload, host_s, sender, rx_ticks)
