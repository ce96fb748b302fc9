"""UCI, the command interface of FiRa radios: packets of a byte stream, and notifications of DL-TDoA measurements.

A control packet is ``type 3 bits, boundary 1, group 4 | 2 reserved, opcode 6 | reserved u8 | length u8 | payload``, a
data packet ``type, boundary, format | reserved u8 | length u16 | payload``. A set boundary bit means that the payload
goes on in the next packet of the same kind. There is no checksum: only what the header reserves shows that bytes are
none.

A notification SESSION_INFO (group 2, opcode 0) is, little-endian,

    sequence u32 | session u32 | reserved u8 | interval in ms u32 | measurement type u8 | reserved u8 |
    extended addresses u8 | reserved 8 bytes | number of measurements u8 | measurements

DL-TDoA measurements are of version 1 (FiRa 2.0) or 2 (FiRa 4.0). Version 1 has type 2, version 2 type 6 at Qorvo's
stack; at Android's both have type 2, and which it is has been agreed with the radio before. So type 2 is version 1
where that fits the length, else version 2.

    version 1: address u16 or u64 | status u8 | message u8 | control u16 | block u16 | round u8 | NLOS u8 |
        azimuth i16, its FoM u8 | elevation i16, its FoM u8 | RSSI u8 | TX stamp 5 or 8 bytes | RX stamp 5 or 8 |
        CFO of the anchor i16 | CFO i16 | reply of the initiator u32 | of the responder u32 | flight u16 |
        location 0, 12 (WGS 84) or 10 bytes (relative) | active rounds
        control: b0 TX stamp in the common time, b1 TX stamp of 64 bits, b3 RX stamp, b5-6 kind of location
        (0 none, 1 WGS 84, 2 relative), b7-10 number of active rounds
    version 2: size u16 | address | status | message | block | round | NLOS | angles | RSSI | both CFOs | replies |
        flight | length u8, RX stamp | control u32 | length u8, TX stamp | length u8, active rounds, if b1 |
        length u8, location, if b2 | supercluster u8, if b3
        (Qorvo's stack reads a control of 16 bits, which is accepted where the size shows it.)

Read off, as facts: AOSP ``external/uwb`` (uci_packets.pdl and the parsers next to it, whose tests' bytes serve our
tests) and Qorvo's client for QM35. The specification itself is for members of FiRa only.
"""

from collections import Counter
from enum import IntEnum
from struct import Struct as Layout
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


SESSION_CONTROL: Final = 2
"""The group of ..."""
SESSION_INFO: Final = 0
"""... this opcode."""


# Packets of a stream


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


# Measurements

STATUS_OK: Final = 0

NO_LOCATION, WGS84_LOCATION, RELATIVE_LOCATION = range(3)
"""Kinds of location in version 1."""

LOCATION_BYTES: Final = (0, 12, 10)
"""Of each kind."""

_SHORT_STAMP, _LONG_STAMP = 5, 8
_UNKNOWN_CFO: Final = -32768
_CFO_PER_PPM: Final = 1024
_PER_DEGREE: Final = 128
_MOST_ROUNDS: Final = 15


class DtMessageType(IntEnum):
    """Which message of a round a measurement is of."""

    POLL = 0
    RESPONSE = 1
    FINAL = 2


class DtMeasurement(Struct, frozen=True, gc=False):
    """What a DT-tag received of one message of an anchor; fields as they are on the line, in their units."""

    address: int
    """MAC address of the anchor, 16 or 64 bits."""
    message: int
    """A ``DtMessageType``, or a value that is reserved."""
    block: int
    """16 bits."""
    round: int
    """8 bits."""
    tx_ticks: int
    """When the anchor sent it, in its own clock or in the common time."""
    rx_ticks_tag: int
    status: int = STATUS_OK
    common_time: bool = False
    """Whether ``tx_ticks`` is in the time of the initiator."""
    tx_bytes: int = _SHORT_STAMP
    rx_bytes: int = _SHORT_STAMP
    """Width of the stamps: 5 or 8, in version 2 up to 8."""
    nlos: int = 0
    azimuth_deg: float = 0.0
    azimuth_fom: int = 0
    elevation_deg: float = 0.0
    elevation_fom: int = 0
    rssi_dbm: float = 0.0
    """0 to −127.5, in steps of 0.5."""
    anchor_cfo_ppm: float | None = None
    """Offset of the anchor's clock from the initiator's, within ±32, in steps of 1/1024."""
    cfo_ppm: float | None = None
    """Offset of the tag's clock from the anchor's, likewise."""
    initiator_reply_ticks: int = 0
    """From when the initiator received this response to when it sent the final message; 0 if unknown."""
    responder_reply_ticks: int = 0
    """From when the responder received the poll to when it sent this response; 0 if unknown."""
    flight_ticks: int = 0
    """Between initiator and responder; 0 if unknown."""
    location_kind: int = NO_LOCATION
    """In version 1; in version 2 the location begins with its kind (``uci_location``)."""
    location: bytes = b""
    active_rounds: bytes = b""
    supercluster: int | None = None
    """In version 2."""


class SessionInfo(Struct, frozen=True, gc=False):
    """A notification: the measurements of a round, mostly."""

    sequence: int
    session: int
    version: int
    """Of the measurements, 1 or 2."""
    measurements: tuple[DtMeasurement, ...]
    extended_addresses: bool = False
    interval_ms: int = 0


_INFO: Final = Layout("<IIBIBBB8xB")
_DL_TDOA: Final = 2
_DL_TDOA_2: Final = 6

_HEAD_1: Final = Layout("<BBHHBBhBhBB")
_HEAD_2: Final = Layout("<BBHBBhBhBB")
_TIMES: Final = Layout("<hhIIH")

_COMMON, _LONG_TX, _LONG_RX = 1 << 0, 1 << 1, 1 << 3
_ROUNDS_2, _LOCATION_2, _SUPERCLUSTER_2 = 1 << 1, 1 << 2, 1 << 3


def encode_session_info(info: SessionInfo) -> UciPacket:
    """The notification. Raises ValueError or struct.error for values that have no bytes."""
    kind = _DL_TDOA if info.version == 1 else _DL_TDOA_2
    wide, count = info.extended_addresses, len(info.measurements)
    payload = bytearray(_INFO.pack(info.sequence, info.session, 0, info.interval_ms, kind, 0, wide, count))
    for measurement in info.measurements:
        address = _whole(measurement.address, 8 if wide else 2)
        payload += _encode_1(measurement, address) if info.version == 1 else _encode_2(measurement, address)
    return UciPacket(UciType.NOTIFICATION, SESSION_CONTROL, SESSION_INFO, bytes(payload))


def decode_session_info(packet: UciPacket) -> SessionInfo | str:
    """Notification of a packet, or the reason why it is none of DL-TDoA measurements."""
    if (packet.kind, packet.group, packet.opcode) != (UciType.NOTIFICATION, SESSION_CONTROL, SESSION_INFO):
        return "other-packet"
    payload = packet.payload
    if len(payload) < _INFO.size:
        return "short-notification"
    sequence, session, _, interval_ms, kind, _, wide, count = _INFO.unpack_from(payload)
    if kind not in (_DL_TDOA, _DL_TDOA_2):
        return "other-measurements"
    if wide > 1:
        return "impossible-address-mode"
    address_bytes, version = 8 if wide else 2, 1
    found, exact = (None, False) if kind == _DL_TDOA_2 else _decode_all_1(payload, address_bytes, count)
    if not exact:
        second, fits = _decode_all_2(payload, address_bytes, count)
        if second is not None and (fits or found is None):
            found, version = second, 2
    if found is None:
        return "measurements-that-do-not-fit"
    return SessionInfo(sequence, session, version, found, bool(wide), interval_ms)


def _decode_all_1(payload: bytes, address_bytes: int, count: int) -> tuple[tuple[DtMeasurement, ...] | None, bool]:
    """Measurements of version 1, and whether they end where the notification does."""
    at, found = _INFO.size, []
    for _ in range(count):
        one = _decode_1(payload, at, address_bytes)
        if one is None:
            return None, False
        found.append(one[0])
        at = one[1]
    return tuple(found), at == len(payload)


def _decode_all_2(payload: bytes, address_bytes: int, count: int) -> tuple[tuple[DtMeasurement, ...] | None, bool]:
    at, found = _INFO.size, []
    for _ in range(count):
        size = int.from_bytes(payload[at : at + 2], "little")
        one = _decode_2(payload, at, address_bytes, 4)
        if one is None or one[1] != at + size:
            other = _decode_2(payload, at, address_bytes, 2)
            one = other if other is not None and (one is None or other[1] == at + size) else one
        if one is None or size < 2 or at + size > len(payload):
            return None, False
        found.append(one[0])
        at += size
    return tuple(found), at == len(payload)


def _encode_1(one: DtMeasurement, address: bytes) -> bytes:
    if {one.tx_bytes, one.rx_bytes} - {_SHORT_STAMP, _LONG_STAMP} or len(one.active_rounds) > _MOST_ROUNDS:
        raise ValueError("version 1 has stamps of 5 or 8 bytes, and 15 active rounds at most")
    if len(one.location) != LOCATION_BYTES[one.location_kind]:
        raise ValueError("a location of this kind has another length")
    control = _COMMON * one.common_time | _LONG_TX * (one.tx_bytes == _LONG_STAMP)
    control |= _LONG_RX * (one.rx_bytes == _LONG_STAMP) | one.location_kind << 5 | len(one.active_rounds) << 7
    head = _HEAD_1.pack(one.status, one.message, control, one.block, one.round, *_seen(one))
    stamps = _whole(one.tx_ticks, one.tx_bytes) + _whole(one.rx_ticks_tag, one.rx_bytes)
    return address + head + stamps + _TIMES.pack(*_times(one)) + one.location + one.active_rounds


def _decode_1(payload: bytes, at: int, address_bytes: int) -> tuple[DtMeasurement, int] | None:
    """A measurement of version 1 and where it ends; None where it does not fit."""
    head_at, size = at + address_bytes, len(payload)
    if head_at + _HEAD_1.size > size:
        return None
    status, message, control, block, round_index, *seen = _HEAD_1.unpack_from(payload, head_at)
    tx_bytes = _LONG_STAMP if control & _LONG_TX else _SHORT_STAMP
    rx_bytes = _LONG_STAMP if control & _LONG_RX else _SHORT_STAMP
    location_kind, rounds = control >> 5 & 3, control >> 7 & 0xF
    tx_at = head_at + _HEAD_1.size
    times_at = tx_at + tx_bytes + rx_bytes
    location_at = times_at + _TIMES.size
    if location_kind >= len(LOCATION_BYTES):
        return None
    rounds_at = location_at + LOCATION_BYTES[location_kind]
    end = rounds_at + rounds
    if end > size:
        return None
    return _measurement(
        payload[at:head_at],
        (status, message, block, round_index, *seen),
        _TIMES.unpack_from(payload, times_at),
        payload[tx_at : tx_at + tx_bytes],
        payload[tx_at + tx_bytes : times_at],
        common_time=bool(control & _COMMON),
        location_kind=location_kind,
        location=payload[location_at:rounds_at],
        active_rounds=payload[rounds_at:end],
    ), end


def _encode_2(one: DtMeasurement, address: bytes) -> bytes:
    if max(one.tx_bytes, one.rx_bytes) > _LONG_STAMP:
        raise ValueError("stamps have 8 bytes at most")
    control = _COMMON * one.common_time | _ROUNDS_2 * bool(one.active_rounds) | _LOCATION_2 * bool(one.location)
    control |= _SUPERCLUSTER_2 * (one.supercluster is not None)
    body = address + _HEAD_2.pack(one.status, one.message, one.block, one.round, *_seen(one))
    body += _TIMES.pack(*_times(one)) + _counted(_whole(one.rx_ticks_tag, one.rx_bytes)) + _whole(control, 4)
    body += _counted(_whole(one.tx_ticks, one.tx_bytes))
    body += _counted(one.active_rounds) if one.active_rounds else b""
    body += _counted(one.location) if one.location else b""
    body += b"" if one.supercluster is None else _whole(one.supercluster, 1)
    return _whole(len(body) + 2, 2) + body


def _decode_2(payload: bytes, at: int, address_bytes: int, control_bytes: int) -> tuple[DtMeasurement, int] | None:
    """A measurement of version 2 and where its fields end; None where they do not fit."""
    head_at = at + 2 + address_bytes
    times_at = head_at + _HEAD_2.size
    if times_at + _TIMES.size > len(payload):
        return None
    rx, end = _counted_at(payload, times_at + _TIMES.size)
    control = int.from_bytes(payload[end : end + control_bytes], "little")
    tx, end = _counted_at(payload, end + control_bytes)
    active_rounds, end = _counted_at(payload, end) if control & _ROUNDS_2 else (b"", end)
    location, end = _counted_at(payload, end) if control & _LOCATION_2 else (b"", end)
    has_supercluster = bool(control & _SUPERCLUSTER_2)
    supercluster = payload[end] if has_supercluster and end < len(payload) else None
    end += has_supercluster
    if end > len(payload) or max(len(rx), len(tx)) > _LONG_STAMP:
        return None
    return _measurement(
        payload[at + 2 : head_at],
        _HEAD_2.unpack_from(payload, head_at),
        _TIMES.unpack_from(payload, times_at),
        tx,
        rx,
        common_time=bool(control & _COMMON),
        location=location,
        active_rounds=active_rounds,
        supercluster=supercluster,
    ), end


def _measurement(
    address: bytes,
    head: tuple[int, ...],
    times: tuple[int, ...],
    tx: bytes,
    rx: bytes,
    *,
    common_time: bool,
    location: bytes,
    active_rounds: bytes,
    location_kind: int = NO_LOCATION,
    supercluster: int | None = None,
) -> DtMeasurement:
    status, message, block, round_index, nlos, azimuth, azimuth_fom, elevation, elevation_fom, rssi = head
    anchor_cfo, cfo, initiator_reply, responder_reply, flight = times
    return DtMeasurement(
        address=int.from_bytes(address, "little"),
        message=message,
        block=block,
        round=round_index,
        tx_ticks=int.from_bytes(tx, "little"),
        rx_ticks_tag=int.from_bytes(rx, "little"),
        status=status,
        common_time=common_time,
        tx_bytes=len(tx),
        rx_bytes=len(rx),
        nlos=nlos,
        azimuth_deg=azimuth / _PER_DEGREE,
        azimuth_fom=azimuth_fom,
        elevation_deg=elevation / _PER_DEGREE,
        elevation_fom=elevation_fom,
        rssi_dbm=-rssi / 2,
        anchor_cfo_ppm=None if anchor_cfo == _UNKNOWN_CFO else anchor_cfo / _CFO_PER_PPM,
        cfo_ppm=None if cfo == _UNKNOWN_CFO else cfo / _CFO_PER_PPM,
        initiator_reply_ticks=initiator_reply,
        responder_reply_ticks=responder_reply,
        flight_ticks=flight,
        location_kind=location_kind,
        location=location,
        active_rounds=active_rounds,
        supercluster=supercluster,
    )


def _seen(one: DtMeasurement) -> tuple[int, ...]:
    azimuth, elevation = round(one.azimuth_deg * _PER_DEGREE), round(one.elevation_deg * _PER_DEGREE)
    return one.nlos, azimuth, one.azimuth_fom, elevation, one.elevation_fom, round(-2 * one.rssi_dbm)


def _times(one: DtMeasurement) -> tuple[int, ...]:
    replies = one.initiator_reply_ticks, one.responder_reply_ticks
    return _cfo(one.anchor_cfo_ppm), _cfo(one.cfo_ppm), *replies, one.flight_ticks


def _cfo(ppm: float | None) -> int:
    """On the line; unknown where it is beyond ±32 ppm, which two crystals of ±20 ppm can be."""
    steps = _UNKNOWN_CFO if ppm is None else round(ppm * _CFO_PER_PPM)
    return steps if abs(steps) < -_UNKNOWN_CFO else _UNKNOWN_CFO


def _whole(value: int, size: int) -> bytes:
    if not 0 <= value < 1 << 8 * size:
        raise ValueError(f"{value} does not fit {size} bytes")
    return value.to_bytes(size, "little")


def _counted(data: bytes) -> bytes:
    return _whole(len(data), 1) + data


def _counted_at(payload: bytes, at: int) -> tuple[bytes, int]:
    """Bytes behind their length, and where they should end, which may be behind the payload."""
    if at >= len(payload):
        return b"", len(payload) + 1
    end = at + 1 + payload[at]
    return payload[at + 1 : end], end
