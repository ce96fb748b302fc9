"""Zones: which are valid, and who enters and leaves them. No I/O; the time is passed in.

Noise at an edge makes no flutter: a tag has crossed it when its fix lies beyond it by the margin, or by half of the
margin in every fix for a while. Between, it stays where it was.
"""

import math
import re
from typing import Final

import msgspec

from skyless.dashboard.polygon import Polygon, area_m2, depth_m, is_simple, perimeter_m
from skyless.mqtt.messages import FixMessage, Vector, Zone, ZoneEvent, ZonesMessage

LEAST_MARGIN_M: Final = 0.05
SIGMAS: Final = 3.0
"""The margin is so many standard deviations of the fix in its worst direction, but at least ``LEAST_MARGIN_M``."""

STAY_S: Final = 0.3
SILENCE_S: Final = 3.0
"""A tag that gives no fix for so long has left."""

MOST_ZONES: Final = 100
MOST_CORNERS: Final = 100
FARTHEST_M: Final = 1e5

_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_COLOUR = re.compile(r"#[0-9A-Fa-f]{3,8}|[A-Za-z]{1,32}")


class BadZonesError(ValueError):
    """What is wrong with a list of zones, for the person who drew them."""


def read_zones(payload: bytes) -> tuple[Zone, ...]:
    """Zones of a ``ZonesMessage`` in JSON. Raises BadZonesError."""
    try:
        zones = msgspec.json.decode(payload, type=ZonesMessage).zones
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadZonesError(f"this is no list of zones: {error}") from None
    check_zones(zones)
    return zones


def check_zones(zones: tuple[Zone, ...]) -> None:
    """See that zones can be watched and named in topics. Raises BadZonesError."""
    if len(zones) > MOST_ZONES:
        raise BadZonesError(f"there are {len(zones)} zones; {MOST_ZONES} are the most")
    known: set[str] = set()
    for zone in zones:
        fault = _fault_in_words(zone) or _fault_in_shape(zone.polygon_m)
        if fault:
            raise BadZonesError(f"zone {(zone.name or zone.id)[:40]!r} {fault}")
        if zone.id in known:
            raise BadZonesError(f"two zones have the id {zone.id!r}")
        known.add(zone.id)


def _fault_in_words(zone: Zone) -> str | None:
    if not _ID.fullmatch(zone.id):
        return "has an id that is not 1 to 64 letters, digits, dots, dashes and underscores"
    if len(zone.name) > 100:
        return "has a name of more than 100 characters"
    if zone.colour is not None and not _COLOUR.fullmatch(zone.colour):
        return "has a colour that is neither #rrggbb nor a name"
    return None


def _fault_in_shape(corners: Polygon) -> str | None:
    if not 3 <= len(corners) <= MOST_CORNERS:
        return f"has {len(corners)} corners; it should have 3 to {MOST_CORNERS}"
    if not all(math.isfinite(value) and abs(value) <= FARTHEST_M for corner in corners for value in corner):
        return f"has a corner that is not finite or farther than {FARTHEST_M:g} m"
    if not is_simple(corners):
        return "crosses or touches itself"
    return None


class _Watched:
    """A zone with what is computed from it once."""

    def __init__(self, zone: Zone) -> None:
        self.zone = zone
        self.polygon: Polygon = zone.polygon_m
        xs, ys = zip(*zone.polygon_m, strict=True)
        self.box: tuple[float, float, float, float] = (min(xs), min(ys), max(xs), max(ys))
        # A zone smaller than the error could never be entered by three sigma; half of a disc's radius always can.
        self.most_margin_m = area_m2(self.polygon) / perimeter_m(self.polygon)

    def may_hold(self, position_m: Vector) -> bool:
        """Whether a position lies in the box around the zone; quick, as most do not."""
        x1, y1, x2, y2 = self.box
        x, y, _ = position_m
        return x1 < x < x2 and y1 < y < y2


class _Seen:
    """What is known of a tag."""

    def __init__(self) -> None:
        self.heard_s = 0.0
        self.position_m: Vector = (0.0, 0.0, 0.0)
        self.inside: set[str] = set()
        self.beyond_since_s: dict[str, float] = {}
        """By zone: since when every fix has been beyond its edge by half of the margin."""


class ZoneWatch:
    """Turns fixes into events."""

    def __init__(self) -> None:
        self.zones: tuple[Zone, ...] = ()
        self._watched: dict[str, _Watched] = {}
        self._tags: dict[str, _Seen] = {}

    def set_zones(self, zones: tuple[Zone, ...], unix_s: float) -> list[ZoneEvent]:
        """Watch other zones; whoever is in one that is gone leaves it."""
        old = self._watched
        self.zones = zones
        self._watched = {zone.id: _Watched(zone) for zone in zones}
        events = []
        for tag, seen in self._tags.items():
            seen.beyond_since_s.clear()
            for zone_id in sorted(seen.inside - self._watched.keys()):
                seen.inside.discard(zone_id)
                events.append(_event(old[zone_id].zone, tag, seen, unix_s, entered=False))
        return events

    def observe(self, fix: FixMessage, now_s: float) -> list[ZoneEvent]:
        """Take a fix; ``now_s`` is when it came, by any clock that ``silent`` shares."""
        seen = self._tags.setdefault(fix.tag, _Seen())
        seen.heard_s, seen.position_m = now_s, fix.position_m
        margin_m = max(LEAST_MARGIN_M, SIGMAS * _worst_std_m(fix))
        events = []
        for zone_id, watched in self._watched.items():
            if zone_id not in seen.inside and not watched.may_hold(fix.position_m):
                seen.beyond_since_s.pop(zone_id, None)
            elif _crossed(seen, zone_id, watched, fix, margin_m):
                events.append(_event(watched.zone, fix.tag, seen, fix.unix_s, entered=zone_id in seen.inside))
        return events

    def silent(self, now_s: float, unix_s: float) -> list[ZoneEvent]:
        """Let tags leave that have given no fix for ``SILENCE_S``."""
        gone = [tag for tag, seen in self._tags.items() if now_s - seen.heard_s >= SILENCE_S]
        return [event for tag in gone for event in self.gone(tag, unix_s)]

    def gone(self, tag: str, unix_s: float) -> list[ZoneEvent]:
        """Let a tag leave all zones."""
        seen = self._tags.pop(tag, None)
        if seen is None:
            return []
        return [_event(self._watched[z].zone, tag, seen, unix_s, entered=False) for z in sorted(seen.inside)]

    def inside(self, tag: str) -> frozenset[str]:
        """Ids of the zones that a tag is in."""
        seen = self._tags.get(tag)
        return frozenset(seen.inside) if seen else frozenset()


def _crossed(seen: _Seen, zone_id: str, watched: _Watched, fix: FixMessage, margin_m: float) -> bool:
    """Whether the tag has changed sides; if so, ``seen.inside`` says the new one."""
    margin_m = min(margin_m, watched.most_margin_m)
    was_inside = zone_id in seen.inside
    depth = depth_m(fix.position_m[:2], watched.polygon)
    beyond_m = -depth if was_inside else depth
    if beyond_m < 0.5 * margin_m:
        seen.beyond_since_s.pop(zone_id, None)
        return False
    since_s = seen.beyond_since_s.setdefault(zone_id, fix.unix_s)
    if fix.unix_s < since_s:  # the tag's host has set its clock back
        since_s = seen.beyond_since_s[zone_id] = fix.unix_s
    if beyond_m < margin_m and fix.unix_s - since_s < STAY_S:
        return False
    del seen.beyond_since_s[zone_id]
    (seen.inside.discard if was_inside else seen.inside.add)(zone_id)
    return True


def _worst_std_m(fix: FixMessage) -> float:
    """Standard deviation along the longer axis of the horizontal error ellipse."""
    xx, xy, _, _, yy = fix.covariance_m2[:5]
    return math.sqrt(max(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy), 0.0))


def _event(zone: Zone, tag: str, seen: _Seen, unix_s: float, *, entered: bool) -> ZoneEvent:
    return ZoneEvent(zone.id, zone.name, tag, "enter" if entered else "leave", unix_s, seen.position_m)
