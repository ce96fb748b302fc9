"""MAVLink: frames in bytes, and the few messages of its common set that are sent or read here.

A frame of version 2 is ``0xFD | length | incompatible | compatible | sequence | system | component | number (24 bits) |
payload | CRC``, one of version 1 ``0xFE | length | sequence | system | component | number (8 bits) | payload | CRC``.
Fields of messages are in the order of their bytes; a byte of the check, ``CRC_EXTRA``, stands for the definition.
Sources: https://mavlink.io/en/guide/serialization.html and https://mavlink.io/en/messages/common.html.
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Final

import msgspec
from msgspec import Struct

MAGIC_1: Final = 0xFE
MAGIC_2: Final = 0xFD
HEADER_BYTES_1: Final = 6
HEADER_BYTES_2: Final = 10
CHECK_BYTES: Final = 2
SIGNATURE_BYTES: Final = 13
IS_SIGNED: Final = 0x01
"""The only incompatible flag that is defined: a signature follows the checksum."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x8408 if crc & 1 else 0)
        table.append(crc)
    return tuple(table)


_CRC: Final = _crc_table()


def crc(data: bytes, crc_extra: int) -> int:
    """CRC-16/MCRF4XX of ``data`` and then of the byte that stands for a message's definition."""
    value = 0xFFFF
    for byte in data:
        value = (value >> 8) ^ _CRC[(value ^ byte) & 0xFF]
    return (value >> 8) ^ _CRC[(value ^ crc_extra) & 0xFF]


class Frame(Struct, frozen=True):
    """A received frame whose check is right."""

    number: int
    """Number of the message."""
    system: int
    component: int
    payload: bytes
    """Without the zeros that its sender has cut off."""


def frame(number: int, crc_extra: int, payload: bytes, *, sequence: int, system: int, component: int) -> bytes:
    """A frame of version 2, unsigned; zeros at the payload's end are cut off, but for its first byte."""
    payload = payload.rstrip(b"\0") or payload[:1]
    body = bytes([len(payload), 0, 0, sequence & 0xFF, system, component]) + number.to_bytes(3, "little") + payload
    return bytes([MAGIC_2]) + body + crc(body, crc_extra).to_bytes(CHECK_BYTES, "little")


class FrameReader:
    """Finds frames of both versions in a stream of bytes; only those of messages in ``crc_extras`` are given.

    Signatures are skipped, not checked.
    """

    def __init__(self, crc_extras: Mapping[int, int]) -> None:
        """``crc_extras``: for each number of a message the byte that stands for its definition."""
        self._crc_extras = crc_extras
        self._buffer = bytearray()
        self.damaged = 0
        """How often something that began like a frame was none."""

    def frames(self, data: bytes) -> Iterator[Frame]:
        """The frames that end in ``data``, which continues what was given before."""
        self._buffer += data
        while self._find_magic():
            length = self._length()
            if length is None or len(self._buffer) < length:
                return
            found = self._checked(length)
            if found is None:
                # The magic byte was one of a payload, or the frame is damaged: the next may begin within it.
                self.damaged += 1
                del self._buffer[:1]
                continue
            del self._buffer[:length]
            if found.number in self._crc_extras:
                yield found

    def _find_magic(self) -> bool:
        starts = (self._buffer.find(MAGIC_1), self._buffer.find(MAGIC_2))
        at = min((start for start in starts if start >= 0), default=len(self._buffer))
        del self._buffer[:at]
        return bool(self._buffer)

    def _length(self) -> int | None:
        """Length of the frame at the start; None until enough of it has arrived."""
        if len(self._buffer) < 3:
            return None
        if self._buffer[0] == MAGIC_1:
            return HEADER_BYTES_1 + self._buffer[1] + CHECK_BYTES
        signature = SIGNATURE_BYTES if self._buffer[2] & IS_SIGNED else 0
        return HEADER_BYTES_2 + self._buffer[1] + CHECK_BYTES + signature

    def _checked(self, length: int) -> Frame | None:
        """The whole frame at the start, None if it is damaged. That of an unknown message cannot be checked."""
        data = bytes(self._buffer[:length])
        payload_bytes = data[1]
        if data[0] == MAGIC_1:
            system, component, number, header = data[3], data[4], data[5], HEADER_BYTES_1
        else:
            system, component, header = data[5], data[6], HEADER_BYTES_2
            number = int.from_bytes(data[7:10], "little")
            if data[2] & ~IS_SIGNED:
                return None
        end = header + payload_bytes
        crc_extra = self._crc_extras.get(number)
        if crc_extra is not None:
            check = int.from_bytes(data[end : end + CHECK_BYTES], "little")
            if check != crc(data[1:end], crc_extra):
                return None
        return Frame(number, system, component, data[header:end])


NAN: Final = float("nan")
UNKNOWN_21: Final = (NAN,) * 21

ONBOARD_CONTROLLER: Final = 18
NO_AUTOPILOT: Final = 8
ACTIVE: Final = 4
"""Type, autopilot and state in our heartbeat."""
ARMED: Final = 0x80
"""Flag in a vehicle's ``base_mode``."""

LOCAL_NED: Final = 1
"""MAV_FRAME: north, east, down of an origin that rests on the Earth."""
ESTIMATOR_VISION: Final = 2
"""MAV_ESTIMATOR_TYPE."""

IGNORE_ALL: Final = 255
"""GPS_INPUT_IGNORE_FLAGS."""
NO_FIX: Final = 1
FIX_3D: Final = 3
"""GPS_FIX_TYPE."""


class Heartbeat(Struct, frozen=True):
    """HEARTBEAT."""

    custom_mode: int = 0
    type: int = ONBOARD_CONTROLLER
    autopilot: int = NO_AUTOPILOT
    base_mode: int = 0
    system_status: int = ACTIVE
    mavlink_version: int = 3


class SetGpsGlobalOrigin(Struct, frozen=True):
    """SET_GPS_GLOBAL_ORIGIN."""

    latitude_1e7: int
    longitude_1e7: int
    altitude_mm: int
    """Above sea level."""
    target_system: int
    time_us: int = 0


class GpsGlobalOrigin(Struct, frozen=True):
    """GPS_GLOBAL_ORIGIN, by which a vehicle states its origin."""

    latitude_1e7: int
    longitude_1e7: int
    altitude_mm: int
    time_us: int = 0


class Timesync(Struct, frozen=True):
    """TIMESYNC: a request has ``answered_ns`` 0, and its answer the request's ``asked_ns`` again."""

    answered_ns: int
    asked_ns: int


class VisionPositionEstimate(Struct, frozen=True):
    """VISION_POSITION_ESTIMATE: m and rad; covariance of x, y, z, roll, pitch, yaw as the upper triangle by rows."""

    time_us: int
    position: tuple[float, float, float]
    roll: float
    pitch: float
    yaw: float
    covariance: tuple[float, ...]
    reset_counter: int


class Odometry(Struct, frozen=True):
    """ODOMETRY: m, m/s, rad/s; both covariances as in ``VisionPositionEstimate``; NaN where something is unknown."""

    time_us: int
    position: tuple[float, float, float]
    q: tuple[float, float, float, float]
    velocity: tuple[float, float, float]
    rates: tuple[float, float, float]
    pose_covariance: tuple[float, ...]
    velocity_covariance: tuple[float, ...]
    frame_id: int
    child_frame_id: int
    reset_counter: int
    estimator_type: int
    quality: int


class GpsInput(Struct, frozen=True):
    """GPS_INPUT; by default of a receiver without a fix, nothing of which is to be used."""

    time_us: int
    time_week_ms: int
    latitude_1e7: int = 0
    longitude_1e7: int = 0
    altitude: float = 0.0
    """m above sea level."""
    hdop: float = 0.0
    vdop: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """North, east, down, m/s."""
    speed_accuracy: float = 0.0
    horizontal_accuracy: float = 0.0
    vertical_accuracy: float = 0.0
    ignore_flags: int = IGNORE_ALL
    time_week: int = 0
    gps_id: int = 0
    fix_type: int = NO_FIX
    satellites_visible: int = 0
    yaw_cdeg: int = 0
    """0: not known."""


Message = Heartbeat | SetGpsGlobalOrigin | GpsGlobalOrigin | Timesync | VisionPositionEstimate | Odometry | GpsInput


class _Layout(Struct, frozen=True):
    number: int
    crc_extra: int
    fields: struct.Struct


_LAYOUTS: Final[dict[type[Message], _Layout]] = {
    Heartbeat: _Layout(0, 50, struct.Struct("<IBBBBB")),
    SetGpsGlobalOrigin: _Layout(48, 41, struct.Struct("<iiiBQ")),
    GpsGlobalOrigin: _Layout(49, 39, struct.Struct("<iiiQ")),
    VisionPositionEstimate: _Layout(102, 158, struct.Struct("<Q6f21fB")),
    Timesync: _Layout(111, 34, struct.Struct("<qq")),
    GpsInput: _Layout(232, 151, struct.Struct("<QIii9fHHBBBH")),
    Odometry: _Layout(331, 91, struct.Struct("<Q3f4f3f3f21f21fBBBBb")),
}

_READ: Final[tuple[type[Heartbeat | Timesync | GpsGlobalOrigin], ...]] = (Heartbeat, Timesync, GpsGlobalOrigin)
_READ_BY_NUMBER: Final = {_LAYOUTS[kind].number: kind for kind in _READ}
CRC_EXTRAS: Final = {_LAYOUTS[kind].number: _LAYOUTS[kind].crc_extra for kind in _READ}
"""CRC_EXTRA of the messages that are read here, by number."""


def encoded(message: Message, *, sequence: int, system: int, component: int) -> bytes:
    """The message as a frame of MAVLink 2.

    Raises:
        struct.error, OverflowError: a value does not fit its field.
    """
    layout = _LAYOUTS[type(message)]
    values: list[float] = []
    for value in msgspec.structs.astuple(message):
        values.extend(value if isinstance(value, tuple) else (value,))
    payload = layout.fields.pack(*values)
    return frame(layout.number, layout.crc_extra, payload, sequence=sequence, system=system, component=component)


def decoded(received: Frame) -> Heartbeat | Timesync | GpsGlobalOrigin:
    """The message of a frame whose number is in ``CRC_EXTRAS``; fields that are missing at its end are 0."""
    kind = _READ_BY_NUMBER[received.number]
    fields = _LAYOUTS[kind].fields
    return kind(*fields.unpack(received.payload.ljust(fields.size, b"\0")[: fields.size]))
