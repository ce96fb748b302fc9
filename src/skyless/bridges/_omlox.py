"""What Skyless gives as objects of omlox Hub 2.0: locations, and what they belong to.

Names and types of fields: https://omlox.com/fileadmin/api/omlox_Hub_API_2.0.0.json. Coordinates are longitude and
latitude where the site says where it is on the Earth, else metres of the site's frame.
"""

from datetime import UTC, datetime
from math import atan2, degrees, hypot
from typing import Any, Final
from uuid import NAMESPACE_URL, UUID, uuid4, uuid5

from skyless.bridges.nmea import COURSE_SIGMAS
from skyless.bridges.target import BridgedSite, floored
from skyless.core.earth import east_north_up
from skyless.core.ellipse import horizontal_ellipse
from skyless.run.geojson import coordinates
from skyless.run.mqtt.messages import FixMessage, Zone, ZoneEvent
from skyless.run.zones.monitor import floor_at

Object = dict[str, Any]

_GROUND_M: Final = ((0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0))
"""Points of the site whose places on the Earth are given with its zone."""


def crs(site: BridgedSite) -> str:
    """The frame of coordinates."""
    return "local" if site.georeference is None else "EPSG:4326"


def foreign_id(site: BridgedSite) -> str:
    """The name of a site among a hub's zones."""
    return f"skyless-{site.id}"


def provider_id(site: BridgedSite, tag: str) -> str:
    """The name of a tag among a hub's location providers."""
    return f"{foreign_id(site)}-{tag}"


def object_id(site: BridgedSite, kind: str, name: str = "") -> UUID:
    """Always the same for a zone (the site), a fence or a trackable."""
    return uuid5(NAMESPACE_URL, f"skyless:{site.id}/{kind}/{name}")


def location(fix: FixMessage, site: BridgedSite, source: str) -> Object:
    """Where a tag was at the time of a usable fix; ``source`` is the id or foreign id of the hub's zone.

    The accuracy is one horizontal standard deviation in the worst direction. Local heights count from the floor.
    """
    earth, (x_m, y_m, z_m) = site.georeference, fix.position_m
    floor = None if fix.height_known else floor_at(site.floors, z_m, 0.0, None)
    ground_m = next((one.low_m for one in site.floors if one.number == floor), 0.0)
    local_m = [round(value, 4) for value in (x_m, y_m, z_m - ground_m)]
    owner = trackable(site, fix.tag)
    speed_mps = course_deg = None
    if fix.velocity_mps is not None and fix.velocity_covariance is not None:
        east, north, _ = east_north_up(fix.velocity_mps, 0.0 if earth is None else earth.heading_deg)
        speed_mps = hypot(east, north)
        variance = fix.velocity_covariance[0] + fix.velocity_covariance[4]
        if earth is not None and speed_mps > 0.0 and speed_mps**2 > COURSE_SIGMAS**2 * variance:
            course_deg = round(degrees(atan2(east, north)), 2) % 360.0
    return _known(
        position={"type": "Point", "coordinates": local_m if earth is None else coordinates(fix.position_m, earth)},
        source=source,
        provider_type="uwb",
        provider_id=provider_id(site, fix.tag),
        timestamp_generated=datetime.fromtimestamp(fix.unix_s, UTC),
        crs=crs(site),
        elevation_ref="floor" if earth is None else "wgs84",
        accuracy=round(horizontal_ellipse(floored(fix.covariance_m2))[0], 4),
        floor=floor,
        speed=speed_mps,
        course=course_deg,
        trackables=None if owner is None else [owner["id"]],
        properties={"simulated": True} if site.simulated else None,
    )


def hub_zone(site: BridgedSite) -> Object:
    """The site as a hub's zone: a positioning system with its frame."""
    zone = {"id": object_id(site, "zone"), "type": "uwb", "foreign_id": foreign_id(site), "name": site.name}
    earth = site.georeference
    if earth is None:
        return zone | {"incomplete_configuration": True}
    points = [one for x_m, y_m in _GROUND_M for one in (coordinates((x_m, y_m, 0.0), earth)[:2], [x_m, y_m])]
    return zone | {"ground_control_points": points, "wgs84_height": earth.height_m}


def trackable(site: BridgedSite, tag: str) -> Object | None:
    """What a tag is attached to; None where that has no name."""
    asset = site.assets.get(tag)
    if asset is None or not asset.name:
        return None
    ident, providers = object_id(site, "trackable", tag), [provider_id(site, tag)]
    return {"id": ident, "type": "virtual", "name": asset.name, "location_providers": providers}


def fence(zone: Zone, site: BridgedSite) -> Object:
    """A zone that was drawn on the site."""
    ring, earth = [[*at] for at in (*zone.polygon_m, zone.polygon_m[0])], site.georeference
    if earth is not None:
        ring = [coordinates((x_m, y_m, 0.0), earth)[:2] for x_m, y_m in ring]
    return _known(
        id=object_id(site, "fence", zone.id),
        region={"type": "Polygon", "coordinates": [ring]},
        crs=crs(site),
        zone_id=object_id(site, "zone"),
        floor=zone.floor,
        foreign_id=zone.id,
        name=zone.name,
    )


def fence_event(event: ZoneEvent, site: BridgedSite) -> Object:
    """That a tag, and with it what it is attached to, has entered or left a fence."""
    owner = trackable(site, event.tag)
    what = "entry" if event.kind == "enter" else "exit"
    return _known(
        id=uuid4(),
        fence_id=object_id(site, "fence", event.zone),
        foreign_id=event.zone,
        event_type=f"region_{what}",
        provider_id=provider_id(site, event.tag),
        trackable_id=None if owner is None else owner["id"],
        **{f"{what}_time": datetime.fromtimestamp(event.unix_s, UTC)},
    )


def _known(**fields: object) -> Object:
    """The fields that have a value."""
    return {key: value for key, value in fields.items() if value is not None}
