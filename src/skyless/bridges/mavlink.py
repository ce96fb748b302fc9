"""MAVLink for autopilots, without I/O: frames, the messages of each profile, and answers to the vehicle."""

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import asin, atan2, cos, floor, inf, isfinite, pi, radians, sin, sqrt
from typing import Final, Literal, cast

import msgspec
from msgspec import Struct

from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, TargetUrl, floored, require_georeference
from skyless.bridges.vehicle import Following, NewInformation, known_velocity, north_east_down
from skyless.core.air.frame import fcs
from skyless.core.earth import geodetic, horizontal_ellipse, rotated
from skyless.core.errors import SkylessError
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import LEVEL_VARIANCE, FixMessage, Matrix

# MAVLink: frames in bytes, and the few messages of its common set that are sent or read here.
#
# A frame of version 2 is ``0xFD | length | incompatible | compatible | sequence | system | component | number (24
# bits) | payload | CRC``, one of version 1 ``0xFE | length | sequence | system | component | number (8 bits) |
# payload | CRC``. Fields of messages are in the order of their bytes; a byte of the check, ``CRC_EXTRA``, stands for
# the definition. Sources: https://mavlink.io/en/guide/serialization.html and
# https://mavlink.io/en/messages/common.html.

MAGIC_1: Final = 0xFE
MAGIC_2: Final = 0xFD
HEADER_BYTES_1: Final = 6
HEADER_BYTES_2: Final = 10
CHECK_BYTES: Final = 2
SIGNATURE_BYTES: Final = 13
IS_SIGNED: Final = 0x01
"""The only incompatible flag defined: a signature follows the checksum."""


def checksum(data: bytes, crc_extra: int) -> bytes:
    """CRC-16/MCRF4XX, 802.15.4's from 0xFFFF on, of ``data`` and the byte that identifies a message's definition."""
    return fcs(data + bytes([crc_extra]), initial=0xFFFF)


class Frame(Struct, frozen=True):
    """A received frame with a correct checksum."""

    number: int
    """Number of the message."""
    system: int
    component: int
    payload: bytes
    """Without the trailing zeros cut off by its sender."""


def frame(number: int, crc_extra: int, payload: bytes, *, sequence: int, system: int, component: int) -> bytes:
    """An unsigned frame of version 2; trailing zeros of the payload are cut off, except for its first byte."""
    payload = payload.rstrip(b"\0") or payload[:1]
    body = bytes([len(payload), 0, 0, sequence & 0xFF, system, component]) + number.to_bytes(3, "little") + payload
    return bytes([MAGIC_2]) + body + checksum(body, crc_extra)


class FrameReader:
    """Finds frames of both versions in a stream of bytes; yields only messages in ``crc_extras``.

    Signatures are skipped, not checked.
    """

    def __init__(self, crc_extras: Mapping[int, int]) -> None:
        """``crc_extras``: for each message number, the byte that identifies its definition."""
        self._crc_extras = crc_extras
        self._buffer = bytearray()
        self.damaged = 0
        """Number of frame starts that were no frame."""

    def frames(self, data: bytes) -> Iterator[Frame]:
        """The frames that end in ``data``, which continues the previous call's."""
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
        """Length of the frame at the start; None until known."""
        if len(self._buffer) < 3:
            return None
        if self._buffer[0] == MAGIC_1:
            return HEADER_BYTES_1 + self._buffer[1] + CHECK_BYTES
        signature = SIGNATURE_BYTES if self._buffer[2] & IS_SIGNED else 0
        return HEADER_BYTES_2 + self._buffer[1] + CHECK_BYTES + signature

    def _checked(self, length: int) -> Frame | None:
        """The whole frame at the start, None if damaged. An unknown message's checksum cannot be verified."""
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
        if crc_extra is not None and data[end : end + CHECK_BYTES] != checksum(data[1:end], crc_extra):
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
"""MAV_FRAME: north, east, down from an origin fixed to the Earth."""
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
    """GPS_GLOBAL_ORIGIN: a vehicle's statement of its origin."""

    latitude_1e7: int
    longitude_1e7: int
    altitude_mm: int
    time_us: int = 0


class Timesync(Struct, frozen=True):
    """TIMESYNC: a request has ``answered_ns`` 0; the answer repeats the request's ``asked_ns``."""

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
    """ODOMETRY: m, m/s, rad/s; both covariances as in ``VisionPositionEstimate``; NaN if unknown."""

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
    """GPS_INPUT; by default that of a receiver without a fix, with nothing to be used."""

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
_ATTITUDE, _LOCAL_POSITION_NED, HIGHRES_IMU, _EKF_STATUS, _ESTIMATOR_STATUS, _ODOMETRY = 30, 32, 105, 193, 230, 331
_STATES: Final = {
    _ATTITUDE: (39, struct.Struct("<4x3f")),  # roll, pitch, yaw
    _LOCAL_POSITION_NED: (185, struct.Struct("<4x3f")),
    HIGHRES_IMU: (93, struct.Struct("<Q6f")),  # time in µs, specific force, rate
    _EKF_STATUS: (71, struct.Struct("<20xH")),  # flags: EKF_STATUS_REPORT of ArduPilot
    _ESTIMATOR_STATUS: (163, struct.Struct("<40xH")),  # flags
    _ODOMETRY: (91, struct.Struct("<8x3f208xB")),  # position, frame
}
"""What a vehicle says of itself: for each message CRC_EXTRA and its first fields."""
CRC_EXTRAS: Final = {_LAYOUTS[kind].number: _LAYOUTS[kind].crc_extra for kind in _READ} | {
    number: crc_extra for number, (crc_extra, _) in _STATES.items()
}
"""CRC_EXTRA of the messages read here, by number."""


def encoded(message: Message, *, sequence: int, system: int, component: int) -> bytes:
    """Encode a message as a frame of MAVLink 2. Raises struct.error, OverflowError: a value does not fit its field."""
    layout = _LAYOUTS[type(message)]
    values: list[float] = []
    for value in msgspec.structs.astuple(message):
        values.extend(value if isinstance(value, tuple) else (value,))
    payload = layout.fields.pack(*values)
    return frame(layout.number, layout.crc_extra, payload, sequence=sequence, system=system, component=component)


def decoded(received: Frame) -> Heartbeat | Timesync | GpsGlobalOrigin | tuple[float, ...]:
    """Decode a frame whose number is in ``CRC_EXTRAS``; missing fields at its end are 0."""
    kind = _READ_BY_NUMBER.get(received.number)
    fields = _STATES[received.number][1] if kind is None else _LAYOUTS[kind].fields
    values = fields.unpack(received.payload.ljust(fields.size, b"\0")[: fields.size])
    return values if kind is None else kind(*values)


# What an autopilot gets of a fix, by profile: ``ardupilot``, ``px4`` or ``gps``.
#
# A tag without a motion sensor has no attitude: the vehicle's own compass keeps its heading. Positions are north, east
# and down of the site's origin.

Profile = Literal["ardupilot", "px4", "gps"]
MAVLINK_PROFILES: Final = ("ardupilot", "px4", "gps")

GPS_EPOCH_UNIX_S: Final = 315_964_800
"""6 January 1980, the beginning of GPS time."""
LEAP_S: Final = 18
"""GPS time minus UTC, since 2017."""
WEEK_MS: Final = 604_800_000

UNKNOWN_ANGLE_RAD2: Final = pi**2
"""Variance of an unknown angle, for ArduPilot, which does not check for NaN."""
UNKNOWN_HEIGHT_STD_M: Final = 100.0
"""Standard deviation of a height that is given (``height_known``) rather than measured."""

IGNORE_HDOP: Final = 2
IGNORE_VDOP: Final = 4
IGNORE_HORIZONTAL_VELOCITY: Final = 8
IGNORE_VERTICAL_VELOCITY: Final = 16
IGNORE_SPEED_ACCURACY: Final = 32
_IGNORE_VELOCITY: Final = IGNORE_HORIZONTAL_VELOCITY | IGNORE_VERTICAL_VELOCITY | IGNORE_SPEED_ACCURACY
"""GPS_INPUT_IGNORE_FLAGS."""

MAX_SATELLITES: Final = 254
"""255 means that the count is unknown."""


def micros(unix_s: float) -> int:
    """Timestamp of a message; 0, meaning none, before 1970 or for NaN and infinity."""
    return round(unix_s * 1e6) if isfinite(unix_s) and unix_s > 0.0 else 0


def vision_position_estimate(fix: FixMessage, heading_deg: float, reset_counter: int) -> VisionPositionEstimate:
    """For ArduPilot: all numbers are finite; angles are 0 with a variance that marks them as unknown.

    A given height is sent unchanged: ArduPilot combines the three variances into one number, so a wide one for the
    height would cost the vehicle its horizontal position as well.
    """
    w, x, y, z = _orientation_ned(fix, heading_deg) or (1.0, 0.0, 0.0, 0.0)
    return VisionPositionEstimate(
        time_us=micros(fix.unix_s),
        position=north_east_down(fix.position_m, heading_deg),
        roll=atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        pitch=asin(max(min(2.0 * (w * y - z * x), 1.0), -1.0)),
        yaw=atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
        covariance=_pose_covariance(fix, _covariance_ned(fix.covariance_m2, heading_deg), 0.0, UNKNOWN_ANGLE_RAD2),
        reset_counter=reset_counter & 0xFF,
    )


def odometry(fix: FixMessage, heading_deg: float, reset_counter: int) -> Odometry:
    """For PX4: a given height has a wide variance; all else is NaN, as a filter's velocity counts positions again."""
    covariance_m2 = _covariance_ned(fix.covariance_m2, heading_deg)
    if fix.height_known:
        nn, ne, _, en, ee, _, _, _, _ = covariance_m2
        covariance_m2 = nn, ne, 0.0, en, ee, 0.0, 0.0, 0.0, UNKNOWN_HEIGHT_STD_M**2
    return Odometry(
        time_us=micros(fix.unix_s),
        position=north_east_down(fix.position_m, heading_deg),
        q=_orientation_ned(fix, heading_deg) or (NAN, NAN, NAN, NAN),
        velocity=(NAN, NAN, NAN),
        rates=(NAN, NAN, NAN),
        pose_covariance=_pose_covariance(fix, covariance_m2, NAN, NAN),
        velocity_covariance=UNKNOWN_21,
        frame_id=LOCAL_NED,
        child_frame_id=LOCAL_NED,
        reset_counter=reset_counter & 0xFF,
        estimator_type=ESTIMATOR_VISION,
        quality=0,
    )


def gps_input(fix: FixMessage, origin: GeoreferenceSite, satellites: int | None = None) -> GpsInput:
    """A position on the Earth as from a GPS receiver; ``satellites`` is by default the number of anchors."""
    latitude_deg, longitude_deg, height_m = geodetic(fix.position_m, origin)
    covariance_m2 = _covariance_ned(fix.covariance_m2, origin.heading_deg)
    hdop, vdop = _dilution(fix.hdop), _dilution(fix.vdop)
    ignore = (IGNORE_HDOP if hdop == 0.0 else 0) | (IGNORE_VDOP if vdop == 0.0 else 0)
    moving = known_velocity(fix)
    velocity, speed_std = (0.0, 0.0, 0.0), 0.0
    if moving is None:
        ignore |= _IGNORE_VELOCITY
    else:
        velocity = north_east_down(moving[0], origin.heading_deg)
        covariance = _swapped(rotated(moving[1], origin.heading_deg))
        speed_std = max(horizontal_ellipse(covariance)[0], sqrt(max(covariance[8], 0.0)))
        if fix.height_known:
            ignore |= IGNORE_VERTICAL_VELOCITY
    week, week_ms = gps_time(fix.unix_s)
    count = len(fix.anchors) if satellites is None else satellites
    return GpsInput(
        time_us=micros(fix.unix_s),
        time_week_ms=week_ms,
        latitude_1e7=round(latitude_deg * 1e7),
        longitude_1e7=round(longitude_deg * 1e7),
        altitude=height_m,
        hdop=hdop,
        vdop=vdop,
        velocity=velocity,
        speed_accuracy=speed_std,
        horizontal_accuracy=horizontal_ellipse(covariance_m2)[0],
        vertical_accuracy=UNKNOWN_HEIGHT_STD_M if fix.height_known else sqrt(covariance_m2[8]),
        ignore_flags=ignore,
        time_week=week,
        fix_type=FIX_3D,
        satellites_visible=min(count, MAX_SATELLITES),
    )


def no_gps_fix(unix_s: float) -> GpsInput:
    """A receiver without a fix, with nothing to be used."""
    week, week_ms = gps_time(unix_s)
    return GpsInput(time_us=micros(unix_s), time_week_ms=week_ms, time_week=week)


def gps_time(unix_s: float) -> tuple[int, int]:
    """GPS week and milliseconds into it; (0, 0) before 1980 or after week 65535.

    Times before 2017 come out late by the leap seconds added since.
    """
    since_ms = (unix_s - GPS_EPOCH_UNIX_S + LEAP_S) * 1e3 if isfinite(unix_s) else -inf
    if not 0.0 <= since_ms < 65536.0 * WEEK_MS:
        return 0, 0
    week, week_ms = divmod(floor(since_ms), WEEK_MS)
    return week, week_ms


def _dilution(value: float | None) -> float:
    """Dilution of precision as a GPS receiver states it; 0 if unknown."""
    return value if value is not None and isfinite(value) else 0.0


def _covariance_ned(covariance_m2: Matrix, heading_deg: float) -> Matrix:
    return floored(_swapped(rotated(covariance_m2, heading_deg)))


def _swapped(covariance: Matrix) -> Matrix:
    """Convert from east, north, up to north, east, down."""
    ee, en, eu, ne, nn, nu, ue, un, uu = covariance
    return nn, ne, -nu, en, ee, -eu, -un, -ue, uu


def _orientation_ned(fix: FixMessage, heading_deg: float) -> tuple[float, float, float, float] | None:
    """Quaternion from forward, right, down to north, east, down of the fix's from forward, left, up to the site."""
    if fix.orientation is None:
        return None
    w, x, y, z = fix.orientation
    c, s = cos(0.5 * radians(heading_deg)), -sin(0.5 * radians(heading_deg))  # the site's y axis is turned clockwise
    w, x, y, z = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
    return sqrt(0.5) * (w + z), sqrt(0.5) * (x + y), sqrt(0.5) * (x - y), sqrt(0.5) * (w - z)


def _pose_covariance(fix: FixMessage, covariance: Matrix, between: float, unknown: float) -> tuple[float, ...]:
    """Upper triangle by rows of a 6 × 6 covariance: the position's, ``between`` that and angles, and the angles'.

    These are roll, pitch and heading, with the variance ``unknown`` where the orientation is not known.
    """
    nn, ne, nd, _, ee, ed, _, _, dd = covariance
    b, a, heading, apart = between, unknown, unknown, between
    if fix.heading_std_rad is not None:
        a, heading, apart = LEVEL_VARIANCE, fix.heading_std_rad**2, 0.0
    return nn, ne, nd, b, b, b, ee, ed, b, b, b, dd, b, b, b, a, apart, apart, a, apart, heading


AUTOPILOT: Final = 1
"""Component of a vehicle's flight controller."""
VISUAL_POSITIONING: Final = 197
"""Ours, MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""

_GONE_S: Final = 3
"""A vehicle silent for this time, in seconds, may have restarted and lost its origin."""

_NEAR_1E7: Final = 10
"""Origins within this difference, in 10⁻⁷ degrees, count as equal: 11 cm."""

_NEAR_MM: Final = 100

_KNOWS_PLACE, _NONSENSE = 8 | 16, 1e6
"""Flags of ESTIMATOR_STATUS: horizontal position, relative or absolute. No value that a vehicle states is larger."""


class MavlinkEncoder(Encoder):
    """Messages for one vehicle about one tag."""

    one_tag = True

    def __init__(
        self,
        profile: Profile,
        *,
        text: str = "mavlink",
        system: int = 1,
        component: int = VISUAL_POSITIONING,
        satellites: int | None = None,
        heading_deg: float | None = None,
        log: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """``system``: the vehicle's, used as ours too; ``text`` names the target in messages.

        ``satellites``: stated by profile ``gps`` instead of the number of anchors. ``heading_deg``: azimuth of the y
        axis of a site without georeference. ``log`` shows a line to the user.
        """
        self._profile = profile
        self._text = text
        self._system, self._component = system, component
        self._satellites = satellites
        self._site: BridgedSite | None = None
        self._given_heading_deg = heading_deg
        self._heading_deg = 0.0
        self._sequence = 0
        self._reset_counter = 0
        self._last_serial: int | None = None
        self._reader = FrameReader(CRC_EXTRAS)
        self._armed = False
        self._log = log
        self._logged: set[str] = set()
        """Subjects that have been logged."""
        self._silent_s = 0
        """Seconds since the vehicle's last message."""
        self._vehicle_origin: GpsGlobalOrigin | None = None
        """As stated by the vehicle."""
        self._new, self._following = NewInformation(), Following(profile)
        self.dropped = Counter()

    def on_site(self, site: BridgedSite) -> list[bytes]:
        """Raises SkylessError if profile ``gps`` lacks a georeference, or ``heading`` is given beside one."""
        if self._profile == "gps":
            require_georeference(site, self._text)
        if site.georeference is not None and self._given_heading_deg is not None:
            raise SkylessError(
                f"the target {self._text!r} has heading={self._given_heading_deg:g}; site {site.id} ({site.name}) has "
                f"its own, [georeference] heading_deg = {site.georeference.heading_deg:g}: leave heading out"
            )
        if self._site is not None and _has_moved(self._site, site):
            self._reset_counter += 1
            self._vehicle_origin = None
            self._new, self._following = NewInformation(), Following(self._profile)
        self._site = site
        given = self._given_heading_deg or 0.0
        self._heading_deg = given if site.georeference is None else site.georeference.heading_deg
        return []

    def on_fix(self, fix: FixMessage) -> list[bytes]:
        """One message of the profile's kind."""
        if self._site is None:
            return []
        if self._last_serial is not None and fix.serial <= self._last_serial:
            self._reset_counter += 1  # the receiver has started again
        self._last_serial = fix.serial
        self._log_assumptions(fix)
        try:
            if self._profile == "gps":
                origin = require_georeference(self._site, self._text)
                return self._frames([gps_input(fix, origin, self._satellites)])
            new = self._new.of(fix)
            self._following.on_given(new, fix, self._heading_deg)
            if self._profile == "ardupilot":
                return self._frames([vision_position_estimate(new, self._heading_deg, self._reset_counter)])
            return self._frames([odometry(new, self._heading_deg, self._reset_counter)])
        except (struct.error, OverflowError, ValueError):
            self.dropped["mavlink-value"] += 1  # finite, and still beyond what a field can hold
            return []

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:  # noqa: ARG002 - the vehicle has no use
        """A GPS message without a fix; other profiles are silent, which the autopilot notices."""
        return self._frames([no_gps_fix(unix_s)]) if self._profile == "gps" else []

    def on_second(self, unix_s: float) -> list[bytes]:
        """The heartbeat, and the site's origin until the vehicle has one or is armed; logs how the vehicle does."""
        self._silent_s += 1
        if self._silent_s >= _GONE_S:
            self._vehicle_origin = None
        elif words := self._following.verdict(unix_s, self._heading_deg):
            self._log(f"{self._text}: {words}")
        messages: list[Message] = [Heartbeat()]
        origin = self._origin(unix_s)
        if origin is not None and self._vehicle_origin is None and not self._armed:
            messages.append(origin)
        return self._frames(messages)

    def on_bytes(self, data: bytes, unix_ns: int) -> list[bytes]:
        """Process the vehicle's bytes, received at ``unix_ns``. Returns answers to its time requests."""
        answers: list[Message] = []
        damaged = self._reader.damaged
        for frame in self._reader.frames(data):
            if (frame.system, frame.component) != (self._system, AUTOPILOT):
                continue
            self._silent_s = 0
            message = decoded(frame)
            if isinstance(message, Heartbeat):
                self._armed = bool(message.base_mode & ARMED)
            elif isinstance(message, GpsGlobalOrigin):
                self._vehicle_origin = message
                self._compare_origin(message, unix_ns)
            elif isinstance(message, tuple):
                self._on_state(frame.number, message, unix_ns * 1e-9)
            elif message.answered_ns == 0:
                answers.append(Timesync(answered_ns=unix_ns, asked_ns=message.asked_ns))
        if self._reader.damaged > damaged:
            self.dropped["mavlink-check"] += self._reader.damaged - damaged
        return self._frames(answers)

    def _on_state(self, number: int, values: tuple[float, ...], unix_s: float) -> None:
        """Process what the vehicle says of itself, a message of ``_STATES``."""
        following = self._following
        if not all(abs(value) < _NONSENSE for value in values if isinstance(value, float)):
            self.dropped["mavlink-nonsense"] += 1
        elif number == _ATTITUDE:
            following.attitude_rad = values
        elif number in {_EKF_STATUS, _ESTIMATOR_STATUS}:
            following.is_used = bool(int(values[0]) & _KNOWS_PLACE)
        elif number == HIGHRES_IMU:
            following.on_motion(unix_s, values[0] * 1e-6, values[1:])
        elif values[3:] in ((), (LOCAL_NED,)):
            following.on_position(unix_s, values[:3])

    def _origin(self, unix_s: float) -> SetGpsGlobalOrigin | None:
        """The site's origin, to become the vehicle's; None if it has none, or the vehicle derives it from GPS_INPUT."""
        if self._site is None or (origin := self._site.georeference) is None or self._profile == "gps":
            return None
        return SetGpsGlobalOrigin(
            latitude_1e7=round(origin.latitude_deg * 1e7),
            longitude_1e7=round(origin.longitude_deg * 1e7),
            altitude_mm=round(origin.height_m * 1e3),
            target_system=self._system,
            time_us=micros(unix_s),
        )

    def _compare_origin(self, vehicle: GpsGlobalOrigin, unix_ns: int) -> None:
        """Log a difference between the vehicle's origin and the site's."""
        site = self._origin(unix_ns * 1e-9)
        if site is None or (
            abs(vehicle.latitude_1e7 - site.latitude_1e7) <= _NEAR_1E7
            and abs(vehicle.longitude_1e7 - site.longitude_1e7) <= _NEAR_1E7
            and abs(vehicle.altitude_mm - site.altitude_mm) <= _NEAR_MM
        ):
            return
        self._log_once(
            "origin",
            f"the vehicle states the origin {_words(vehicle)}, and the site's is {_words(site)}: its latitude, "
            "longitude and height are wrong by the difference; restart the vehicle if it keeps that origin",
        )

    def _log_assumptions(self, fix: FixMessage) -> None:
        """Log what the vehicle assumes to be known but is not."""
        site = self._site
        if site is not None and site.georeference is None and self._given_heading_deg is None:
            self._log_once(
                "north",
                f"site {site.id} ({site.name}) does not say where north is, and its y axis is taken for it; give "
                "heading=, the azimuth of the y axis in degrees, or [georeference] in the site file",
            )
        if fix.height_known and self._profile == "ardupilot":
            self._log_once(
                "height",
                "heights are the site's tags.height_m and not measured, which this message cannot say to ArduPilot: "
                "it should have EK3_SRC1_POSZ 1, the barometer",
            )

    def _log_once(self, subject: str, line: str) -> None:
        if subject not in self._logged:
            self._logged.add(subject)
            self._log(f"{self._text}: {line}")

    def _frames(self, messages: Iterable[Message]) -> list[bytes]:
        frames = []
        for message in messages:
            frames.append(encoded(message, sequence=self._sequence, system=self._system, component=self._component))
            self._sequence = (self._sequence + 1) & 0xFF
        return frames


def _has_moved(before: BridgedSite, after: BridgedSite) -> bool:
    """Whether positions are in another frame than before; a tag may just have learned of more anchors."""
    return before.georeference != after.georeference or any(
        after.anchors_m.get(anchor, position_m) != position_m for anchor, position_m in before.anchors_m.items()
    )


def _words(origin: GpsGlobalOrigin | SetGpsGlobalOrigin) -> str:
    return f"{origin.latitude_1e7 / 1e7:.7f}, {origin.longitude_1e7 / 1e7:.7f}, {origin.altitude_mm / 1e3:.2f} m"


def make_encoder(url: TargetUrl, context: BridgeContext) -> MavlinkEncoder:
    """Keys: ``profile``, which has no default; ``system`` and ``component``; ``satellites``; ``heading``.

    Raises SkylessError: one of them is not right.
    """
    return MavlinkEncoder(
        cast(Profile, url.choice("profile", MAVLINK_PROFILES, "")),
        text=url.text,
        system=url.whole_number("system", 1, 1, 255),
        component=url.whole_number("component", VISUAL_POSITIONING, 1, 255),
        satellites=url.whole_number("satellites", 0, 0, MAX_SATELLITES) if url.has("satellites") else None,
        heading_deg=url.number("heading", 0.0, -360.0, 360.0) if url.has("heading") else None,
        log=context.log,
    )
