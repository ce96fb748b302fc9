"""Zones as polygons (corners in order, metres), and lists of them: which are valid, and which belong to a site."""

import math
import re
from itertools import pairwise
from typing import Final

import msgspec

from skyless.run.mqtt.messages import SiteZones, Zone, ZonesMessage

Point = tuple[float, float]
Polygon = tuple[Point, ...]


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
    segments = sides(polygon)
    last = len(segments) - 1
    for i, (a, b) in enumerate(segments):
        if a == b or _folds_back(a, b, segments[(i + 1) % len(segments)][1]):
            return False
        for j in range(i + 2, len(segments)):
            if (i, j) != (0, last) and _touch(a, b, *segments[j]):
                return False
    return True


def _folds_back(a: Point, b: Point, c: Point) -> bool:
    """Whether the side b–c runs back along a–b."""
    towards = (a[0] - b[0]) * (c[0] - b[0]) + (a[1] - b[1]) * (c[1] - b[1])
    return _turn(a, b, c) == 0.0 and towards > 0.0


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


_MAX_ZONES: Final = 100
_MAX_CORNERS: Final = 100
_MAX_CORNER_M: Final = 1e5

MAX_OTHER_SITES: Final = 20
"""Other sites of one number whose zones are kept; the ones not seen for longest are dropped."""

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
