"""Lists of zones: which are valid, and which belong to a site."""

import math
import re
from typing import Final

import msgspec

from skyless.mqtt.messages import SiteZones, Zone, ZonesMessage
from skyless.zones.polygon import Polygon, is_simple

_MAX_ZONES: Final = 100
_MAX_CORNERS: Final = 100
_MAX_CORNER_M: Final = 1e5

MAX_OTHER_SITES: Final = 20
"""Sites of one number whose zones are kept besides the present one's; those not seen for longest are dropped."""

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
