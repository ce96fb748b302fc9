"""What an autopilot gets of a fix, by profile: ``ardupilot``, ``px4`` or ``gps``.

A tag has no attitude, so that none is given: the vehicle's own compass keeps its heading. Positions are north, east
and down of the site's origin.
"""

from math import floor, inf, isfinite, pi, sqrt
from typing import Final, Literal

from skyless.bridges.mavlink.messages import (
    ESTIMATOR_VISION,
    FIX_3D,
    LOCAL_NED,
    NAN,
    UNKNOWN_21,
    GpsInput,
    Odometry,
    SetGpsGlobalOrigin,
    VisionPositionEstimate,
)
from skyless.bridges.target import floored
from skyless.core.earth import east_north_up, geodetic, rotated
from skyless.core.ellipse import horizontal_ellipse
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import FixMessage, Matrix, Vector

Profile = Literal["ardupilot", "px4", "gps"]
MAVLINK_PROFILES: Final = ("ardupilot", "px4", "gps")

GPS_EPOCH_UNIX_S: Final = 315_964_800
"""6 January 1980, when GPS time began."""
LEAP_S: Final = 18
"""GPS time less UTC, since 2017."""
WEEK_MS: Final = 604_800_000

UNKNOWN_ANGLE_RAD2: Final = pi**2
"""Variance of an angle of which nothing is known, for ArduPilot, which does not check for NaN."""
UNKNOWN_HEIGHT_STD_M: Final = 100.0
UNKNOWN_CLIMB_STD_MPS: Final = 100.0
"""Standard deviations of a height that the site assumes (``height_known``) without measuring it, and of its change."""

IGNORE_HDOP: Final = 2
IGNORE_VDOP: Final = 4
IGNORE_HORIZONTAL_VELOCITY: Final = 8
IGNORE_VERTICAL_VELOCITY: Final = 16
IGNORE_SPEED_ACCURACY: Final = 32
_IGNORE_VELOCITY: Final = IGNORE_HORIZONTAL_VELOCITY | IGNORE_VERTICAL_VELOCITY | IGNORE_SPEED_ACCURACY
"""GPS_INPUT_IGNORE_FLAGS."""

MAX_SATELLITES: Final = 254
"""255 states that the count is not known."""


def micros(unix_s: float) -> int:
    """As a stamp of a message; 0, which states that there is none, before 1970 or for what is not a number."""
    return round(unix_s * 1e6) if isfinite(unix_s) and unix_s > 0.0 else 0


def vision_position_estimate(fix: FixMessage, heading_deg: float, reset_counter: int) -> VisionPositionEstimate:
    """For ArduPilot: every number is finite, angles are 0 with a variance that states that nothing is known.

    A height that is not measured goes out as it is: ArduPilot makes one number of the three variances, so that a wide
    one for the height would cost the vehicle its horizontal position as well.
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
    """For PX4: attitude, rates and an unknown velocity are NaN; a height that is not measured has a wide variance."""
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
    """A position on the Earth as a GPS receiver would give it; ``satellites`` is by default the number of anchors."""
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
    """A receiver that has no fix: nothing in it is to be used."""
    week, week_ms = gps_time(unix_s)
    return GpsInput(time_us=micros(unix_s), time_week_ms=week_ms, time_week=week)


def global_origin(origin: GeoreferenceSite, target_system: int, unix_s: float) -> SetGpsGlobalOrigin:
    """Where the site's origin is, which becomes the vehicle's."""
    return SetGpsGlobalOrigin(
        latitude_1e7=round(origin.latitude_deg * 1e7),
        longitude_1e7=round(origin.longitude_deg * 1e7),
        altitude_mm=round(origin.height_m * 1e3),
        target_system=target_system,
        time_us=micros(unix_s),
    )


def gps_time(unix_s: float) -> tuple[int, int]:
    """Week of GPS time and the milliseconds in it; (0, 0) before 1980 or after week 65535.

    Stamps before 2017 come out late, by the leap seconds added since.
    """
    since_ms = (unix_s - GPS_EPOCH_UNIX_S + LEAP_S) * 1e3 if isfinite(unix_s) else -inf
    if not 0.0 <= since_ms < 65536.0 * WEEK_MS:
        return 0, 0
    week, week_ms = divmod(floor(since_ms), WEEK_MS)
    return week, week_ms


def _dilution(value: float | None) -> float:
    """Dilution of precision as a GPS receiver states it; 0 if it is not known."""
    return value if value is not None and isfinite(value) else 0.0


def _velocity(fix: FixMessage) -> tuple[Vector, Matrix] | None:
    """Velocity and its covariance, where both are known."""
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
    """From east, north, up to north, east, down."""
    ee, en, eu, ne, nn, nu, ue, un, uu = covariance
    return nn, ne, -nu, en, ee, -eu, -un, -ue, uu


def _flat(covariance: Matrix, down_std: float) -> Matrix:
    """The covariance where nothing is known of the vertical axis."""
    nn, ne, _, en, ee, _, _, _, _ = covariance
    return nn, ne, 0.0, en, ee, 0.0, 0.0, 0.0, down_std**2


def _pose_covariance(covariance: Matrix, between: float, angle: float) -> tuple[float, ...]:
    """Upper triangle by rows of a 6 × 6 covariance: ``covariance``, ``angle`` for angles, ``between`` elsewhere."""
    nn, ne, nd, _, ee, ed, _, _, dd = covariance
    b, a = between, angle
    return nn, ne, nd, b, b, b, ee, ed, b, b, b, dd, b, b, b, a, b, b, a, b, a
