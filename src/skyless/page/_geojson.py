"""Tags, anchors and zones of a site as GeoJSON (RFC 7946), for programs that draw maps. No I/O."""

from collections.abc import Iterable, Mapping
from math import hypot, sqrt
from typing import Final

import msgspec

from skyless.bridges.target import BridgedSite, is_usable, require_georeference
from skyless.core.earth import geodetic
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import Asset, FixMessage, Vector
from skyless.run.zones.zone_list import signed_area_m2

OLDEST_S: Final = 5.0
"""A tag whose last fix is older is not on the map."""


def features(site: BridgedSite, fixes: Iterable[tuple[FixMessage, float]], unix_s: float) -> bytes:
    """A FeatureCollection with a point for each tag: longitude, latitude (WGS 84), height above the ellipsoid.

    ``fixes`` are each tag's newest with when it ended, by the clock of ``unix_s``. Those whose use an alert forbids
    are left out.

    Raises:
        SkylessError: the site is not georeferenced.
    """
    origin = require_georeference(site, "/fixes.geojson")
    found = []
    for fix, ended_unix_s in fixes:
        if not is_usable(fix):
            continue
        asset = site.assets.get(fix.tag, Asset(fix.tag))
        properties = {
            "tag": fix.tag,
            "name": asset.name or None,
            "group": asset.group or None,
            "colour": asset.colour or None,
            "unix_s": round(ended_unix_s, 3),
            "age_s": round(max(unix_s - ended_unix_s, 0.0), 3),
            "std_m": round(fix.std_m, 4),
            "horizontal_std_m": round(sqrt(max(fix.covariance_m2[0] + fix.covariance_m2[4], 0.0)), 4),
            "speed_mps": None if fix.velocity_mps is None else round(hypot(*fix.velocity_mps), 3),
            "method": fix.method,
            "alert": fix.alert,
        }
        found.append(_feature(fix.tag, "Point", _coordinates(fix.position_m, origin), properties))
    return _encoded(found)


def anchor_features(site: BridgedSite) -> bytes:
    """A FeatureCollection with a point for each anchor. Raises SkylessError: the site is not georeferenced."""
    origin = require_georeference(site, "GeoJSON")
    return _encoded(
        _feature(number, "Point", _coordinates(position_m, origin), {"anchor": number, "position_m": position_m})
        for number, position_m in site.anchors_m.items()
    )


def zone_features(site: BridgedSite) -> bytes:
    """A FeatureCollection with a polygon for each zone. Raises SkylessError: the site is not georeferenced."""
    origin = require_georeference(site, "GeoJSON")
    found = []
    for zone in site.zones:
        corners = zone.polygon_m if signed_area_m2(zone.polygon_m) >= 0.0 else zone.polygon_m[::-1]
        ring = [_coordinates((x, y, 0.0), origin)[:2] for x, y in (*corners, corners[0])]
        properties = {"zone": zone.id, "name": zone.name, "colour": zone.colour}
        found.append(_feature(zone.id, "Polygon", [ring], properties))
    return _encoded(found)


def _feature(name: str | int, kind: str, coordinates: object, properties: Mapping[str, object]) -> dict[str, object]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "id": name, "geometry": geometry, "properties": properties}


def _coordinates(position_m: Vector, origin: GeoreferenceSite) -> list[float]:
    """Longitude, latitude and height."""
    latitude_deg, longitude_deg, height_m = geodetic(position_m, origin)
    return [round(longitude_deg, 9), round(latitude_deg, 9), round(height_m, 4)]


def _encoded(features: Iterable[dict[str, object]]) -> bytes:
    return msgspec.json.encode({"type": "FeatureCollection", "features": list(features)})
