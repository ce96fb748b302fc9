"""NMEA 0183: fixes like those of a satellite receiver, for gpsd, QGIS, OpenCPN, autopilots.

One epoch is one write of five sentences: RMC, GGA, GST, GBS, GSA. Formats: E. S. Raymond, NMEA Revealed
(https://gpsd.gitlab.io/gpsd/NMEA.html); u-blox, M8 interface description, UBX-13003221, chapter 31.
"""

from collections import Counter
from datetime import UTC, datetime
from functools import reduce
from math import atan2, degrees, hypot, isfinite, sqrt
from operator import xor
from typing import Final

from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, TargetUrl, floored, require_georeference
from skyless.core.earth import east_north_up, geodetic, horizontal_ellipse, rotated
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import FixMessage

KNOT_MPS: Final = 1852.0 / 3600.0
MINUTE_UNITS: Final = 10_000_000
"""Minutes of arc are written with seven decimals: 0.2 mm. Six would lose 2 mm."""

SLOT_COUNT: Final = 12
"""Satellites that GSA has fields for; further anchors only count in GGA."""

COURSE_SIGMAS: Final = 2.0
"""A course is given if the speed exceeds this many of its standard deviations."""

_LARGEST_DOP: Final = 99.99
"""Limit used by receivers."""

_LARGEST_ANCHOR: Final = 999
"""GSA has three digits; anchors with larger numbers only count in GGA."""

_FARTHEST_M: Final = 1e5
"""Larger coordinates, heights and standard deviations are no measurement; the sentences have no room for them."""

_CENTURY_S: Final = (946_684_800.0, 4_102_444_799.0)
"""Times that RMC's two-digit year can express: 2000 to 2099."""

_QUALITIES: Final = {"gps": (1, "A"), "rtk": (4, "R"), "simulator": (8, "S")}
"""GGA's quality and RMC's mode of a fix."""


class NmeaEncoder(Encoder):
    """The fixes of one tag as NMEA 0183."""

    one_tag = True

    def __init__(self, quality: str = "auto", geoid_m: float = 0.0) -> None:
        """``quality``: name of GGA's quality, or ``auto``: simulator at a simulated site, RTK at a real one.

        ``geoid_m``: height of the sea level above the ellipsoid at the site; 0 if the site file's height is above sea
        level.
        """
        self._quality, self._geoid_m = quality, geoid_m
        self.dropped: Counter[str] = Counter()
        self._site: BridgedSite | None = None

    def on_site(self, site: BridgedSite) -> list[bytes]:
        """Raises SkylessError if the site has no georeference."""
        require_georeference(site, "nmea")
        self._site = site
        return []

    def on_fix(self, fix: FixMessage) -> list[bytes]:
        """One epoch with a position."""
        if self._site is None or self._site.georeference is None:
            return []
        quality = self._quality
        if quality == "auto":
            quality = "simulator" if self._site.simulated else "rtk"
        sentences = epoch(fix, self._site.georeference, quality, self._geoid_m)
        if sentences is None:
            self.dropped["out-of-range"] += 1
            sentences = epoch_without_fix(fix.unix_s)
        return [] if sentences is None else [sentences]

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:  # noqa: ARG002 (NMEA has no reasons)
        """One epoch without a position."""
        sentences = epoch_without_fix(unix_s)
        return [] if sentences is None else [sentences]


def make_encoder(url: TargetUrl, _context: BridgeContext) -> Encoder:
    """The encoder of ``nmea+tcp``, ``nmea+udp``, ``nmea+pty``, ``nmea+serial``; keys ``quality`` and ``geoid_m``."""
    return NmeaEncoder(
        quality=url.choice("quality", ("auto", *_QUALITIES), "auto"), geoid_m=url.number("geoid_m", 0.0, -120.0, 100.0)
    )


def epoch(fix: FixMessage, origin: GeoreferenceSite, quality: str, geoid_m: float = 0.0) -> bytes | None:
    """Five sentences of one fix; None if a value is outside what the sentences can express.

    Standard deviations are towards north, east, up, each at least 1 cm. Heights are above sea level, ``geoid_m`` less
    than the ellipsoid's. A course is given only for a moving tag (``COURSE_SIGMAS``).
    """
    moment = _moment(fix.unix_s)
    if moment is None or not all(abs(value) < _FARTHEST_M for value in fix.position_m):
        return None
    time, date = moment
    latitude_deg, longitude_deg, height_m = geodetic(fix.position_m, origin)
    covariance = floored(rotated(fix.covariance_m2, origin.heading_deg))
    major_m, minor_m, direction = horizontal_ellipse(covariance)
    azimuth_deg = (90.0 - degrees(direction)) % 180.0
    east_m, north_m, up_m = (sqrt(covariance[axis]) for axis in (0, 4, 8))
    if not all(abs(value) < _FARTHEST_M for value in (height_m, major_m, east_m, north_m, up_m)):
        return None
    number, mode = _QUALITIES[quality]
    where = f"{_angle(latitude_deg, 'NS', 2)},{_angle(longitude_deg, 'EW', 3)}"
    speed, course = _motion(fix, origin.heading_deg)
    count, hdop = min(len(fix.anchors), 99), _dop(fix.hdop)
    slots = [f"{anchor:02d}" for anchor in fix.anchors if 0 <= anchor <= _LARGEST_ANCHOR][:SLOT_COUNT]
    used = ",".join(slots + [""] * (SLOT_COUNT - len(slots)))
    rms = f"{fix.residual_rms_m:.4f}" if 0.0 <= fix.residual_rms_m < _FARTHEST_M else ""
    ellipse = f"{major_m:.4f},{minor_m:.4f},{azimuth_deg:.3f}"
    return b"".join(
        (
            sentence(f"GNRMC,{time},A,{where},{speed},{course},{date},,,{mode}"),
            sentence(f"GNGGA,{time},{where},{number},{count:02d},{hdop},{height_m - geoid_m:.3f},M,{geoid_m:.3f},M,,"),
            sentence(f"GNGST,{time},{rms},{ellipse},{north_m:.4f},{east_m:.4f},{up_m:.4f}"),
            sentence(f"GNGBS,{time},{north_m:.4f},{east_m:.4f},{up_m:.4f},,,,"),
            sentence(f"GNGSA,A,3,{used},{_dop(fix.pdop)},{hdop},{_dop(fix.vdop)}"),
        )
    )


def epoch_without_fix(unix_s: float) -> bytes | None:
    """Four sentences with the time and without a position; None for a time that RMC cannot express.

    GBS is empty: it ends the epoch, and gpsd reports an epoch at the sentence that ended the previous ones.
    """
    moment = _moment(unix_s)
    if moment is None:
        return None
    time, date = moment
    return b"".join(
        (
            sentence(f"GNRMC,{time},V,,,,,,,{date},,,N"),
            sentence(f"GNGGA,{time},,,,,0,00,,,M,,M,,"),
            sentence(f"GNGBS,{time},,,,,,,"),
            sentence(f"GNGSA,A,1,{',' * (SLOT_COUNT - 1)},,,"),
        )
    )


def sentence(body: str) -> bytes:
    """A sentence with its checksum: the exclusive or of all bytes between ``$`` and ``*``."""
    data = body.encode("ascii")
    return b"$%b*%02X\r\n" % (data, reduce(xor, data, 0))


def _moment(unix_s: float) -> tuple[str, str] | None:
    """Time of day ``hhmmss.ss`` and date ``ddmmyy`` in UTC, rounded together: midnight changes both."""
    if not isfinite(unix_s) or not _CENTURY_S[0] <= unix_s < _CENTURY_S[1]:
        return None
    seconds, hundredths = divmod(round(unix_s * 100.0), 100)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%H%M%S}.{hundredths:02d}", f"{moment:%d%m%y}"


def _angle(angle_deg: float, hemispheres: str, digits: int) -> str:
    """``dddmm.mmmmmmm,H``. Rounded as an integer, because 59.99999999 minutes would otherwise be written as 60."""
    whole, rest = divmod(round(abs(angle_deg) * 60 * MINUTE_UNITS), 60 * MINUTE_UNITS)
    minutes, fraction = divmod(rest, MINUTE_UNITS)
    return f"{whole:0{digits}d}{minutes:02d}.{fraction:07d},{hemispheres[angle_deg < 0.0]}"


def over_ground(fix: FixMessage, heading_deg: float) -> tuple[float | None, float | None]:
    """Speed over ground in m/s, and the course in degrees (-180 to 180) of a moving tag, as far as they are known."""
    if fix.velocity_mps is None or fix.velocity_covariance is None:
        return None, None
    east, north, _ = east_north_up(fix.velocity_mps, heading_deg)
    speed_mps = hypot(east, north)
    variance = fix.velocity_covariance[0] + fix.velocity_covariance[4]
    moving = speed_mps > 0.0 and speed_mps**2 > COURSE_SIGMAS**2 * variance
    return speed_mps, degrees(atan2(east, north)) if moving else None


def _motion(fix: FixMessage, heading_deg: float) -> tuple[str, str]:
    """Speed over ground in knots, and the course if there is one; empty if the velocity is unknown."""
    speed_mps, course_deg = over_ground(fix, heading_deg)
    if speed_mps is None or not speed_mps < _FARTHEST_M:
        return "", ""
    course = "" if course_deg is None else f"{round(course_deg * 100.0) % 36_000 / 100.0:.2f}"
    return f"{speed_mps / KNOT_MPS:.3f}", course


def _dop(value: float | None) -> str:
    return "" if value is None or not value >= 0.0 else f"{min(value, _LARGEST_DOP):.2f}"
