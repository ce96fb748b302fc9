"""What is sent to a vehicle and when, without I/O: fixes, heartbeat, origin, answers to its questions for the time."""

import struct
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Final, cast

from skyless.bridges.mavlink._profiles import (
    MAVLINK_PROFILES,
    MAX_SATELLITES,
    Profile,
    global_origin,
    gps_input,
    no_gps_fix,
    odometry,
    vision_position_estimate,
)
from skyless.bridges.mavlink.messages import (
    ARMED,
    CRC_EXTRAS,
    FrameReader,
    GpsGlobalOrigin,
    Heartbeat,
    Message,
    SetGpsGlobalOrigin,
    Timesync,
    decoded,
    encoded,
)
from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, TargetUrl, require_georeference
from skyless.core.errors import SkylessError
from skyless.run.mqtt.messages import FixMessage

AUTOPILOT: Final = 1
"""Component of a vehicle's flight controller."""
VISUAL_POSITIONING: Final = 197
"""Ours, MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""

_GONE_S: Final = 3
"""A vehicle that was silent for this long, in seconds, may have been restarted, and has no origin then."""

_NEAR_1E7: Final = 10
"""Difference of a degree's 10⁷th parts by which an origin is still the same: 11 cm."""

_NEAR_MM: Final = 100


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
        """``system`` is the vehicle's, which is ours as well; ``text`` names the target in messages.

        ``satellites`` is what profile ``gps`` states instead of the number of anchors, and ``heading_deg`` the azimuth
        of the y axis of a site that does not know where it is on the Earth. ``log`` shows a line to a person.
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
        """What it has logged already."""
        self._silent_s = 0
        """Seconds since the vehicle's last message."""
        self._vehicle_origin: GpsGlobalOrigin | None = None
        """As the vehicle states it."""
        self.dropped = Counter()

    def on_site(self, site: BridgedSite) -> list[bytes]:
        """Raises SkylessError: profile ``gps`` needs a georeference, and a site that has one a heading of its own."""
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
        """One message, of the kind that the profile has."""
        if self._site is None:
            return []
        if self._last_serial is not None and fix.serial <= self._last_serial:
            self._reset_counter += 1  # the receiver has started again
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
            self.dropped["mavlink-value"] += 1  # finite, and still beyond what a field can hold
            return []

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:  # noqa: ARG002 - the vehicle has no use
        """A GPS receiver without a fix; the other profiles are silent, by which an autopilot notices it."""
        return self._frames([no_gps_fix(unix_s)]) if self._profile == "gps" else []

    def on_second(self, unix_s: float) -> list[bytes]:
        """The heartbeat; and the site's origin, until the vehicle has one or is armed."""
        self._silent_s += 1
        if self._silent_s >= _GONE_S:
            self._vehicle_origin = None
        messages: list[Message] = [Heartbeat()]
        origin = self._origin(unix_s)
        if origin is not None and self._vehicle_origin is None and not self._armed:
            messages.append(origin)
        return self._frames(messages)

    def on_bytes(self, data: bytes, unix_ns: int) -> list[bytes]:
        """What the vehicle has sent, received at ``unix_ns``: it may ask for the time."""
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
        """None where the site does not know it, or the vehicle finds it by GPS_INPUT."""
        if self._site is None or self._site.georeference is None or self._profile == "gps":
            return None
        return global_origin(self._site.georeference, self._system, unix_s)

    def _compare_origin(self, vehicle: GpsGlobalOrigin, unix_ns: int) -> None:
        """Log that the vehicle's origin is not the site's, if so."""
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
        """Log what a vehicle takes for known that is not."""
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
    """Whether positions are in another frame than before; a tag may only have learned of more anchors."""
    return before.georeference != after.georeference or any(
        after.anchors_m.get(anchor, position_m) != position_m for anchor, position_m in before.anchors_m.items()
    )


def _words(origin: GpsGlobalOrigin | SetGpsGlobalOrigin) -> str:
    return f"{origin.latitude_1e7 / 1e7:.7f}, {origin.longitude_1e7 / 1e7:.7f}, {origin.altitude_mm / 1e3:.2f} m"


def make_encoder(url: TargetUrl, context: BridgeContext) -> MavlinkEncoder:
    """Keys: ``profile``, which has no default; ``system`` and ``component``; ``satellites``; ``heading``.

    Raises:
        SkylessError: one of them is not right.
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
