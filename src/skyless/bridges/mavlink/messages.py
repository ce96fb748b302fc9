"""The few messages of MAVLink's common set that are sent or read here, with fields in the order of their bytes.

Numbers, fields and units: https://mavlink.io/en/messages/common.html. A byte of the check, ``CRC_EXTRA``, stands for a
message's definition.
"""

import struct
from typing import Final

import msgspec
from msgspec import Struct

from skyless.bridges.mavlink.frames import Frame, frame

NAN: Final = float("nan")
UNKNOWN_21: Final = (NAN,) * 21

ONBOARD_CONTROLLER: Final = 18
NO_AUTOPILOT: Final = 8
ACTIVE: Final = 4
"""Type, autopilot and state in our heartbeat."""
ARMED: Final = 0x80
"""Of a vehicle's ``base_mode``."""

LOCAL_NED: Final = 1
"""MAV_FRAME: north, east, down of an origin that rests on the Earth."""
ESTIMATOR_VISION: Final = 2
"""MAV_ESTIMATOR_TYPE."""

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
    """GPS_INPUT."""

    time_us: int
    time_week_ms: int
    latitude_1e7: int
    longitude_1e7: int
    altitude: float
    """m above sea level."""
    hdop: float
    vdop: float
    velocity: tuple[float, float, float]
    """North, east, down, m/s."""
    speed_accuracy: float
    horizontal_accuracy: float
    vertical_accuracy: float
    ignore_flags: int
    time_week: int
    gps_id: int
    fix_type: int
    satellites_visible: int
    yaw_cdeg: int
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
"""Of the messages that are read here."""


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
