"""Positions for the world outside: on the Earth, east, north and up, GeoJSON, and the ellipse of a covariance.

Plain arithmetic on single values, for programs that must start quickly.
"""

from collections.abc import Sequence
from math import atan2, cos, degrees, hypot, radians, sin, sqrt
from typing import Any, Final

from skyless.core.site import GeoreferenceSite

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""3 × 3, row by row."""

_EARTH_A_M: Final = 6_378_137.0
_EARTH_E2: Final = 6.694379990141e-3  # first eccentricity squared, WGS 84
_ROUNDS: Final = 4  # of Bowring's formula, which is right to a nanometre after two near the surface


def east_north_up(vector: Vector, heading_deg: float) -> Vector:
    """A vector of the site as east, north, up; ``heading_deg`` is the azimuth of the site's y axis."""
    heading = radians(heading_deg)
    x, y, z = vector
    return x * cos(heading) + y * sin(heading), y * cos(heading) - x * sin(heading), z


def rotated(covariance: Matrix, heading_deg: float) -> Matrix:
    """R C Rᵀ: a covariance in site axes converted to east, north, up."""
    heading = radians(heading_deg)
    c, s = cos(heading), sin(heading)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = covariance
    # The rows of R C, whose columns are then combined in the same way.
    east = (c * xx + s * yx, c * xy + s * yy, c * xz + s * yz)
    north = (c * yx - s * xx, c * yy - s * xy, c * yz - s * xz)
    up = (zx, zy, zz)
    (ee, en, eu), (ne, nn, nu), (ue, un, uu) = (
        (row[0] * c + row[1] * s, row[1] * c - row[0] * s, row[2]) for row in (east, north, up)
    )
    return ee, en, eu, ne, nn, nu, ue, un, uu


def geodetic(point_m: Vector, origin: GeoreferenceSite) -> Vector:
    """Latitude, longitude (degrees, WGS 84) and height (m) of a point of the site.

    The x-y plane touches the Earth at the origin. A height is always the origin's plus z: a survey levels its anchors,
    so that z follows the Earth's curvature (8 cm at a distance of 1 km).
    """
    east, north, up = east_north_up(point_m, origin.heading_deg)
    latitude = radians(origin.latitude_deg)
    radius_m, axis_m = _off_axis_m(latitude, origin.height_m + up)
    # In the plane of the equator, towards the origin's meridian and across it; then along the Earth's axis.
    towards_m = radius_m - north * sin(latitude)
    longitude_deg = origin.longitude_deg + degrees(atan2(east, towards_m))
    return (
        degrees(_latitude(hypot(towards_m, east), axis_m + north * cos(latitude))),
        (longitude_deg + 180.0) % 360.0 - 180.0,
        origin.height_m + up,
    )


def east_north_up_of(latitude_deg: float, longitude_deg: float, height_m: float, origin: GeoreferenceSite) -> Vector:
    """East, north and up (m) of a point on the Earth from the site's origin: the inverse of ``geodetic``.

    Accurate to 0.05 mm within 1 km.
    """
    latitude, from_latitude = radians(latitude_deg), radians(origin.latitude_deg)
    longitude = radians(longitude_deg - origin.longitude_deg)
    radius_m, axis_m = _off_axis_m(latitude, height_m)
    from_radius_m, from_axis_m = _off_axis_m(from_latitude, height_m)
    towards_m = radius_m * cos(longitude) - from_radius_m
    return (
        radius_m * sin(longitude),
        (axis_m - from_axis_m) * cos(from_latitude) - towards_m * sin(from_latitude),
        height_m - origin.height_m,
    )


def _off_axis_m(latitude: float, height_m: float) -> tuple[float, float]:
    """Distances of a point from the Earth's axis and from the plane of its equator; ``latitude`` in radians."""
    prime_m = _EARTH_A_M / sqrt(1.0 - _EARTH_E2 * sin(latitude) ** 2)
    return (prime_m + height_m) * cos(latitude), (prime_m * (1.0 - _EARTH_E2) + height_m) * sin(latitude)


def _latitude(radius_m: float, axis_m: float) -> float:
    """Geodetic latitude of a point by its distances from the axis and from the equator's plane, by Bowring's formula.

    Source: B. R. Bowring, Transformation from spatial to geographical coordinates, Survey Review 23 (1976) 323-327.
    """
    flat = sqrt(1.0 - _EARTH_E2)
    second = _EARTH_E2 / (1.0 - _EARTH_E2)
    reduced = atan2(axis_m, flat * radius_m)
    latitude = 0.0
    for _ in range(_ROUNDS):
        latitude = atan2(
            axis_m + second * flat * _EARTH_A_M * sin(reduced) ** 3,
            radius_m - _EARTH_E2 * _EARTH_A_M * cos(reduced) ** 3,
        )
        reduced = atan2(flat * sin(latitude), cos(latitude))
    return latitude


# The ellipse of a position's covariance on the floor. Plain arithmetic, for programs that must start quickly.


def horizontal_ellipse(covariance_m2: Sequence[float]) -> tuple[float, float, float]:
    """Semi-axes of the 1σ ellipse in m, the longer first, and the longer one's direction from x to y in rad.

    ``covariance_m2`` is 3 × 3, row by row.
    """
    xx, xy, yy = covariance_m2[0], covariance_m2[1], covariance_m2[4]
    middle, half = (xx + yy) / 2.0, hypot((xx - yy) / 2.0, xy)
    return sqrt(max(middle + half, 0.0)), sqrt(max(middle - half, 0.0)), atan2(2.0 * xy, xx - yy) / 2.0


def coordinates(position_m: tuple[float, float, float], origin: GeoreferenceSite) -> list[float]:
    """Longitude, latitude (WGS 84) and height above the ellipsoid of a point of the site."""
    latitude_deg, longitude_deg, height_m = geodetic(position_m, origin)
    return [round(longitude_deg, 9), round(latitude_deg, 9), round(height_m, 4)]


def feature(kind: str, at: object, properties: dict[str, Any], **members: object) -> dict[str, Any]:
    """A GeoJSON feature with a geometry of this kind and these coordinates."""
    return {"type": "Feature", **members, "geometry": {"type": kind, "coordinates": at}, "properties": properties}
