"""UCI of FiRa radios: packets of a byte stream, notifications of DL-TDoA measurements in them, and anchors' locations.

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

A location is in WGS 84 or relative to some point. The coordinates follow each other as one string of bits, each from
its lowest byte on; of the bits that fill no byte, which are its highest, those come first that count most. WGS 84:
latitude and longitude of 33 bits in 2⁻²⁴ degrees, altitude of 30 bits in 2⁻²¹ kilometres. Relative: x and y of 28 bits,
z of 24 bits, in millimetres. In version 2 of the measurements a location begins with its kind; Android's stack expects
that kind once more in the byte after it (b0 set, kind in b1-3), Qorvo's does not. Kinds 2, 3 and 5 end with 6 bytes
about the storey.

Read off, as facts: AOSP ``external/uwb`` (uci_packets.pdl, the parsers next to it, ``UwbAnchorLocation``), whose tests'
bytes serve our tests, and Qorvo's client for QM35. The specification itself is for members of FiRa only.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum
from math import dist
from struct import Struct as Layout
from typing import Final, TypeAlias

from msgspec import Struct

from skyless.core.air.masterless_packets import Packet, Point, Relay
from skyless.core.earth import east_north_up_of
from skyless.core.site import GeoreferenceSite
from skyless.core.ticks import TICK_M, TICK_MASK, TICK_S, wrap

MAX_SEGMENT_BYTES: Final = 255
"""Longest payload of a control packet."""

MAX_UCI_PAYLOAD_BYTES: Final = 1 << 16
"""A longer segmented payload is dropped."""

MAX_DATA_BYTES: Final = 4096
"""Longest data packet; a longer length field is none."""

CONTROL_HEADER_BYTES: Final = 4

_GROUPS: Final = frozenset((0, 1, 2, 3, 9, 10, 11, 12, 13, 14, 15))


class UciType(IntEnum):
    """Kinds of packets."""

    DATA = 0
    COMMAND = 1
    RESPONSE = 2
    NOTIFICATION = 3


class UciPacket(Struct, frozen=True, gc=False):
    """One packet, reassembled from its segments."""

    kind: UciType
    group: int
    """Group of a control packet, format of a data packet; 4 bits."""
    opcode: int
    """6 bits; 0 for a data packet."""
    payload: bytes


def encode_packet(packet: UciPacket) -> bytes:
    """Encode a control packet, in segments if it is long."""
    payload = packet.payload
    parts = [payload[at : at + MAX_SEGMENT_BYTES] for at in range(0, len(payload), MAX_SEGMENT_BYTES)] or [b""]
    out = bytearray()
    for number, part in enumerate(parts, start=1):
        goes_on = number < len(parts)
        out += bytes((packet.kind << 5 | goes_on << 4 | packet.group, packet.opcode, 0, len(part))) + part
    return bytes(out)


class UciReader:
    """Cuts a stream that comes in pieces into packets; each stretch of other bytes is counted once."""

    def __init__(self, drops: Counter[str]) -> None:
        self._drops = drops
        self._buffer = b""
        self._lost = False
        self._begun: tuple[int, int, int] | None = None
        self._segments = bytearray()

    def feed(self, data: bytes) -> list[UciPacket]:
        """Packets completed by this piece."""
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
        """The packet completed by this segment."""
        kind, opcode = segment[0] >> 5, 0 if segment[0] >> 5 == UciType.DATA else segment[1]
        key = (kind, segment[0] & 0xF, opcode)
        if self._begun is not None and self._begun != key:
            self._drops["unfinished-packet"] += 1
            self._segments.clear()
        self._begun = key
        self._segments += segment[CONTROL_HEADER_BYTES:]
        is_overlong = len(self._segments) > MAX_UCI_PAYLOAD_BYTES
        if segment[0] & 0x10 and not is_overlong:
            return None
        payload, self._begun = bytes(self._segments), None
        self._segments.clear()
        if is_overlong:
            self._drops["overlong-packet"] += 1
            return None
        return UciPacket(UciType(kind), key[1], opcode, payload)


def _packet_size(buffer: bytes, at: int) -> int:
    """Size of the segment whose header is at this offset; 0 if there can be none."""
    first, second, third, fourth = buffer[at : at + CONTROL_HEADER_BYTES]
    kind = first >> 5
    if kind == UciType.DATA:
        length = third | fourth << 8
        return CONTROL_HEADER_BYTES + length if first & 0xF and second == 0 and 0 < length <= MAX_DATA_BYTES else 0
    if kind > UciType.NOTIFICATION or first & 0xF not in _GROUPS or second > 0x3F or third != 0:
        return 0
    return CONTROL_HEADER_BYTES + fourth


# Notifications of measurements

SESSION_CONTROL: Final = 2
"""The group of SESSION_INFO."""
SESSION_INFO: Final = 0

STATUS_OK: Final = 0

NO_LOCATION, WGS84_LOCATION, RELATIVE_LOCATION = range(3)
"""Kinds of location in version 1."""

LOCATION_BYTES: Final = (0, 12, 10)
"""Length of each kind."""

_SHORT_STAMP, _LONG_STAMP = 5, 8


class DtMessageType(IntEnum):
    """The message of a round that a measurement refers to."""

    POLL = 0
    RESPONSE = 1
    FINAL = 2


class DtMeasurement(Struct, frozen=True, gc=False):
    """A DT-tag's reception of one message of an anchor; fields as transmitted, in their units."""

    address: int
    """MAC address of the anchor, 16 or 64 bits."""
    message: int
    """A ``DtMessageType``, or a reserved value."""
    block: int
    """16 bits."""
    round: int
    """8 bits."""
    tx_ticks: int
    """Sending time in the anchor's clock or in the common time."""
    rx_ticks_tag: int
    status: int = STATUS_OK
    common_time: bool = False
    """Whether ``tx_ticks`` is in the time of the initiator."""
    tx_bytes: int = _SHORT_STAMP
    rx_bytes: int = _SHORT_STAMP
    """Width of the stamps: 5 or 8, in version 2 up to 8."""
    initiator_reply_ticks: int = 0
    """From the initiator's reception of this response to its final message; 0 if unknown."""
    responder_reply_ticks: int = 0
    """From the responder's reception of the poll to this response; 0 if unknown."""
    flight_ticks: int = 0
    """Between initiator and responder; 0 if unknown."""
    location_kind: int = NO_LOCATION
    """In version 1; in version 2 the location begins with its kind."""
    location: bytes = b""


class SessionInfo(Struct, frozen=True, gc=False):
    """A notification, usually with the measurements of a round."""

    sequence: int
    session: int
    version: int
    """Version of the measurements, 1 or 2."""
    measurements: tuple[DtMeasurement, ...]
    extended_addresses: bool = False


_INFO: Final = Layout("<II5xBxB8xB")
_DL_TDOA: Final = 2
_DL_TDOA_2: Final = 6

_HEAD_1: Final = Layout("<BBHHB8x")
_HEAD_2: Final = Layout("<BBHB8x")
_TIMES: Final = Layout("<4xIIH")
"""Without unused fields: NLOS, angles and RSSI, and both CFOs, which are written as zeros."""

_COMMON, _LONG_TX, _LONG_RX = 1 << 0, 1 << 1, 1 << 3
_ROUNDS_2, _LOCATION_2, _SUPERCLUSTER_2 = 1 << 1, 1 << 2, 1 << 3


def encode_session_info(info: SessionInfo) -> UciPacket:
    """Encode a notification. Raises ValueError or struct.error for values that do not fit."""
    kind = _DL_TDOA if info.version == 1 else _DL_TDOA_2
    wide, count = info.extended_addresses, len(info.measurements)
    payload = bytearray(_INFO.pack(info.sequence, info.session, kind, wide, count))
    for measurement in info.measurements:
        address = _whole(measurement.address, 8 if wide else 2)
        payload += _encode_1(measurement, address) if info.version == 1 else _encode_2(measurement, address)
    return UciPacket(UciType.NOTIFICATION, SESSION_CONTROL, SESSION_INFO, bytes(payload))


def decode_session_info(packet: UciPacket) -> SessionInfo | str:
    """Decode a packet, or return why it is no notification of DL-TDoA measurements."""
    if (packet.kind, packet.group, packet.opcode) != (UciType.NOTIFICATION, SESSION_CONTROL, SESSION_INFO):
        return "other-packet"
    payload = packet.payload
    if len(payload) < _INFO.size:
        return "short-notification"
    sequence, session, kind, wide, count = _INFO.unpack_from(payload)
    if kind not in (_DL_TDOA, _DL_TDOA_2):
        return "other-measurements"
    if wide > 1:
        return "impossible-address-mode"
    address_bytes, version = 8 if wide else 2, 1
    found, exact = (None, False) if kind == _DL_TDOA_2 else _decode_all(_decode_1, payload, address_bytes, count)
    if not exact:
        second, fits = _decode_all(_decode_sized_2, payload, address_bytes, count)
        if second is not None and (fits or found is None):
            found, version = second, 2
    if found is None:
        return "measurements-that-do-not-fit"
    return SessionInfo(sequence, session, version, found, bool(wide))


_Decoded = tuple[DtMeasurement, int] | None
"""A measurement and its end; None if it does not fit."""


def _decode_all(
    decode: Callable[[bytes, int, int], _Decoded], payload: bytes, address_bytes: int, count: int
) -> tuple[tuple[DtMeasurement, ...] | None, bool]:
    """Measurements of a version, and whether they end where the notification does."""
    at, found = _INFO.size, []
    for _ in range(count):
        if (one := decode(payload, at, address_bytes)) is None:
            return None, False
        measurement, at = one
        found.append(measurement)
    return tuple(found), at == len(payload)


def _decode_sized_2(payload: bytes, at: int, address_bytes: int) -> _Decoded:
    """A measurement of version 2 up to its stated size; the fields of published ones end before that."""
    end = at + int.from_bytes(payload[at : at + 2], "little")
    one = _decode_2(payload, at, address_bytes, 4)
    if one is None or one[1] != end:
        other = _decode_2(payload, at, address_bytes, 2)
        one = other if other is not None and (one is None or other[1] == end) else one
    return None if one is None or not at + 2 <= end <= len(payload) else (one[0], end)


def _encode_1(one: DtMeasurement, address: bytes) -> bytes:
    if {one.tx_bytes, one.rx_bytes} - {_SHORT_STAMP, _LONG_STAMP}:
        raise ValueError("version 1 has stamps of 5 or 8 bytes")
    if len(one.location) != LOCATION_BYTES[one.location_kind]:
        raise ValueError("a location of this kind has another length")
    control = _COMMON * one.common_time | _LONG_TX * (one.tx_bytes == _LONG_STAMP)
    control |= _LONG_RX * (one.rx_bytes == _LONG_STAMP) | one.location_kind << 5
    head = _HEAD_1.pack(one.status, one.message, control, one.block, one.round)
    stamps = _whole(one.tx_ticks, one.tx_bytes) + _whole(one.rx_ticks_tag, one.rx_bytes)
    return address + head + stamps + _times(one) + one.location


def _decode_1(payload: bytes, at: int, address_bytes: int) -> _Decoded:
    """A measurement of version 1."""
    head_at, size = at + address_bytes, len(payload)
    if head_at + _HEAD_1.size > size:
        return None
    status, message, control, block, round_index = _HEAD_1.unpack_from(payload, head_at)
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
        (status, message, block, round_index),
        _TIMES.unpack_from(payload, times_at),
        payload[tx_at : tx_at + tx_bytes],
        payload[tx_at + tx_bytes : times_at],
        common_time=bool(control & _COMMON),
        location_kind=location_kind,
        location=payload[location_at:rounds_at],
    ), end


def _encode_2(one: DtMeasurement, address: bytes) -> bytes:
    if max(one.tx_bytes, one.rx_bytes) > _LONG_STAMP:
        raise ValueError("stamps have 8 bytes at most")
    control = _COMMON * one.common_time | _LOCATION_2 * bool(one.location)
    body = address + _HEAD_2.pack(one.status, one.message, one.block, one.round)
    body += _times(one) + _counted(_whole(one.rx_ticks_tag, one.rx_bytes)) + _whole(control, 4)
    body += _counted(_whole(one.tx_ticks, one.tx_bytes))
    body += _counted(one.location) if one.location else b""
    return _whole(len(body) + 2, 2) + body


def _decode_2(payload: bytes, at: int, address_bytes: int, control_bytes: int) -> _Decoded:
    """A measurement of version 2, and the end of its fields."""
    head_at = at + 2 + address_bytes
    times_at = head_at + _HEAD_2.size
    if times_at + _TIMES.size > len(payload):
        return None
    rx, end = _counted_at(payload, times_at + _TIMES.size)
    control = int.from_bytes(payload[end : end + control_bytes], "little")
    tx, end = _counted_at(payload, end + control_bytes)
    if control & _ROUNDS_2:
        _, end = _counted_at(payload, end)
    location, end = _counted_at(payload, end) if control & _LOCATION_2 else (b"", end)
    end += bool(control & _SUPERCLUSTER_2)
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
    location_kind: int = NO_LOCATION,
) -> DtMeasurement:
    status, message, block, round_index = head
    initiator_reply, responder_reply, flight = times
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
        initiator_reply_ticks=initiator_reply,
        responder_reply_ticks=responder_reply,
        flight_ticks=flight,
        location_kind=location_kind,
        location=location,
    )


def _times(one: DtMeasurement) -> bytes:
    return _TIMES.pack(one.initiator_reply_ticks, one.responder_reply_ticks, one.flight_ticks)


def _whole(value: int, size: int) -> bytes:
    if not 0 <= value < 1 << 8 * size:
        raise ValueError(f"{value} does not fit {size} bytes")
    return value.to_bytes(size, "little")


def _counted(data: bytes) -> bytes:
    return _whole(len(data), 1) + data


def _counted_at(payload: bytes, at: int) -> tuple[bytes, int]:
    """Length-prefixed bytes, and where they should end, possibly beyond the payload."""
    if at >= len(payload):
        return b"", len(payload) + 1
    end = at + 1 + payload[at]
    return payload[at + 1 : end], end


# Locations


GeodeticPoint: TypeAlias = GeoreferenceSite
"""A point in WGS 84, which may become a site's origin."""

_WGS84_BITS: Final = (33, 33, 30)
_RELATIVE_BITS: Final = (28, 28, 24)
_PER_DEGREE: Final = 1 << 24
_PER_KM: Final = 1 << 21

_WGS84_KINDS: Final = frozenset((0, 2))
_RELATIVE_KINDS: Final = frozenset((1, 3, 4, 5))
_WITH_STOREY: Final = frozenset((2, 3, 5))
_STOREY_BYTES: Final = 6


def location_of(measurement: DtMeasurement) -> Point | GeodeticPoint | None:
    """Position of the sender; None if not stated, or in an unknown form."""
    data = measurement.location
    if not data:
        return None
    if measurement.location_kind == WGS84_LOCATION:
        return decode_wgs84(data)
    if measurement.location_kind == RELATIVE_LOCATION:
        return decode_relative(data)
    return _location_2(data)


def _location_2(data: bytes) -> Point | GeodeticPoint | None:
    kind = data[0]
    if kind not in _WGS84_KINDS | _RELATIVE_KINDS:
        return None
    bits = _WGS84_BITS if kind in _WGS84_KINDS else _RELATIVE_BITS
    size = sum(bits) // 8
    header = len(data) - size - (_STOREY_BYTES if kind in _WITH_STOREY else 0)
    if header not in (1, 2) or (header == 2 and data[1] & 0xF != 1 | kind << 1):
        return None
    body = data[header : header + size]
    return decode_wgs84(body) if kind in _WGS84_KINDS else decode_relative(body)


def encode_wgs84(point: GeodeticPoint) -> bytes:
    """Encode as 12 bytes. Raises ValueError for a point out of range."""
    height = round(point.height_m / 1000.0 * _PER_KM)
    return _pack(
        (round(point.latitude_deg * _PER_DEGREE), round(point.longitude_deg * _PER_DEGREE), height), _WGS84_BITS
    )


def decode_wgs84(data: bytes) -> GeodeticPoint | None:
    """Decode 12 bytes; None if this is no point on the Earth."""
    latitude, longitude, height = _unpack(data, _WGS84_BITS)
    point = GeodeticPoint(latitude / _PER_DEGREE, longitude / _PER_DEGREE, height / _PER_KM * 1000.0)
    return point if abs(point.latitude_deg) <= 90.0 and abs(point.longitude_deg) <= 180.0 else None


def encode_relative(position_m: Point) -> bytes:
    """Encode as 10 bytes. Raises ValueError for a position out of range."""
    x, y, z = (round(value * 1000.0) for value in position_m)
    return _pack((x, y, z), _RELATIVE_BITS)


def decode_relative(data: bytes) -> Point:
    """Decode a position from 10 bytes."""
    x, y, z = _unpack(data, _RELATIVE_BITS)
    return x / 1000.0, y / 1000.0, z / 1000.0


def _pack(values: tuple[int, int, int], widths: tuple[int, int, int]) -> bytes:
    string = 0
    for value, width in zip(values, widths, strict=True):
        if not -(1 << width - 1) <= value < 1 << width - 1:
            raise ValueError(f"{value} does not fit {width} bits")
        for done in range(0, width, 8):
            bits = min(width - done, 8)
            string = string << bits | value >> done & ((1 << bits) - 1)
    return string.to_bytes(sum(widths) // 8, "big")


def _unpack(data: bytes, widths: tuple[int, int, int]) -> tuple[int, ...]:
    string, left, values = int.from_bytes(data, "big"), 8 * len(data), []
    for width in widths:
        value = 0
        for done in range(0, width, 8):
            bits = min(width - done, 8)
            left -= bits
            value |= (string >> left & ((1 << bits) - 1)) << done
        values.append(value - (1 << width) if value >> width - 1 else value)
    return tuple(values)


# FiRa's downlink TDoA as packets of a system without a master.
#
# In a round an initiator sends a poll, responders answer it one after the other, and mostly the initiator sends a
# final message. A response says how long after the poll it left, in its sender's clock: so its sender received the
# poll that much before. That is what packets of a system without a master relay (``masterless_packets``), and
# positions are estimated from both alike. The final message relays the responses in the same way.
#
# Where anchors stamp in the initiator's time instead of their own clocks, the poll reached a responder one flight
# after it left, in that time.

MAX_ROUNDS_AT_ONCE: Final = 256
MAX_ANCHORS_KEPT: Final = 256
"""Limits of rounds in progress, and of positions and responses by address; the oldest is dropped first."""


class DtMessage(Struct, frozen=True, gc=False):
    """One message of a round as a tag received it; stamps have 40 bits."""

    host_s: float | None
    address: int
    """MAC address of the sender."""
    kind: DtMessageType
    block: int
    round: int
    """Identifies the round among simultaneous ones: any number common to its messages only."""
    tx_ticks: int
    """In the sender's clock or the initiator's time."""
    rx_ticks_tag: int
    common_time: bool
    """Whether ``tx_ticks`` is in the initiator's time."""
    responder_reply_ticks: int = 0
    initiator_reply_ticks: int = 0
    flight_ticks: float | None = None
    """Between initiator and responder, as ranged by the responder."""
    location: Point | GeodeticPoint | None = None
    """Where the sender states that it is."""


def host_time_s(stamp_ticks: int) -> float | None:
    """Time of a stamp with more than 40 bits, which bridges silences of any length; None for others.

    A 40-bit counter may be given in 64 bits; its wraps are not jumps in time.
    """
    return stamp_ticks * TICK_S if stamp_ticks > TICK_MASK else None


class _Round:
    """A round in progress: its poll, and the responses."""

    __slots__ = ("poll", "responses")

    def __init__(self, poll: DtMessage) -> None:
        self.poll = poll
        self.responses: dict[int, DtMessage] = {}
        """By their senders, so that one that is reported twice counts once."""


class AnchorFrame:
    """The coordinate frame of one recording, or of one process's boards."""

    def __init__(self, known_m: Mapping[int, Point] | None = None) -> None:
        self.known_m = known_m or {}
        """Positions that replace those stated by anchors."""
        self.origin: GeodeticPoint | None = None
        """The first geodetic position, if positions are geodetic."""
        self._is_relative = False

    def position_m(self, location: Point | GeodeticPoint | None) -> Point | None:
        """A location in this frame; None for one of the other kind."""
        if isinstance(location, GeodeticPoint):
            if self._is_relative:
                return None
            self.origin = self.origin or location
            return east_north_up_of(location.latitude_deg, location.longitude_deg, location.height_m, self.origin)
        if location is None or self.origin is not None:
            return None
        self._is_relative = True
        return location


class DtRounds:
    """Converts the messages of one tag, in order, to packets with relays."""

    def __init__(self, frame: AnchorFrame) -> None:
        self._frame = frame
        self._stated_m: dict[int, Point] = {}
        self._rounds: dict[int, _Round] = {}

    def packets(self, messages: Iterable[DtMessage | str], drops: Counter[str]) -> list[Packet]:
        """The packets of messages. Reasons, those in the place of messages too, are counted in ``drops``."""
        found = [one if isinstance(one, str) else self.on_message(one) for one in messages]
        drops.update(one for one in found if isinstance(one, str))
        return [one for one in found if isinstance(one, Packet)]

    def on_message(self, message: DtMessage) -> Packet | str:
        """The packet of a message, or the reason why it is unusable."""
        position_m = None if self._frame.known_m else self._frame.position_m(message.location)
        if position_m is not None:
            self._stated_m.pop(message.address, None)
            if len(self._stated_m) >= MAX_ANCHORS_KEPT:
                del self._stated_m[next(iter(self._stated_m))]
            self._stated_m[message.address] = position_m
        if message.kind is DtMessageType.POLL:
            self._rounds.pop(message.round, None)
            if len(self._rounds) >= MAX_ROUNDS_AT_ONCE:
                del self._rounds[next(iter(self._rounds))]
            self._rounds[message.round] = _Round(message)
            return _packet(message, position_m, ())
        going_on = self._rounds.get(message.round)
        if going_on is None or going_on.poll.block != message.block:
            return "message-without-poll"
        if message.kind is DtMessageType.RESPONSE:
            return self._response(going_on, message, position_m)
        if message.address != going_on.poll.address:
            return "final-of-another-anchor"
        relays = []
        for one in going_on.responses.values():
            rx_ticks = wrap(message.tx_ticks - one.initiator_reply_ticks)
            relays.append(Relay(one.address, _sequence(one), rx_ticks, one.flight_ticks))
        return _packet(message, position_m, tuple(relays))

    def _response(self, going_on: _Round, message: DtMessage, position_m: Point | None) -> Packet | str:
        poll = going_on.poll
        if message.address == poll.address:
            return "response-of-the-initiator"
        flight = message.flight_ticks
        if message.common_time:
            poll_m, own_m = self._position_m(poll.address), self._position_m(message.address)
            if flight is None and poll_m is not None and own_m is not None:
                flight = dist(poll_m, own_m) / TICK_M
            if flight is None:
                return "flight-unknown"
            rx_ticks = poll.tx_ticks + round(flight)
        elif message.responder_reply_ticks > 0:
            rx_ticks = message.tx_ticks - message.responder_reply_ticks
        else:
            return "reply-time-unknown"
        if message.initiator_reply_ticks > 0 and len(going_on.responses) < MAX_ANCHORS_KEPT:
            going_on.responses[message.address] = message
        return _packet(message, position_m, (Relay(poll.address, _sequence(poll), wrap(rx_ticks), flight),))

    def _position_m(self, address: int) -> Point | None:
        return self._frame.known_m.get(address, self._stated_m.get(address))


def _packet(message: DtMessage, position_m: Point | None, relays: tuple[Relay, ...]) -> Packet:
    return Packet(
        message.host_s,
        message.address,
        _sequence(message),
        message.tx_ticks,
        message.rx_ticks_tag,
        relays,
        position_m,
        claims_common_time=message.common_time,
    )


def _sequence(message: DtMessage) -> int:
    """A number that differs from those of the sender's other recent messages."""
    return (message.block << 8 | message.round & 0xFF) << 1 | (message.kind is DtMessageType.FINAL)
