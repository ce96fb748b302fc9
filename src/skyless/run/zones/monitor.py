"""When tags enter and leave zones.

No I/O; the time is passed in. Noise at an edge causes no series of events: a tag has crossed the edge when its fix
lies beyond it by the margin, or by half of the margin in every fix for a while. In between, it stays on its side.
"""

import math
from typing import Final

from msgspec import Struct

from skyless.core.ellipse import horizontal_ellipse
from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import FixMessage, Vector, Zone, ZoneEvent
from skyless.run.zones.zone_list import area_m2, depth_m, perimeter_m

MIN_MARGIN_M: Final = 0.05
_MIN_FLOOR_MARGIN_M: Final = 0.1
_MARGIN_SIGMAS: Final = 3.0
"""Margins in standard deviations of the fix, for a zone in its worst direction; they are at least those above."""

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

    def beyond_m(self, tag: "_TagState") -> float:
        """How far a tag has crossed the edge, from the side where it was; negative where it has not."""
        x1, y1, x2, y2 = self.box
        x, y, _ = tag.position_m
        was_inside = self.zone.id in tag.inside
        if tag.floor is not None and self.zone.floor not in (None, tag.floor):
            depth = -math.inf
        elif was_inside or (x1 < x < x2 and y1 < y < y2):
            depth = depth_m((x, y), self.zone.polygon_m)
        else:
            return -math.inf  # a quick first test
        return -depth if was_inside else depth


class _TagState(Struct):
    """The last fix of a tag and the zones that it is in."""

    updated_s: float = 0.0
    position_m: Vector = (0.0, 0.0, 0.0)
    inside: set[str] = set()
    floor: int | None = None
    """The number of its floor; None where its height or the floors are not known."""
    beyond_since_s: dict[str, float] = {}
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
        return [
            _event(zone.zone, fix.tag, tag, fix.unix_s, entered=zone.zone.id in tag.inside)
            for zone in self._monitored.values()
            if _crossed(tag, zone, fix)
        ]

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

    def remove_tag(self, name: str, unix_s: float) -> list[ZoneEvent]:
        """Remove a tag from all zones."""
        tag = self._tags.pop(name, None)
        if tag is None:
            return []
        return [_event(self._monitored[z].zone, name, tag, unix_s, entered=False) for z in sorted(tag.inside)]


def floor_at(floors: tuple[FloorSite, ...], z_m: float, std_m: float, before: int | None) -> int | None:
    """The number of the floor at a height, whose standard deviation is given; None at a site without floors.

    A tag stays on the floor where it was before until it is beyond the boundary by the margin, so that noise on a
    ladder or a stair changes nothing. The margin is at most a third of the height between two floors.
    """
    if not floors:
        return None
    row = max((index for index, floor in enumerate(floors) if floor.low_m <= z_m), default=0)
    rows = {floor.number: index for index, floor in enumerate(floors)}
    if before not in rows or abs(row - rows[before]) != 1:
        return floors[row].number
    low, high = sorted((row, rows[before]))
    boundary_m = floors[high].low_m
    margin_m = min(max(_MIN_FLOOR_MARGIN_M, _MARGIN_SIGMAS * std_m), (boundary_m - floors[low].low_m) / 3.0)
    return before if abs(z_m - boundary_m) < margin_m else floors[row].number


def _crossed(tag: _TagState, zone: _MonitoredZone, fix: FixMessage) -> bool:
    """Whether the tag has changed sides; if so, ``tag.inside`` is updated."""
    zone_id, unix_s, beyond_m = zone.zone.id, fix.unix_s, zone.beyond_m(tag)
    if beyond_m <= 0.0:
        tag.beyond_since_s.pop(zone_id, None)
        return False
    margin_m = max(MIN_MARGIN_M, _MARGIN_SIGMAS * horizontal_ellipse(fix.covariance_m2)[0])
    margin_m = min(margin_m, zone.max_margin_m)
    if beyond_m < 0.5 * margin_m:
        tag.beyond_since_s.pop(zone_id, None)
        return False
    since_s = min(tag.beyond_since_s.get(zone_id, unix_s), unix_s)  # its host may set its clock back
    tag.beyond_since_s[zone_id] = since_s
    if beyond_m < margin_m and unix_s - since_s < CROSSING_S:
        return False
    del tag.beyond_since_s[zone_id]
    tag.inside ^= {zone_id}
    return True


def _event(zone: Zone, name: str, tag: _TagState, unix_s: float, *, entered: bool) -> ZoneEvent:
    return ZoneEvent(zone.id, zone.name, name, "enter" if entered else "leave", unix_s, tag.position_m)
