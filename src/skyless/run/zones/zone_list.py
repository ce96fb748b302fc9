"""Zones as polygons (corners in order, metres), and lists of them: which are valid, and which belong to a site.

Plain arithmetic: bridges and the page's server start without NumPy.
"""

import math
import re
from collections.abc import Iterator
from itertools import combinations, pairwise
from typing import Final

from skyless.run.mqtt.messages import SiteZones, WrongMessageError, Zone, ZonesMessage, read_message

Point = tuple[float, float]
Polygon = tuple[Point, ...]

_MAX_ZONES: Final = 100
_MAX_CORNERS: Final = 100
_MAX_CORNER_M: Final = 1e5

MAX_OTHER_SITES: Final = 20
"""Other sites of one number whose zones are kept; the ones not seen for longest are dropped."""

_ID: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_COLOUR: Final = re.compile(r"#[0-9A-Fa-f]{3,8}|[A-Za-z]{1,32}")


def area_m2(polygon: Polygon) -> float:
    """Area, never negative; the polygon must not cross itself."""
    return abs(signed_area_m2(polygon))


def signed_area_m2(polygon: Polygon) -> float:
    """The same, negative where the corners go clockwise."""
    return 0.5 * sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in sides(polygon))


def perimeter_m(polygon: Polygon) -> float:
    """Length of all sides."""
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
        share = ((x - x1) * along_x + (y - y1) * along_y) / length2 if length2 > 0.0 else 0.0
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
    if max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0]):
        return False
    if max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1]):
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0


def _turn(a: Point, b: Point, c: Point) -> float:
    """Positive where a–b–c turns left, 0 where the three are in one line."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def read_zones(payload: bytes) -> ZonesMessage:
    """A ``ZonesMessage`` in JSON, all its zones checked. Raises WrongMessageError."""
    message = read_message(payload, ZonesMessage)
    for zones in (message.zones, *(other.zones for other in message.others)):
        check_zones(zones)
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
    if not all(math.isfinite(value) and abs(value) <= _MAX_CORNER_M for corner in corners for value in corner):
        yield f"has a corner that is not finite or farther than {_MAX_CORNER_M:g} m"
    if not is_simple(corners):
        yield "crosses or touches itself"
