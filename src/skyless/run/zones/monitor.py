"""When tags enter and leave zones.

No I/O; the time is passed in. Noise at an edge causes no series of events: a tag has crossed the edge when its fix
lies beyond it by the margin, or by half of the margin in every fix for a while. In between, it stays on its side.
"""

import math
from typing import Final

from skyless.core.ellipse import horizontal_ellipse
from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import FixMessage, Vector, Zone, ZoneEvent
from skyless.run.zones.floors import floor_at
from skyless.run.zones.zone_list import area_m2, depth_m, perimeter_m

MIN_MARGIN_M: Final = 0.05
_MARGIN_SIGMAS: Final = 3.0
"""The margin in standard deviations of the fix in its worst direction; it is at least ``MIN_MARGIN_M``."""

CROSSING_S: Final = 0.3
"""Fixes beyond the edge by half of the margin must last this long."""

TAG_TIMEOUT_S: Final = 3.0
"""A tag without a fix for this long has left."""


class _MonitoredZone:
    """A zone with figures that are computed once."""

    def __init__(self, zone: Zone) -> None:
        self.zone = zone
        xs, ys = zip(*zone.polygon_m, strict=True)
        self.box: tuple[float, float, float, float] = (min(xs), min(ys), max(xs), max(ys))
        # So that a zone smaller than the error can be entered; for a disc it is half of the radius.
        self.max_margin_m = area_m2(zone.polygon_m) / perimeter_m(zone.polygon_m)

    def may_hold(self, position_m: Vector) -> bool:
        """Whether a position lies in the box around the zone, a quick first test."""
        x1, y1, x2, y2 = self.box
        x, y, _ = position_m
        return x1 < x < x2 and y1 < y < y2


class _TagState:
    """The last fix of a tag and the zones that it is in."""

    def __init__(self) -> None:
        self.updated_s = 0.0
        self.position_m: Vector = (0.0, 0.0, 0.0)
        self.inside: set[str] = set()
        self.floor: int | None = None
        """The number of its floor; None where its height or the floors are not known."""
        self.beyond_since_s: dict[str, float] = {}
        """By zone: start of the time in which every fix was beyond its edge by half of the margin."""


class ZoneMonitor:
    """Detects from fixes when tags enter and leave zones."""

    def __init__(self) -> None:
        self.zones: tuple[Zone, ...] = ()
        self.floors: tuple[FloorSite, ...] = ()
        """The site's; a tag whose height is known is in zones of its floor only, and in those over all floors."""
        self._monitored: dict[str, _MonitoredZone] = {}
        self._tags: dict[str, _TagState] = {}

    def set_zones(self, zones: tuple[Zone, ...], unix_s: float) -> list[ZoneEvent]:
        """Monitor other zones; tags in a removed zone leave it."""
        old = self._monitored
        self.zones = zones
        self._monitored = {zone.id: _MonitoredZone(zone) for zone in zones}
        events = []
        for name, tag in self._tags.items():
            tag.beyond_since_s.clear()
            for zone_id in sorted(tag.inside - self._monitored.keys()):
                tag.inside.discard(zone_id)
                events.append(_event(old[zone_id].zone, name, tag, unix_s, entered=False))
        return events

    def update(self, fix: FixMessage, now_s: float) -> list[ZoneEvent]:
        """Process a fix; ``now_s`` is its time of arrival, by the clock of ``expire_tags``."""
        tag = self._tags.get(fix.tag) or self._tags.setdefault(fix.tag, _TagState())
        tag.updated_s, tag.position_m = now_s, fix.position_m
        std_z_m = math.sqrt(max(fix.covariance_m2[8], 0.0))
        tag.floor = None if fix.height_known else floor_at(self.floors, fix.position_m[2], std_z_m, tag.floor)
        events = []
        for zone_id, zone in self._monitored.items():
            if tag.floor is not None and zone.zone.floor not in (None, tag.floor):
                tag.beyond_since_s.pop(zone_id, None)
                if zone_id in tag.inside:
                    tag.inside.discard(zone_id)
                    events.append(_event(zone.zone, fix.tag, tag, fix.unix_s, entered=False))
            elif zone_id not in tag.inside and not zone.may_hold(fix.position_m):
                tag.beyond_since_s.pop(zone_id, None)
            elif _crossed(tag, zone, fix):
                events.append(_event(zone.zone, fix.tag, tag, fix.unix_s, entered=zone_id in tag.inside))
        return events

    def hear(self, name: str, now_s: float) -> None:
        """A tag has had a fix that is not given to ``update``."""
        if name in self._tags:
            self._tags[name].updated_s = now_s

    def expire_tags(self, now_s: float, unix_s: float) -> list[ZoneEvent]:
        """Remove tags that had no fix for ``TAG_TIMEOUT_S`` from their zones."""
        expired = [name for name, tag in self._tags.items() if now_s - tag.updated_s >= TAG_TIMEOUT_S]
        return [event for name in expired for event in self.remove_tag(name, unix_s)]

    def zones_with(self, name: str) -> list[Zone]:
        """The zones that a tag is in, the smallest first."""
        inside = self._tags[name].inside if name in self._tags else set()
        return sorted((self._monitored[zone].zone for zone in inside), key=lambda zone: area_m2(zone.polygon_m))

    def floor_of(self, name: str) -> int | None:
        """The number of the floor that a tag is on: by its height, or else by the smallest zone that lies on one."""
        if name in self._tags and self._tags[name].floor is not None:
            return self._tags[name].floor
        return next((zone.floor for zone in self.zones_with(name) if zone.floor is not None), None)

    def remove_tag(self, name: str, unix_s: float) -> list[ZoneEvent]:
        """Remove a tag from all zones."""
        tag = self._tags.pop(name, None)
        if tag is None:
            return []
        return [_event(self._monitored[z].zone, name, tag, unix_s, entered=False) for z in sorted(tag.inside)]


def _crossed(tag: _TagState, zone: _MonitoredZone, fix: FixMessage) -> bool:
    """Whether the tag has changed sides; if so, ``tag.inside`` is updated."""
    zone_id = zone.zone.id
    sigma_m = horizontal_ellipse(fix.covariance_m2)[0]
    margin_m = min(max(MIN_MARGIN_M, _MARGIN_SIGMAS * sigma_m), zone.max_margin_m)
    was_inside = zone_id in tag.inside
    depth = depth_m(fix.position_m[:2], zone.zone.polygon_m)
    beyond_m = -depth if was_inside else depth
    if beyond_m < 0.5 * margin_m:
        tag.beyond_since_s.pop(zone_id, None)
        return False
    since_s = tag.beyond_since_s.setdefault(zone_id, fix.unix_s)
    if fix.unix_s < since_s:  # the tag's host has set its clock back
        since_s = tag.beyond_since_s[zone_id] = fix.unix_s
    if beyond_m < margin_m and fix.unix_s - since_s < CROSSING_S:
        return False
    del tag.beyond_since_s[zone_id]
    (tag.inside.discard if was_inside else tag.inside.add)(zone_id)
    return True


def _event(zone: Zone, name: str, tag: _TagState, unix_s: float, *, entered: bool) -> ZoneEvent:
    return ZoneEvent(zone.id, zone.name, name, "enter" if entered else "leave", unix_s, tag.position_m)
