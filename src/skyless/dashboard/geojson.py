"""The tags of a site as GeoJSON (RFC 7946), for programs that draw maps. No I/O; the time is passed in."""

from collections.abc import Iterable
from math import hypot, sqrt
from typing import Final

import msgspec
from msgspec import Struct

from skyless.bridges.feed import BridgedSite, is_usable, require_georeference
from skyless.mqtt.messages import FixMessage
from skyless.site.earth import geodetic

MEDIA_TYPE: Final = "application/geo+json"

OLDEST_S: Final = 5.0
"""A tag whose last fix is older is not on the map."""


class Tag(Struct, frozen=True):
    """Properties of a feature."""

    tag: str
    unix_s: float
    """When the last frame of the fix ended."""
    age_s: float
    std_m: float
    """One-sigma radial error."""
    horizontal_std_m: float
    speed_mps: float | None
    method: str
    alert: str | None
    """Of the integrity monitor."""


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
        tag = Tag(
            tag=fix.tag,
            unix_s=round(ended_unix_s, 3),
            age_s=round(max(unix_s - ended_unix_s, 0.0), 3),
            std_m=round(fix.std_m, 4),
            horizontal_std_m=round(sqrt(max(fix.covariance_m2[0] + fix.covariance_m2[4], 0.0)), 4),
            speed_mps=None if fix.velocity_mps is None else round(hypot(*fix.velocity_mps), 3),
            method=fix.method,
            alert=fix.alert,
        )
        position = [round(longitude_deg, 9), round(latitude_deg, 9), round(height_m, 4)]
        geometry = {"type": "Point", "coordinates": position}
        collection.append({"type": "Feature", "id": fix.tag, "geometry": geometry, "properties": tag})
    return msgspec.json.encode({"type": "FeatureCollection", "features": collection})
