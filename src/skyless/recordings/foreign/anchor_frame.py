"""Positions that anchors of another system state of themselves, in one frame.

Relative positions are in the frame of whoever installed the anchors. Positions on the Earth become east, north and up
of the first one that is stated, so that the tag's are as well.
"""

from math import cos, radians, sin, sqrt

from skyless.air.masterless_packets import Point
from skyless.air.uci_location import GeodeticPoint
from skyless.site.earth import EARTH_A_M, EARTH_E2


class AnchorFrame:
    """The frame of one recording or one board."""

    def __init__(self) -> None:
        self.origin: GeodeticPoint | None = None
        """The first point on the Earth."""

    def position_m(self, location: Point | GeodeticPoint | None) -> Point | None:
        """A location in this frame."""
        if not isinstance(location, GeodeticPoint):
            return location
        if self.origin is None:
            self.origin = location
        return east_north_up_m(location, self.origin)


def east_north_up_m(point: GeodeticPoint, origin: GeodeticPoint) -> Point:
    """East and north on the plane that touches the Earth at the origin; up is the difference of the heights."""
    latitude, from_latitude = radians(point.latitude_deg), radians(origin.latitude_deg)
    longitude = radians(point.longitude_deg - origin.longitude_deg)
    radius_m, axis_m = _off_axis_m(latitude, origin.height_m)
    from_radius_m, from_axis_m = _off_axis_m(from_latitude, origin.height_m)
    towards_m = radius_m * cos(longitude) - from_radius_m
    return (
        radius_m * sin(longitude),
        (axis_m - from_axis_m) * cos(from_latitude) - towards_m * sin(from_latitude),
        point.height_m - origin.height_m,
    )


def _off_axis_m(latitude: float, height_m: float) -> tuple[float, float]:
    """Distances from the Earth's axis and from the plane of its equator."""
    prime_m = EARTH_A_M / sqrt(1.0 - EARTH_E2 * sin(latitude) ** 2)
    return (prime_m + height_m) * cos(latitude), (prime_m * (1.0 - EARTH_E2) + height_m) * sin(latitude)
