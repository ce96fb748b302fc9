"""Zones: validation of their list, and detection of tags that enter and leave them.

No I/O. When a silent tag has gone is decided by the ``SiteTable``. Noise at an edge must not cause a series of events:
a tag has crossed the edge when its fix is beyond it by the margin, or by half of the margin in every fix for a while.
Otherwise it stays on its side.
"""

import math
import re
from collections.abc import Iterator
from itertools import combinations, pairwise
from typing import Final

from msgspec import Struct

from skyless.core.earth import horizontal_ellipse
from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import (
    FixMessage,
    SiteZones,
    Vector,
    WrongMessageError,
    Zone,
    ZoneEvent,
    ZonesMessage,
    read_message,
)

# Zones as polygons (corners in order, metres): validation, and which of them belong to a site. Plain arithmetic, as
# bridges and the page's server start without NumPy.

Point = tuple[float, float]
Polygon = tuple[Point, ...]

_MAX_ZONES: Final = 100
_MAX_CORNERS: Final = 100
_MAX_CORNER_M: Final = 1e5

MAX_OTHER_SITES: Final = 20
"""Other sites with the same number whose zones are kept; beyond this the ones not seen for longest are dropped."""

_ID: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_COLOUR: Final = re.compile(r"#[0-9A-Fa-f]{3,8}|[A-Za-z]{1,32}")


def area_m2(polygon: Polygon) -> float:
    """Area, never negative; the polygon must not cross itself."""
    return abs(signed_area_m2(polygon))


def signed_area_m2(polygon: Polygon) -> float:
    """Area, negative if the corners go clockwise."""
    return 0.5 * sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in sides(polygon))


def perimeter_m(polygon: Polygon) -> float:
    """Total length of the sides."""
    return sum(math.dist(a, b) for a, b in sides(polygon))


def sides(polygon: Polygon) -> list[tuple[Point, Point]]:
    """Sides in order, the last one back to the first corner."""
    return [*pairwise(polygon), (polygon[-1], polygon[0])]


def depth_m(point: Point, polygon: Polygon) -> float:
    """Distance to the nearest side, positive inside and negative outside (even-odd rule)."""
    x, y = point
    inside, least = False, math.inf
    for (x1, y1), (x2, y2) in sides(polygon):
        if (y1 > y) != (y2 > y) and x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
            inside = not inside
        along_x, along_y = x2 - x1, y2 - y1
        length2 = along_x * along_x + along_y * along_y
        share = ((x - x1) * along_x + (y - y1) * along_y) / (length2 or math.inf)  # the square of 1e-200 m is 0
        share = min(max(share, 0.0), 1.0)
        away_x, away_y = x1 + share * along_x - x, y1 + share * along_y - y
        least = min(least, away_x * away_x + away_y * away_y)
    return math.sqrt(least) if inside else -math.sqrt(least)


def is_simple(polygon: Polygon) -> bool:
    """Whether no two sides touch or cross, except neighbours in their common corner."""
    segments = list(enumerate(sides(polygon)))
    pairs = ((one, other) for (i, one), (j, other) in combinations(segments, 2) if 1 < j - i < len(segments) - 1)
    return area_m2(polygon) > 0.0 and not any(_touch(*one, *other) for one, other in pairs)


def _touch(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the segments a–b and c–d have a point in common."""
    return (
        max(a[0], b[0]) >= min(c[0], d[0])
        and max(c[0], d[0]) >= min(a[0], b[0])
        and max(a[1], b[1]) >= min(c[1], d[1])
        and max(c[1], d[1]) >= min(a[1], b[1])
        and _turn(a, b, c) * _turn(a, b, d) <= 0.0
        and _turn(c, d, a) * _turn(c, d, b) <= 0.0
    )


def _turn(a: Point, b: Point, c: Point) -> float:
    """Positive if a–b–c turns left, 0 if the three are in one line."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def read_zones(payload: bytes) -> ZonesMessage:
    """Read a ``ZonesMessage`` in JSON and check its zones. Raises WrongMessageError."""
    message = read_message(payload, ZonesMessage)
    for zones in (message.zones, *(other.zones for other in message.others)):
        check_zones(zones)
    return message


def zones_of(message: ZonesMessage, site: str) -> ZonesMessage:
    """Select the zones of the site with this name, and keep those of other sites in ``others``.

    Zones without a site's name become this site's. An empty ``site`` is not known yet and changes nothing.
    """
    if message.site in ("", site) or not site:
        return ZonesMessage(message.zones, message.site or site, message.others)
    mine = next((other.zones for other in message.others if other.site == site), ())
    others = tuple(other for other in message.others if other.site != site)
    if message.zones:
        others = (SiteZones(message.site, message.zones), *others)
    return ZonesMessage(mine, site, others[:MAX_OTHER_SITES])


def check_zones(zones: tuple[Zone, ...]) -> None:
    """Check that zones can be monitored and named in topics. Raises WrongMessageError."""
    if len(zones) > _MAX_ZONES:
        raise WrongMessageError(f"there are {len(zones)} zones; at most {_MAX_ZONES} are allowed")
    known: set[str] = set()
    for zone in zones:
        for fault in _faults(zone):
            raise WrongMessageError(f"zone {(zone.name or zone.id)[:40]!r} {fault}")
        if zone.id in known:
            raise WrongMessageError(f"two zones have the id {zone.id!r}")
        known.add(zone.id)


def _faults(zone: Zone) -> Iterator[str]:
    corners = zone.polygon_m
    if not _ID.fullmatch(zone.id):
        yield "has an id that is not 1 to 64 letters, digits, dots, dashes and underscores"
    if len(zone.name) > 100:
        yield "has a name of more than 100 characters"
    if zone.colour is not None and not _COLOUR.fullmatch(zone.colour):
        yield "has a colour that is neither #rrggbb nor a name"
    if not 3 <= len(corners) <= _MAX_CORNERS:
        yield f"has {len(corners)} corners; it should have 3 to {_MAX_CORNERS}"
    if not all(abs(value) <= _MAX_CORNER_M for corner in corners for value in corner):
        yield f"has a corner that is not finite or farther than {_MAX_CORNER_M:g} m"
    if not is_simple(corners):
        yield "crosses or touches itself"


MIN_MARGIN_M: Final = 0.05
_MIN_FLOOR_MARGIN_M: Final = 0.1
_MARGIN_SIGMAS: Final = 3.0
"""Margins in standard deviations of the fix in a zone's worst direction, at least those above."""

CROSSING_S: Final = 0.3
"""Fixes beyond the edge by half of the margin must last this long."""


class _MonitoredZone:
    """A zone with precomputed values."""

    def __init__(self, zone: Zone) -> None:
        self.zone = zone
        xs, ys = zip(*zone.polygon_m, strict=True)
        self.box: tuple[float, float, float, float] = (min(xs), min(ys), max(xs), max(ys))
        # Lets a zone smaller than the error be entered; for a disc it is half of the radius.
        self.max_margin_m = area_m2(zone.polygon_m) / perimeter_m(zone.polygon_m)

    def beyond_m(self, tag: "_TagState") -> float:
        """Distance in m by which a tag is beyond the edge, seen from the side where it was; else negative."""
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
    """The last fix of a tag, and its zones."""

    position_m: Vector = (0.0, 0.0, 0.0)
    inside: set[str] = set()
    floor: int | None = None
    """Number of the tag's floor; None if its height or the floors are unknown."""
    beyond_since_s: dict[str, float] = {}
    """Since when every fix was beyond the edge by half of the margin, by zone."""


class ZoneMonitor:
    """Detects from fixes when tags enter and leave zones."""

    def __init__(self) -> None:
        self.zones: tuple[Zone, ...] = ()
        self.floors: tuple[FloorSite, ...] = ()
        """The site's floors. A tag of known height can only be in zones of its floor, or of all floors."""
        self._monitored: dict[str, _MonitoredZone] = {}
        self._tags: dict[str, _TagState] = {}

    def set_zones(self, zones: tuple[Zone, ...], unix_s: float) -> list[ZoneEvent]:
        """Replace the monitored zones; tags in a removed zone leave it."""
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

    def update(self, fix: FixMessage) -> list[ZoneEvent]:
        """Process a fix."""
        tag = self._tags.get(fix.tag) or self._tags.setdefault(fix.tag, _TagState())
        tag.position_m = fix.position_m
        std_z_m = math.sqrt(max(fix.covariance_m2[8], 0.0))
        tag.floor = None if fix.height_known else floor_at(self.floors, fix.position_m[2], std_z_m, tag.floor)
        margin_m = max(MIN_MARGIN_M, _MARGIN_SIGMAS * horizontal_ellipse(fix.covariance_m2)[0])
        return [
            _event(zone.zone, fix.tag, tag, fix.unix_s, entered=zone.zone.id in tag.inside)
            for zone in self._monitored.values()
            if _crossed(tag, zone, fix, margin_m)
        ]

    def zones_with(self, name: str) -> list[Zone]:
        """The zones that a tag is in, smallest first."""
        inside = self._tags[name].inside if name in self._tags else set()
        return sorted((self._monitored[zone].zone for zone in inside), key=lambda zone: area_m2(zone.polygon_m))

    def remove_tag(self, name: str, unix_s: float) -> list[ZoneEvent]:
        """Remove a tag that has gone from all zones."""
        tag = self._tags.pop(name, None)
        if tag is None:
            return []
        return [_event(self._monitored[z].zone, name, tag, unix_s, entered=False) for z in sorted(tag.inside)]


def floor_at(floors: tuple[FloorSite, ...], z_m: float, std_m: float, before: int | None) -> int | None:
    """Number of the floor at a height with a standard deviation; None at a site without floors.

    A tag stays on its previous floor until it is beyond the boundary by the margin, so that noise on a ladder or a
    stair changes nothing. The margin is at most a third of the height between two floors.
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


def _crossed(tag: _TagState, zone: _MonitoredZone, fix: FixMessage, margin_m: float) -> bool:
    """Whether the tag has changed sides; if so, ``tag.inside`` is updated."""
    zone_id, unix_s, beyond_m = zone.zone.id, fix.unix_s, zone.beyond_m(tag)
    margin_m = min(margin_m, zone.max_margin_m)
    if beyond_m < 0.5 * margin_m:
        tag.beyond_since_s.pop(zone_id, None)
        return False
    since_s = min(tag.beyond_since_s.get(zone_id, unix_s), unix_s)  # the host's clock may be set back
    tag.beyond_since_s[zone_id] = since_s
    if beyond_m < margin_m and unix_s - since_s < CROSSING_S:
        return False
    del tag.beyond_since_s[zone_id]
    tag.inside ^= {zone_id}
    return True


def _event(zone: Zone, name: str, tag: _TagState, unix_s: float, *, entered: bool) -> ZoneEvent:
    return ZoneEvent(zone.id, zone.name, name, "enter" if entered else "leave", unix_s, tag.position_m)
