"""MAVLink for autopilots, without I/O: frames, the messages of each profile for a fix, and answers to the vehicle."""

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import floor, inf, isfinite, pi, sqrt
from typing import Final, Literal, cast

import msgspec
from msgspec import Struct

from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, TargetUrl, floored, require_georeference
from skyless.core.earth import east_north_up, geodetic, horizontal_ellipse, rotated
from skyless.core.errors import SkylessError
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import FixMessage, Matrix, Vector

# MAVLink: frames in bytes, and the few messages of its common set that are sent or read here.
#
# A frame of version 2 is ``0xFD | length | incompatible | compatible | sequence | system | component | number (24
# bits) | payload | CRC``, one of version 1 ``0xFE | length | sequence | system | component | number (8 bits) |
# payload | CRC``. The fields of messages are here in the order of their bytes. The CRC also covers a byte,
# ``CRC_EXTRA``, that stands for the message's definition. Sources: https://mavlink.io/en/guide/serialization.html and
# https://mavlink.io/en/messages/common.html.

MAGIC_1: Final = 0xFE
MAGIC_2: Final = 0xFD
HEADER_BYTES_1: Final = 6
HEADER_BYTES_2: Final = 10
CHECK_BYTES: Final = 2
SIGNATURE_BYTES: Final = 13
IS_SIGNED: Final = 0x01
"""The only incompatibility flag defined: a signature follows the checksum."""


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
    """CRC-16/MCRF4XX of ``data`` followed by the byte ``crc_extra``."""
    value = 0xFFFF
    for byte in data:
        value = (value >> 8) ^ _CRC[(value ^ byte) & 0xFF]
    return (value >> 8) ^ _CRC[(value ^ crc_extra) & 0xFF]


class Frame(Struct, frozen=True):
    """A received frame with a correct checksum."""

    number: int
    """Number of the message type."""
    system: int
    component: int
    payload: bytes
    """Payload without trailing zeros that its sender has cut off."""


def frame(number: int, crc_extra: int, payload: bytes, *, sequence: int, system: int, component: int) -> bytes:
    """Make an unsigned frame of version 2; trailing zeros of the payload are cut off, except its first byte."""
    payload = payload.rstrip(b"\0") or payload[:1]
    body = bytes([len(payload), 0, 0, sequence & 0xFF, system, component]) + number.to_bytes(3, "little") + payload
    return bytes([MAGIC_2]) + body + crc(body, crc_extra).to_bytes(CHECK_BYTES, "little")


class FrameReader:
    """Finds frames of both versions in a stream of bytes, of the message types in ``crc_extras`` only.

    Signatures are skipped, not checked.
    """

    def __init__(self, crc_extras: Mapping[int, int]) -> None:
        """``crc_extras``: ``CRC_EXTRA`` by message number."""
        self._crc_extras = crc_extras
        self._buffer = bytearray()
        self.damaged = 0
        """How often bytes that began like a frame were no frame."""

    def frames(self, data: bytes) -> Iterator[Frame]:
        """Yield the frames that end in ``data``, the next piece of the stream."""
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
        """The whole frame at the start; None if it is damaged. Frames of unknown messages cannot be checked."""
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
"""Type, autopilot and state in the heartbeat sent."""
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
    """GPS_GLOBAL_ORIGIN, by which a vehicle states its origin."""

    latitude_1e7: int
    longitude_1e7: int
    altitude_mm: int
    time_us: int = 0


class Timesync(Struct, frozen=True):
    """TIMESYNC: a request has ``answered_ns`` 0; its answer repeats the request's ``asked_ns``."""

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
    """ODOMETRY: m, m/s, rad/s; both covariances as in ``VisionPositionEstimate``; NaN means unknown."""

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
    """GPS_INPUT; the defaults are those of a receiver without a fix, with all fields to be ignored."""

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
    """0 means unknown."""


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
"""``CRC_EXTRA`` of the messages that are read, by number."""


def encoded(message: Message, *, sequence: int, system: int, component: int) -> bytes:
    """Encode a message as a frame of MAVLink 2.

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
    """Decode the message of a frame whose number is in ``CRC_EXTRAS``; fields missing at its end are 0."""
    kind = _READ_BY_NUMBER[received.number]
    fields = _LAYOUTS[kind].fields
    return kind(*fields.unpack(received.payload.ljust(fields.size, b"\0")[: fields.size]))


# Messages to an autopilot about a fix, by profile: ``ardupilot``, ``px4`` or ``gps``.
#
# A tag does not know its attitude, so none is sent: the vehicle's compass keeps its heading. Positions are north, east
# and down from the site's origin.

Profile = Literal["ardupilot", "px4", "gps"]
MAVLINK_PROFILES: Final = ("ardupilot", "px4", "gps")

GPS_EPOCH_UNIX_S: Final = 315_964_800
"""6 January 1980, when GPS time began."""
LEAP_S: Final = 18
"""GPS time minus UTC, since 2017."""
WEEK_MS: Final = 604_800_000

UNKNOWN_ANGLE_RAD2: Final = pi**2
"""Variance of an unknown angle, for ArduPilot, which does not check for NaN."""
UNKNOWN_HEIGHT_STD_M: Final = 100.0
UNKNOWN_CLIMB_STD_MPS: Final = 100.0
"""Standard deviations of a height that is assumed and not measured (``height_known``), and of its rate."""

IGNORE_HDOP: Final = 2
IGNORE_VDOP: Final = 4
IGNORE_HORIZONTAL_VELOCITY: Final = 8
IGNORE_VERTICAL_VELOCITY: Final = 16
IGNORE_SPEED_ACCURACY: Final = 32
_IGNORE_VELOCITY: Final = IGNORE_HORIZONTAL_VELOCITY | IGNORE_VERTICAL_VELOCITY | IGNORE_SPEED_ACCURACY
"""GPS_INPUT_IGNORE_FLAGS."""

MAX_SATELLITES: Final = 254
"""255 would mean that the count is unknown."""


def micros(unix_s: float) -> int:
    """Convert a time to a message's stamp in µs; 0, which means none, before 1970 or if it is not finite."""
    return round(unix_s * 1e6) if isfinite(unix_s) and unix_s > 0.0 else 0


def vision_position_estimate(fix: FixMessage, heading_deg: float, reset_counter: int) -> VisionPositionEstimate:
    """Convert a fix for ArduPilot: every number is finite; angles are 0 with the variance of an unknown angle.

    The variance of a height that is not measured is left as it is: ArduPilot combines the three variances into one
    number, so a large one for the height would cost the vehicle its horizontal position, too.
    """
    return VisionPositionEstimate(
        time_us=micros(fix.unix_s),
        position=_ned(fix.position_m, heading_deg),
        roll=0.0,
        pitch=0.0,
        yaw=0.0,
        covariance=_pose_covariance(_covariance_ned(fix.covariance_m2, heading_deg), 0.0, UNKNOWN_ANGLE_RAD2),
        reset_counter=reset_counter & 0xFF,
    )


def odometry(fix: FixMessage, heading_deg: float, reset_counter: int) -> Odometry:
    """Convert a fix for PX4: attitude, rates and an unknown velocity are NaN; an unmeasured height is uncertain."""
    covariance_m2 = _covariance_ned(fix.covariance_m2, heading_deg)
    if fix.height_known:
        covariance_m2 = _flat(covariance_m2, UNKNOWN_HEIGHT_STD_M)
    moving = _velocity(fix)
    if moving is None:
        velocity: Vector = (NAN, NAN, NAN)
        velocity_covariance: tuple[float, ...] = UNKNOWN_21
    else:
        velocity = _ned(moving[0], heading_deg)
        covariance = _swapped(rotated(moving[1], heading_deg))
        if fix.height_known:
            covariance = _flat(covariance, UNKNOWN_CLIMB_STD_MPS)
        velocity_covariance = _pose_covariance(covariance, NAN, NAN)
    return Odometry(
        time_us=micros(fix.unix_s),
        position=_ned(fix.position_m, heading_deg),
        q=(NAN, NAN, NAN, NAN),
        velocity=velocity,
        rates=(NAN, NAN, NAN),
        pose_covariance=_pose_covariance(covariance_m2, NAN, NAN),
        velocity_covariance=velocity_covariance,
        frame_id=LOCAL_NED,
        child_frame_id=LOCAL_NED,
        reset_counter=reset_counter & 0xFF,
        estimator_type=ESTIMATOR_VISION,
        quality=0,
    )


def gps_input(fix: FixMessage, origin: GeoreferenceSite, satellites: int | None = None) -> GpsInput:
    """Convert a fix to a GPS receiver's global position; ``satellites`` is by default the number of anchors."""
    latitude_deg, longitude_deg, height_m = geodetic(fix.position_m, origin)
    covariance_m2 = _covariance_ned(fix.covariance_m2, origin.heading_deg)
    hdop, vdop = _dilution(fix.hdop), _dilution(fix.vdop)
    ignore = (IGNORE_HDOP if hdop == 0.0 else 0) | (IGNORE_VDOP if vdop == 0.0 else 0)
    moving = _velocity(fix)
    velocity, speed_std = (0.0, 0.0, 0.0), 0.0
    if moving is None:
        ignore |= _IGNORE_VELOCITY
    else:
        velocity = _ned(moving[0], origin.heading_deg)
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
    """Return the message of a GPS receiver without a fix, with all fields to be ignored."""
    week, week_ms = gps_time(unix_s)
    return GpsInput(time_us=micros(unix_s), time_week_ms=week_ms, time_week=week)


def global_origin(origin: GeoreferenceSite, target_system: int, unix_s: float) -> SetGpsGlobalOrigin:
    """Return the message that makes the site's origin the vehicle's."""
    return SetGpsGlobalOrigin(
        latitude_1e7=round(origin.latitude_deg * 1e7),
        longitude_1e7=round(origin.longitude_deg * 1e7),
        altitude_mm=round(origin.height_m * 1e3),
        target_system=target_system,
        time_us=micros(unix_s),
    )


def gps_time(unix_s: float) -> tuple[int, int]:
    """GPS week and milliseconds in it; (0, 0) before 1980 or after week 65535.

    Results for times before 2017 are too late by the leap seconds added since.
    """
    since_ms = (unix_s - GPS_EPOCH_UNIX_S + LEAP_S) * 1e3 if isfinite(unix_s) else -inf
    if not 0.0 <= since_ms < 65536.0 * WEEK_MS:
        return 0, 0
    week, week_ms = divmod(floor(since_ms), WEEK_MS)
    return week, week_ms


def _dilution(value: float | None) -> float:
    """Dilution of precision as a GPS receiver states it; 0 if unknown."""
    return value if value is not None and isfinite(value) else 0.0


def _velocity(fix: FixMessage) -> tuple[Vector, Matrix] | None:
    """Velocity and its covariance; None unless both are known."""
    velocity, covariance = fix.velocity_mps, fix.velocity_covariance
    if velocity is None or covariance is None or not all(map(isfinite, (*velocity, *covariance))):
        return None
    return velocity, covariance


def _ned(vector: Vector, heading_deg: float) -> Vector:
    east, north, up = east_north_up(vector, heading_deg)
    return north, east, -up


def _covariance_ned(covariance_m2: Matrix, heading_deg: float) -> Matrix:
    return floored(_swapped(rotated(covariance_m2, heading_deg)))


def _swapped(covariance: Matrix) -> Matrix:
    """Convert a covariance from east, north, up to north, east, down."""
    ee, en, eu, ne, nn, nu, ue, un, uu = covariance
    return nn, ne, -nu, en, ee, -eu, -un, -ue, uu


def _flat(covariance: Matrix, down_std: float) -> Matrix:
    """Replace the vertical part of a covariance by that of an unknown quantity."""
    nn, ne, _, en, ee, _, _, _, _ = covariance
    return nn, ne, 0.0, en, ee, 0.0, 0.0, 0.0, down_std**2


def _pose_covariance(covariance: Matrix, between: float, angle: float) -> tuple[float, ...]:
    """Upper triangle by rows of a 6 × 6 covariance: ``covariance``, ``angle`` for angles, ``between`` elsewhere."""
    nn, ne, nd, _, ee, ed, _, _, dd = covariance
    b, a = between, angle
    return nn, ne, nd, b, b, b, ee, ed, b, b, b, dd, b, b, b, a, b, b, a, b, a


AUTOPILOT: Final = 1
"""Component of a vehicle's flight controller."""
VISUAL_POSITIONING: Final = 197
"""The own component, MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""

_GONE_S: Final = 3
"""A vehicle that has been silent for this long, in seconds, may have been restarted, and then has no origin."""

_NEAR_1E7: Final = 10
_NEAR_MM: Final = 100
"""Largest differences of latitude and longitude (1e-7 °, here 11 cm) and height between equal origins."""


class MavlinkEncoder(Encoder):
    """Encodes messages for one vehicle about one tag."""

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
        """``system`` is the vehicle's and our own; ``text`` names the target in messages.

        ``satellites`` is stated by profile ``gps`` instead of the number of anchors. ``heading_deg`` is the azimuth of
        the y axis of a site without a georeference. ``log`` shows a line to a person.
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
        """Subjects of lines that were logged."""
        self._silent_s = 0
        """Seconds since the vehicle's last message."""
        self._vehicle_origin: GpsGlobalOrigin | None = None
        """The vehicle's origin, as the vehicle states it."""
        self.dropped = Counter()

    def on_site(self, site: BridgedSite) -> list[bytes]:
        """Keep the site. Raises SkylessError without a georeference for ``gps``, or with one and a given heading."""
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
        self._site = site
        given = self._given_heading_deg or 0.0
        self._heading_deg = given if site.georeference is None else site.georeference.heading_deg
        return []

    def on_fix(self, fix: FixMessage) -> list[bytes]:
        """Encode the profile's message for a fix."""
        if self._site is None:
            return []
        if self._last_serial is not None and fix.serial <= self._last_serial:
            self._reset_counter += 1  # the receiver was restarted
        self._last_serial = fix.serial
        self._log_assumptions(fix)
        try:
            if self._profile == "ardupilot":
                return self._frames([vision_position_estimate(fix, self._heading_deg, self._reset_counter)])
            if self._profile == "px4":
                return self._frames([odometry(fix, self._heading_deg, self._reset_counter)])
            origin = require_georeference(self._site, self._text)
            return self._frames([gps_input(fix, origin, self._satellites)])
        except (struct.error, OverflowError, ValueError):
            self.dropped["mavlink-value"] += 1  # finite, but too large for its field
            return []

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:  # noqa: ARG002 - the vehicle has no use
        """Encode a GPS receiver without a fix. The other profiles send nothing, by which an autopilot notices it."""
        return self._frames([no_gps_fix(unix_s)]) if self._profile == "gps" else []

    def on_second(self, unix_s: float) -> list[bytes]:
        """Encode the heartbeat, and the site's origin until the vehicle has one or is armed."""
        self._silent_s += 1
        if self._silent_s >= _GONE_S:
            self._vehicle_origin = None
        messages: list[Message] = [Heartbeat()]
        origin = self._origin(unix_s)
        if origin is not None and self._vehicle_origin is None and not self._armed:
            messages.append(origin)
        return self._frames(messages)

    def on_bytes(self, data: bytes, unix_ns: int) -> list[bytes]:
        """Process data from the vehicle, received at ``unix_ns``, and answer requests for the time."""
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
            elif message.answered_ns == 0:
                answers.append(Timesync(answered_ns=unix_ns, asked_ns=message.asked_ns))
        if self._reader.damaged > damaged:
            self.dropped["mavlink-check"] += self._reader.damaged - damaged
        return self._frames(answers)

    def _origin(self, unix_s: float) -> SetGpsGlobalOrigin | None:
        """The site's origin for the vehicle; None if the site has none, or if the vehicle finds it from GPS_INPUT."""
        if self._site is None or self._site.georeference is None or self._profile == "gps":
            return None
        return global_origin(self._site.georeference, self._system, unix_s)

    def _compare_origin(self, vehicle: GpsGlobalOrigin, unix_ns: int) -> None:
        """Log if the vehicle's origin is not the site's."""
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
        """Log assumptions about north and height that the vehicle takes for facts."""
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
    """Whether positions are in another frame than before. Additional anchors, as a tag learns of them, do not count."""
    return before.georeference != after.georeference or any(
        after.anchors_m.get(anchor, position_m) != position_m for anchor, position_m in before.anchors_m.items()
    )


def _words(origin: GpsGlobalOrigin | SetGpsGlobalOrigin) -> str:
    return f"{origin.latitude_1e7 / 1e7:.7f}, {origin.longitude_1e7 / 1e7:.7f}, {origin.altitude_mm / 1e3:.2f} m"


def make_encoder(url: TargetUrl, context: BridgeContext) -> MavlinkEncoder:
    """Create the encoder. Raises SkylessError.

    Keys: ``profile``, which has no default; ``system`` and ``component``; ``satellites``; ``heading``.
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
