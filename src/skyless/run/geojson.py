"""Features of GeoJSON (RFC 7946)."""

from typing import Any

from skyless.core.earth import geodetic
from skyless.core.site import GeoreferenceSite


def coordinates(position_m: tuple[float, float, float], origin: GeoreferenceSite) -> list[float]:
    """Longitude, latitude (WGS 84) and height above the ellipsoid of a point of the site."""
    latitude_deg, longitude_deg, height_m = geodetic(position_m, origin)
    return [round(longitude_deg, 9), round(latitude_deg, 9), round(height_m, 4)]


def feature(kind: str, at: object, properties: dict[str, Any], **members: object) -> dict[str, Any]:
    """A feature with this kind of geometry at these coordinates."""
    return {"type": "Feature", **members, "geometry": {"type": kind, "coordinates": at}, "properties": properties}
