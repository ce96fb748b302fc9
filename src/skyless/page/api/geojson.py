"""Tags, anchors and zones of a site as GeoJSON (RFC 7946), for programs that draw maps."""

from collections.abc import Iterator
from math import hypot, sqrt
from typing import Any, Final

from starlette.exceptions import HTTPException
from starlette.responses import Response

from skyless.bridges.target import bridged_site, is_usable, require_georeference
from skyless.core.errors import SkylessError
from skyless.core.site import GeoreferenceSite
from skyless.page.api.json_answer import json_answer
from skyless.page.api.openapi import GEOJSON
from skyless.page.live import LiveSite
from skyless.run.geojson import coordinates, feature
from skyless.run.mqtt.messages import Asset
from skyless.run.zones import signed_area_m2


def collection(live: LiveSite, kind: str) -> Response:
    """The tags with fixes, the anchors or the zones: longitude, latitude (WGS 84), height above the ellipsoid.

    Raises:
        HTTPException: no site is known yet, or it is not georeferenced.
    """
    site = live.require_site()
    try:
        origin = require_georeference(bridged_site(site.site, simulated=site.simulated), "GeoJSON")
    except SkylessError as error:
        raise HTTPException(409, str(error)) from None
    found = {"type": "FeatureCollection", "features": list(_FEATURES[kind](live, origin))}
    return json_answer(found, media_type=GEOJSON)


def _fixes(live: LiveSite, origin: GeoreferenceSite) -> Iterator[dict[str, Any]]:
    """Points of those whose use no alert forbids."""
    for fix, ended_unix_s in live.recent_fixes():
        if not is_usable(fix):
            continue
        asset = live.assets.by_tag.get(fix.tag, Asset(fix.tag))
        properties = {
            "tag": fix.tag,
            "name": asset.name or None,
            "group": asset.group or None,
            "colour": asset.colour or None,
            "unix_s": round(ended_unix_s, 3),
            "age_s": round(max(live.wall_clock() - ended_unix_s, 0.0), 3),
            "std_m": round(fix.std_m, 4),
            "horizontal_std_m": round(sqrt(max(fix.covariance_m2[0] + fix.covariance_m2[4], 0.0)), 4),
            "speed_mps": None if fix.velocity_mps is None else round(hypot(*fix.velocity_mps), 3),
            "method": fix.method,
            "alert": fix.alert,
        }
        yield feature("Point", coordinates(fix.position_m, origin), properties, id=fix.tag)


def _anchors(live: LiveSite, origin: GeoreferenceSite) -> Iterator[dict[str, Any]]:
    for anchor in live.require_site().site.anchors:
        position_m = anchor.x_m, anchor.y_m, anchor.z_m
        properties = {"anchor": anchor.id, "position_m": position_m}
        yield feature("Point", coordinates(position_m, origin), properties, id=anchor.id)


def _zones(live: LiveSite, origin: GeoreferenceSite) -> Iterator[dict[str, Any]]:
    for zone in live.monitor.zones:
        corners = zone.polygon_m if signed_area_m2(zone.polygon_m) >= 0.0 else zone.polygon_m[::-1]
        ring = [coordinates((x, y, 0.0), origin)[:2] for x, y in (*corners, corners[0])]
        properties = {"zone": zone.id, "name": zone.name, "colour": zone.colour}
        yield feature("Polygon", [ring], properties, id=zone.id)


_FEATURES: Final = {"fixes": _fixes, "anchors": _anchors, "zones": _zones}
