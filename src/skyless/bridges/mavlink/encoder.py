"""What is sent to a vehicle and when, without I/O: fixes, heartbeat, origin, answers to its questions for the time."""

import struct
from collections import Counter
from collections.abc import Iterable
from typing import Final, cast

from skyless.bridges.feed import BridgedSite, require_georeference
from skyless.bridges.mavlink.frames import FrameReader
from skyless.bridges.mavlink.messages import (
    ARMED,
    CRC_EXTRAS,
    GpsGlobalOrigin,
    Heartbeat,
    Message,
    SetGpsGlobalOrigin,
    Timesync,
    decoded,
    encoded,
)
from skyless.bridges.mavlink.profiles import (
    MAVLINK_PROFILES,
    MOST_SATELLITES,
    Profile,
    global_origin,
    gps_input,
    no_gps_fix,
    odometry,
    vision_position_estimate,
)
from skyless.bridges.target import Encoder
from skyless.bridges.target_url import TargetUrl
from skyless.errors import SkylessError
from skyless.mqtt.messages import FixMessage

AUTOPILOT: Final = 1
"""Component of a vehicle's flight controller."""
VISUAL_POSITIONING: Final = 197
"""Ours, MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""


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
    ) -> None:
        """``system`` is the vehicle's, which is ours as well; ``text`` names the target in messages.

        ``satellites`` is what profile ``gps`` states instead of the number of anchors, and ``heading_deg`` the azimuth
        of the y axis of a site that does not know where it is on the Earth.
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
        self.vehicle_origin: GpsGlobalOrigin | None = None
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
            self.vehicle_origin = None
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
        messages: list[Message] = [Heartbeat()]
        origin = self._origin(unix_s)
        if origin is not None and self.vehicle_origin is None and not self._armed:
            messages.append(origin)
        return self._frames(messages)

    def on_bytes(self, data: bytes, unix_ns: int) -> list[bytes]:
        """What the vehicle has sent, received at ``unix_ns``: it may ask for the time."""
        answers: list[Message] = []
        damaged = self._reader.damaged
        for frame in self._reader.frames(data):
            if (frame.system, frame.component) != (self._system, AUTOPILOT):
                continue
            message = decoded(frame)
            if isinstance(message, Heartbeat):
                self._armed = bool(message.base_mode & ARMED)
            elif isinstance(message, GpsGlobalOrigin):
                self.vehicle_origin = message
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


def make_encoder(url: TargetUrl) -> MavlinkEncoder:
    """Keys: ``profile``, which has no default; ``system`` and ``component``; ``satellites``; ``heading``.

    Raises:
        SkylessError: one of them is not right.
    """
    return MavlinkEncoder(
        cast(Profile, url.choice("profile", MAVLINK_PROFILES, "")),
        text=url.text,
        system=int(url.number("system", 1, 1, 255)),
        component=int(url.number("component", VISUAL_POSITIONING, 1, 255)),
        satellites=int(url.number("satellites", 0, 0, MOST_SATELLITES)) if url.text_option("satellites") else None,
        heading_deg=url.number("heading", 0.0, -360.0, 360.0) if url.text_option("heading") else None,
    )
