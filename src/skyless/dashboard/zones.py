"""Zones: which are valid, when tags enter and leave them, and which dashboard publishes these events.

No I/O; the time is passed in. Noise at an edge causes no series of events: a tag has crossed the edge when its fix
lies beyond it by the margin, or by half of the margin in every fix for a while. In between, it stays on its side.
"""

import math
import re
from collections import deque
from typing import Final

import msgspec

from skyless.dashboard.polygon import Polygon, area_m2, depth_m, is_simple, perimeter_m
from skyless.mqtt.messages import FixMessage, SiteZones, StatusMessage, Vector, Zone, ZoneEvent, ZonesMessage

MIN_MARGIN_M: Final = 0.05
_MARGIN_SIGMAS: Final = 3.0
"""The margin in standard deviations of the fix in its worst direction; it is at least ``MIN_MARGIN_M``."""

CROSSING_S: Final = 0.3
"""Fixes beyond the edge by half of the margin must last this long."""

TAG_TIMEOUT_S: Final = 3.0
"""A tag without a fix for this long has left."""

_MAX_ZONES: Final = 100
_MAX_CORNERS: Final = 100
_MAX_CORNER_M: Final = 1e5

MAX_OTHER_SITES: Final = 20
"""Sites of one number whose zones are kept besides the present one's; those not seen for longest are dropped."""

MAX_EVENTS: Final = 50
"""Events that are kept for pages."""

TAKEOVER_S: Final = 1.0
"""A dashboard waits this long for each one of a lower rank to publish an event that both have detected."""

_SAME_EVENT_S: Final = 2.0

_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_COLOUR = re.compile(r"#[0-9A-Fa-f]{3,8}|[A-Za-z]{1,32}")


class BadZonesError(ValueError):
    """What is wrong with a list of zones."""


def read_zones(payload: bytes) -> ZonesMessage:
    """A ``ZonesMessage`` in JSON, all its zones checked. Raises BadZonesError."""
    try:
        message = msgspec.json.decode(payload, type=ZonesMessage)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadZonesError(f"this is no list of zones: {error}") from None
    check_zones(message.zones)
    for other in message.others:
        check_zones(other.zones)
    return message


def zones_of(message: ZonesMessage, site: str) -> ZonesMessage:
    """The same for the site of this name: its zones first, those of others kept.

    Zones of which no site is known become this one's; an empty name is a site that is not known yet.
    """
    if message.site in ("", site) or not site:
        return ZonesMessage(message.zones, message.site or site, message.others)
    mine = next((other.zones for other in message.others if other.site == site), ())
    others = tuple(other for other in message.others if other.site != site)
    if message.zones:
        others = (SiteZones(message.site, message.zones), *others)
    return ZonesMessage(mine, site, others[:MAX_OTHER_SITES])


def check_zones(zones: tuple[Zone, ...]) -> None:
    """Check that zones can be monitored and named in topics. Raises BadZonesError."""
    if len(zones) > _MAX_ZONES:
        raise BadZonesError(f"there are {len(zones)} zones; at most {_MAX_ZONES} are allowed")
    known: set[str] = set()
    for zone in zones:
        fault = _text_fault(zone) or _shape_fault(zone.polygon_m)
        if fault:
            raise BadZonesError(f"zone {(zone.name or zone.id)[:40]!r} {fault}")
        if zone.id in known:
            raise BadZonesError(f"two zones have the id {zone.id!r}")
        known.add(zone.id)


def _text_fault(zone: Zone) -> str | None:
    if not _ID.fullmatch(zone.id):
        return "has an id that is not 1 to 64 letters, digits, dots, dashes and underscores"
    if len(zone.name) > 100:
        return "has a name of more than 100 characters"
    if zone.colour is not None and not _COLOUR.fullmatch(zone.colour):
        return "has a colour that is neither #rrggbb nor a name"
    return None


def _shape_fault(corners: Polygon) -> str | None:
    if not 3 <= len(corners) <= _MAX_CORNERS:
        return f"has {len(corners)} corners; it should have 3 to {_MAX_CORNERS}"
    if not all(math.isfinite(value) and abs(value) <= _MAX_CORNER_M for corner in corners for value in corner):
        return f"has a corner that is not finite or farther than {_MAX_CORNER_M:g} m"
    if not is_simple(corners):
        return "crosses or touches itself"
    return None


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
        self.beyond_since_s: dict[str, float] = {}
        """By zone: start of the time in which every fix was beyond its edge by half of the margin."""


class ZoneMonitor:
    """Detects from fixes when tags enter and leave zones."""

    def __init__(self) -> None:
        self.zones: tuple[Zone, ...] = ()
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
        tag = self._tags.setdefault(fix.tag, _TagState())
        tag.updated_s, tag.position_m = now_s, fix.position_m
        margin_m = max(MIN_MARGIN_M, _MARGIN_SIGMAS * _worst_std_m(fix))
        events = []
        for zone_id, zone in self._monitored.items():
            if zone_id not in tag.inside and not zone.may_hold(fix.position_m):
                tag.beyond_since_s.pop(zone_id, None)
            elif _crossed(tag, zone, fix, margin_m):
                events.append(_event(zone.zone, fix.tag, tag, fix.unix_s, entered=zone_id in tag.inside))
        return events

    def expire_tags(self, now_s: float, unix_s: float) -> list[ZoneEvent]:
        """Remove tags that had no fix for ``TAG_TIMEOUT_S`` from their zones."""
        expired = [name for name, tag in self._tags.items() if now_s - tag.updated_s >= TAG_TIMEOUT_S]
        return [event for name in expired for event in self.remove_tag(name, unix_s)]

    def remove_tag(self, name: str, unix_s: float) -> list[ZoneEvent]:
        """Remove a tag from all zones."""
        tag = self._tags.pop(name, None)
        if tag is None:
            return []
        return [_event(self._monitored[z].zone, name, tag, unix_s, entered=False) for z in sorted(tag.inside)]


def _crossed(tag: _TagState, zone: _MonitoredZone, fix: FixMessage, margin_m: float) -> bool:
    """Whether the tag has changed sides; if so, ``tag.inside`` is updated."""
    zone_id = zone.zone.id
    margin_m = min(margin_m, zone.max_margin_m)
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


def _worst_std_m(fix: FixMessage) -> float:
    """Standard deviation along the longer axis of the horizontal error ellipse."""
    xx, xy, _, _, yy = fix.covariance_m2[:5]
    return math.sqrt(max(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy), 0.0))


def _event(zone: Zone, name: str, tag: _TagState, unix_s: float, *, entered: bool) -> ZoneEvent:
    return ZoneEvent(zone.id, zone.name, name, "enter" if entered else "leave", unix_s, tag.position_m)


def publisher_rank(name: str, dashboards: list[StatusMessage]) -> int:
    """How many of the dashboards that are online came online before this one; the first publishes the events."""
    online = sorted((status.unix_s, status.name) for status in dashboards if status.online)
    names = [other for _, other in online]
    return names.index(name) if name in names else 0


class EventQueue:
    """Events that wait to be published, and the last that were."""

    def __init__(self) -> None:
        self.recent: deque[ZoneEvent] = deque(maxlen=MAX_EVENTS)
        self._waiting: list[tuple[float, ZoneEvent]] = []

    def schedule(self, events: list[ZoneEvent], rank: int, now_s: float) -> None:
        """Add events detected here, by a dashboard with this rank."""
        self._waiting += [(now_s + rank * TAKEOVER_S, event) for event in events]

    def pop_due(self, now_s: float) -> list[ZoneEvent]:
        """Events that no other dashboard has published in time; they count as published."""
        due = [event for at_s, event in self._waiting if at_s <= now_s]
        if due:
            self._waiting = [(at_s, event) for at_s, event in self._waiting if at_s > now_s]
            self.recent.extend(due)
        return due

    def add_published(self, event: ZoneEvent) -> bool:
        """Add an event from MQTT; whether it is new, neither an own one nor a repetition."""
        if event in self.recent:
            return False
        for index, (_, waiting) in enumerate(self._waiting):
            if _same(event, waiting):
                del self._waiting[index]
                break
        self.recent.append(event)
        return True


def _same(a: ZoneEvent, b: ZoneEvent) -> bool:
    return (a.zone, a.tag, a.kind) == (b.zone, b.tag, b.kind) and abs(a.unix_s - b.unix_s) < _SAME_EVENT_S
