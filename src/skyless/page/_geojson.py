"""The tags of a site as GeoJSON (RFC 7946), for programs that draw maps. No I/O: the time is passed in."""

from collections.abc import Iterable
from math import hypot, sqrt
from typing import Final

import msgspec

from skyless.bridges.target import BridgedSite, is_usable, require_georeference
from skyless.core.earth import geodetic
from skyless.run.mqtt.messages import FixMessage

MEDIA_TYPE: Final = "application/geo+json"

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
    collection = []
    for fix, ended_unix_s in fixes:
        if not is_usable(fix):
            continue
        latitude_deg, longitude_deg, height_m = geodetic(fix.position_m, origin)
        properties = {
            "tag": fix.tag,
            "unix_s": round(ended_unix_s, 3),
            "age_s": round(max(unix_s - ended_unix_s, 0.0), 3),
            "std_m": round(fix.std_m, 4),
            "horizontal_std_m": round(sqrt(max(fix.covariance_m2[0] + fix.covariance_m2[4], 0.0)), 4),
            "speed_mps": None if fix.velocity_mps is None else round(hypot(*fix.velocity_mps), 3),
            "method": fix.method,
            "alert": fix.alert,
        }
        position = [round(longitude_deg, 9), round(latitude_deg, 9), round(height_m, 4)]
        geometry = {"type": "Point", "coordinates": position}
        collection.append({"type": "Feature", "id": fix.tag, "geometry": geometry, "properties": properties})
    return msgspec.json.encode({"type": "FeatureCollection", "features": collection})
